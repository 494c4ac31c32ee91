"""At which loss the aircraft speaks: learned from the few messages there are, held by a prior where there are none."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Limit:
    """Loss at which the failure message comes.

    Attributes
    ----------
    mean, sd : float
        Fleet mean and its uncertainty. [-]
    unit_sd : float
        Spread over units about the fleet mean. [-]
    """

    mean: float
    sd: float
    unit_sd: float


PRIORS = {
    # flow can no longer be held; more varied, since a speed margin hides it
    "CC": Limit(0.25, 0.06, 0.05),
}


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
