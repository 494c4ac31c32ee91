"""Real data sets, one recipe each; `python -m benchmarks.real --data DIR`."""
