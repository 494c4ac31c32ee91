"""Estimate the loss at which the message comes, from few messages and a prior."""

import numpy as np
from numpy.typing import NDArray

from hdt_core.components import Limit
from hdt_core.components.compressor import CC

Array = NDArray[np.float64]


PRIORS = {CC.code: CC.limit}
"""Of components that fail at a loss; the exchanger's message depends on its margin."""


def learn_limit(levels: Array, prior: Limit) -> Limit:
    """Compute the posterior of the limit from losses just before messages (normal, known variance).

    Parameters
    ----------
    levels : array, shape (n,)
        Loss before each message, one a failure; a level reached by a jump reads high, so values far off count less. [-]
    prior : Limit
        Prior before any message.
    """
    levels = levels[np.isfinite(levels)]
    if levels.size == 0:
        return prior
    # Huber weights: a sudden clog overshoots the limit, a wrong message undershoots it
    distance = np.abs(levels - np.median(np.append(levels, prior.mean))) / (1.5 * prior.unit_sd)
    weight = 1.0 / np.maximum(distance, 1.0)
    precision = 1.0 / prior.sd**2 + weight.sum() / prior.unit_sd**2
    mean = (prior.mean / prior.sd**2 + (weight * levels).sum() / prior.unit_sd**2) / precision
    return Limit(float(mean), float(precision**-0.5), prior.unit_sd)
