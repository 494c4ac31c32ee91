"""Declared models of components, and the equations behind them."""
