"""Laws of wear: what grows in proportion to flights where a loss does not."""

from dataclasses import dataclass

import numpy as np

from hdt_core.physics.model import Array

LEAST_LOSS, MOST_LOSS = 1e-3, 0.95
"""Losses between which a law is evaluated: an estimate may lie beyond."""


@dataclass(frozen=True, slots=True)
class WearLaw:
    r"""Growth of a loss :math:`L` with flights: :math:`x(L)` is linear in flights.

    Attributes
    ----------
    of_resistance : bool
        Whether the loss's resistance grows, as of a deposit in series with films: :math:`x = L / (1 - L)`.
    power : float
        Exponent of flights: :math:`x^{1/p}` is linear; above 1 wear speeds up, below it levels off.

    Examples
    --------
    >>> RESISTANCE.grown(np.array([0.5])).tolist()
    [1.0]
    >>> power_law(2.0).grown(np.array([0.25])).tolist()
    [0.5]
    """

    of_resistance: bool = False
    power: float = 1.0

    def grown(self, loss: Array) -> Array:
        """Return what grows linearly, at a loss. (n,)"""
        bounded = np.clip(loss, LEAST_LOSS, MOST_LOSS)
        amount = bounded / (1.0 - bounded) if self.of_resistance else bounded
        return np.asarray(amount ** (1.0 / self.power) if self.is_curved else loss)

    def slope(self, loss: Array) -> Array:
        """Return its derivative by the loss. (n,)"""
        bounded = np.clip(loss, LEAST_LOSS, MOST_LOSS)
        amount = bounded / (1.0 - bounded) if self.of_resistance else bounded
        by_loss = (1.0 - bounded) ** -2.0 if self.of_resistance else np.ones_like(bounded)
        return np.asarray(amount ** (1.0 / self.power - 1.0) / self.power * by_loss)

    @property
    def is_curved(self) -> bool:
        """Whether the loss itself does not grow linearly."""
        return self.of_resistance or self.power != 1.0


LINEAR = WearLaw()
RESISTANCE = WearLaw(of_resistance=True)


def power_law(power: float) -> WearLaw:
    """Return the law of a loss that grows with a power of flights.

    Raises
    ------
    ValueError
        The power is not positive.
    """
    if not power > 0.0:
        raise ValueError(f"a loss grows with a positive power of flights, not {power}")
    return WearLaw(power=power)
