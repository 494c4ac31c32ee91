"""Curves stored at a few points, interpolated linearly and extrapolated by their last segments."""

import numpy as np

from hdt_core.physics.model import Array


def falls_through(curves: Array, grid: Array, value: float) -> Array:
    """Return where falling curves over one grid reach a value: (n, points) to (n,)."""
    index = np.clip((curves > value).sum(axis=1) - 1, 0, grid.size - 2)
    rows = np.arange(len(curves))
    high, low = curves[rows, index], curves[rows, index + 1]
    share = (high - value) / np.maximum(high - low, 1e-9)
    return np.asarray(grid[index] + share * (grid[index + 1] - grid[index]))


def read_across(grids: Array, values: Array, at: Array) -> tuple[Array, Array]:
    """Interpolate curves of the same values, each over its own rising grid, at a point each; with slopes.

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
    index = np.clip((grids < at[:, None]).sum(axis=1) - 1, 0, values.size - 2)
    rows = np.arange(len(at))
    low, high = grids[rows, index], grids[rows, index + 1]
    slope = (values[index + 1] - values[index]) / np.maximum(high - low, 1e-6)
    return values[index] + (at - low) * slope, slope
