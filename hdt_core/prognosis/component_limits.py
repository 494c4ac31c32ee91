"""At which loss the message comes: learned from the few messages there are, held by a prior where there are none."""

import numpy as np
from numpy.typing import NDArray

from hdt_core.components import Limit
from hdt_core.components.compressor import CC

Array = NDArray[np.float64]


PRIORS = {CC.code: CC.limit}
"""Of what fails at a loss; the exchanger's message is foretold by its margin."""


def learn_limit(levels: Array, prior: Limit) -> Limit:
    """Posterior of the limit from the losses seen just before messages (normal, known spread).

    Parameters
    ----------
    levels : array, shape (n,)
        Loss before each message, one a failure; a level reached by a jump reads high, so values far off count less. [-]
    prior : Limit
        What is believed before any message.
    """
    levels = levels[np.isfinite(levels)]
    if levels.size == 0:
        return prior
    # Huber weights: a sudden clog overshoots the limit, a wrong message undershoots it
    far = np.abs(levels - np.median(np.append(levels, prior.mean))) / (1.5 * prior.unit_sd)
    weight = 1.0 / np.maximum(far, 1.0)
    precision = 1.0 / prior.sd**2 + weight.sum() / prior.unit_sd**2
    mean = (prior.mean / prior.sd**2 + (weight * levels).sum() / prior.unit_sd**2) / precision
    return Limit(float(mean), float(precision**-0.5), prior.unit_sd)
