"""From a problem to an estimate: one protocol, one method a file.

`estimators()` lists every method with its default settings; the contract tests run over it.
"""

from functools import cache
from importlib.metadata import entry_points

from hdt_core.estimation.ekf import ExtendedKalman
from hdt_core.estimation.estimate import Estimate, Estimator, Status
from hdt_core.estimation.fit import Fit
from hdt_core.estimation.identifiability import Identifiability
from hdt_core.estimation.nls import NonlinearLeastSquares
from hdt_core.estimation.pinn import PhysicsInformedNet
from hdt_core.estimation.problem import Belief, Problem, unknown
from hdt_core.estimation.pso import ParticleSwarm
from hdt_core.estimation.ukf import UnscentedKalman

OWN: tuple[Estimator, ...] = (
    NonlinearLeastSquares(),
    ParticleSwarm(),
    ExtendedKalman(),
    UnscentedKalman(),
    PhysicsInformedNet(),
)
"""The methods of the paper."""

__all__ = [
    "Belief",
    "Estimate",
    "Estimator",
    "ExtendedKalman",
    "Fit",
    "Identifiability",
    "NonlinearLeastSquares",
    "ParticleSwarm",
    "PhysicsInformedNet",
    "Problem",
    "Status",
    "UnscentedKalman",
    "estimators",
    "unknown",
]


@cache
def estimators() -> dict[str, Estimator]:
    """Every method by its name: the paper's, then those of other packages.

    A package brings one by an entry point of the group `hdt.estimators` that names an `Estimator` or its class.

    Raises
    ------
    ValueError
        A package brings a method of a name that is taken.
    """
    methods = {e.name: e for e in OWN}
    for point in sorted(entry_points(group="hdt.estimators"), key=lambda p: p.name):
        loaded = point.load()
        method = loaded() if isinstance(loaded, type) else loaded
        if method.name in methods:
            raise ValueError(f"the estimator {point.name} ({point.value}): there is a method {method.name} already")
        methods[method.name] = method
    return methods
