"""From a problem to an estimate: one protocol, one method a file.

`estimators()` lists every method with its default settings; the contract tests run over it.
"""

from functools import cache

from hdt_core.estimation.estimate import Estimate, Estimator, Status
from hdt_core.estimation.fit import Fit, Identifiability
from hdt_core.estimation.kalman import ExtendedKalman, UnscentedKalman
from hdt_core.estimation.optimisers import NonlinearLeastSquares, ParticleSwarm
from hdt_core.estimation.pinn import PhysicsInformedNet
from hdt_core.estimation.problem import Belief, Problem, unknown
from hdt_core.loading import load_entry_points

METHODS: tuple[Estimator, ...] = (
    NonlinearLeastSquares(), ParticleSwarm(), ExtendedKalman(), UnscentedKalman(), PhysicsInformedNet(),
)  # fmt: skip
"""The methods of the paper."""

__all__ = [
    "Belief", "Estimate", "Estimator", "ExtendedKalman", "Fit", "Identifiability", "NonlinearLeastSquares",
    "ParticleSwarm", "PhysicsInformedNet", "Problem", "Status", "UnscentedKalman", "estimators", "unknown",
]  # fmt: skip


@cache
def estimators() -> dict[str, Estimator]:
    """Return every method by its name: the paper's, then those of other packages.

    A package adds one by an entry point of the group `hdt.estimators` that names an `Estimator` or its class.

    Raises
    ------
    ValueError
        A package adds a method of a name that is taken.
    """
    methods = {e.name: e for e in METHODS}
    for label, entry in load_entry_points("hdt.estimators", "estimator", ValueError):
        method = entry() if isinstance(entry, type) else entry
        if method.name in methods:
            raise ValueError(f"{label}: there is a method {method.name} already")
        methods[method.name] = method
    return methods
