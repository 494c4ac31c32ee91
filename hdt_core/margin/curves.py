"""Curves kept at a few points, read between them by straight lines and beyond them by the last."""

import numpy as np

from hdt_core.physics.model import Array


def falls_through(curves: Array, grid: Array, value: float) -> Array:
    """Where curves over one grid, each falling, come down to a value: (n, points) to (n,)."""
    left = np.clip((curves > value).sum(axis=1) - 1, 0, grid.size - 2)
    rows = np.arange(len(curves))
    high, low = curves[rows, left], curves[rows, left + 1]
    share = (high - value) / np.maximum(high - low, 1e-9)
    return np.asarray(grid[left] + share * (grid[left + 1] - grid[left]))


def read_across(grids: Array, values: Array, at: Array) -> tuple[Array, Array]:
    """Curves of the same values over a rising grid each, read at a point each, and their slopes there.

    Parameters
    ----------
    grids : array, shape (n, points)
        Rising along each row.
    values : array, shape (points,)
    at : array, shape (n,)

    Returns
    -------
    array, array, shape (n,)
        NaN where the grid or the point is not known.
    """
    left = np.clip((grids < at[:, None]).sum(axis=1) - 1, 0, values.size - 2)
    rows = np.arange(len(at))
    low, high = grids[rows, left], grids[rows, left + 1]
    slope = (values[left + 1] - values[left]) / np.maximum(high - low, 1e-6)
    return values[left] + (at - low) * slope, slope
