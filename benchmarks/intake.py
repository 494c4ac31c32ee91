"""Claim: taking in CSV costs at most 1.5 times the CPU of Polars reading the same bytes and writing them as Parquet.

The peer reads each flight's file with `pl.read_csv` and writes Parquet, either a file a flight or all in one; it checks
nothing. Ours lists, checks, converts to SI, removes duplicates and writes all in one. CPU of one thread, best of the
rounds, contestants in turn. Run: `python -m benchmarks.intake [--landing DIR]`.
"""

import os

os.environ.setdefault("POLARS_MAX_THREADS", "1")

import tempfile
from pathlib import Path

import polars as pl

from benchmarks.harness import Texts, best_cpu_s, markdown, run
from pipelines.intake.landing import list_landing
from pipelines.intake.landing_file import LandingFile
from pipelines.intake.merge import merge_deliveries
from pipelines.intake.snapshots import read_snapshots

ROUNDS = 5


def a_file_a_flight(files: list[LandingFile], out: Path) -> None:
    for i, file in enumerate(files):
        pl.read_csv(file.full_path).write_parquet(out / f"{i}.parquet")


def all_in_one(files: list[LandingFile], out: Path) -> None:
    frames = [pl.read_csv(file.full_path) for file in files]
    pl.concat(frames, how="diagonal_relaxed").write_parquet(out / "peer.parquet")


def ours(landing: Path, out: Path) -> None:
    files = [f for f in list_landing(landing).files if f.kind == "acms"]
    rows = read_snapshots(files).rows
    merge_deliveries([rows], {}).rows.write_parquet(out / "ours.parquet")


def one_long_file(files: list[LandingFile], out: Path) -> LandingFile:
    """A file of tens of megabytes, which nobody delivers: the cost a row without the cost a file."""
    tail = files[0].tail
    own = [Path(f.full_path).read_bytes().partition(b"\n") for f in files if f.tail == tail]
    path = out / "landing" / files[0].operator / tail / "acms" / "long.csv"
    path.parent.mkdir(parents=True)
    path.write_bytes(own[0][0] + b"\n" + b"".join(body for _, _, body in own) * 40)
    return list_landing(out / "landing").files[0]


def main(landing: Path = Path("data_samples"), rounds: int = ROUNDS) -> Texts:
    """Files of a landing zone."""
    files = [f for f in list_landing(landing).files if f.kind == "acms"]
    megabytes = sum(f.size for f in files) / 1e6
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        long = one_long_file(files, out)
        works = {
            "peer, a file a flight": lambda: a_file_a_flight(files, out),
            "peer, all in one": lambda: all_in_one(files, out),
            "ours": lambda: ours(landing, out),
            "peer, one long file": lambda: all_in_one([long], out),
            "ours, one long file": lambda: read_snapshots([long]).rows.write_parquet(out / "ours.parquet"),
        }
        best = best_cpu_s(works, rounds)
    lines = [[f"{len(files)} files of one flight, {megabytes:.1f} MB; one of {long.size / 1e6:.1f} MB", "CPU [s]"]]
    lines += [[name, f"{seconds:.3f}"] for name, seconds in best.items()]
    for peer, own, claim in (
        ("a file a flight", "ours", "at most 1.5"),
        ("all in one", "ours", "at most 1.5"),
        ("one long file", "ours, one long file", "none"),
    ):
        lines.append([f"ours / peer, {peer} (claim: {claim})", f"{best[own] / best[f'peer, {peer}']:.2f}"])
    yield "", markdown(lines)


if __name__ == "__main__":
    run(main)
