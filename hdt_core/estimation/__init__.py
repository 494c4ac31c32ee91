"""From a problem to an estimate: one protocol, one method a file.

`ESTIMATORS` lists every method with its default settings; the contract tests run over it.
"""

from hdt_core.estimation.differential_evolution import DifferentialEvolution
from hdt_core.estimation.ekf import ExtendedKalman
from hdt_core.estimation.ekf_pso import SwarmKalman
from hdt_core.estimation.estimate import Estimate, Estimator, Status
from hdt_core.estimation.fit import Fit
from hdt_core.estimation.genetic import Genetic
from hdt_core.estimation.gradient_descent import GradientDescent
from hdt_core.estimation.identifiability import Identifiability
from hdt_core.estimation.nls import NonlinearLeastSquares
from hdt_core.estimation.particle import ParticleFilter
from hdt_core.estimation.pinn import PhysicsInformedNet
from hdt_core.estimation.problem import Belief, Problem, unknown
from hdt_core.estimation.pso import ParticleSwarm
from hdt_core.estimation.rls import RecursiveLeastSquares
from hdt_core.estimation.strong_tracking import StrongTracking
from hdt_core.estimation.ukf import UnscentedKalman

ESTIMATORS: tuple[Estimator, ...] = (
    NonlinearLeastSquares(),
    ParticleSwarm(),
    ExtendedKalman(),
    UnscentedKalman(),
    PhysicsInformedNet(),
    ParticleFilter(),
    DifferentialEvolution(),
    Genetic(),
    GradientDescent(),
    RecursiveLeastSquares(),
    StrongTracking(),
    SwarmKalman(),
)

__all__ = [
    "ESTIMATORS",
    "Belief",
    "DifferentialEvolution",
    "Estimate",
    "Estimator",
    "ExtendedKalman",
    "Fit",
    "Genetic",
    "GradientDescent",
    "Identifiability",
    "NonlinearLeastSquares",
    "ParticleFilter",
    "ParticleSwarm",
    "PhysicsInformedNet",
    "Problem",
    "RecursiveLeastSquares",
    "Status",
    "StrongTracking",
    "SwarmKalman",
    "UnscentedKalman",
    "unknown",
]
