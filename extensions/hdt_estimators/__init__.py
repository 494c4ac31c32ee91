"""Estimators of the literature that the paper does not compare: swarms, populations, gradients, adaptive filters."""

from hdt_estimators.ekf_pso import SwarmKalman
from hdt_estimators.evolution import DifferentialEvolution, Genetic
from hdt_estimators.fading import RecursiveLeastSquares
from hdt_estimators.gradient_descent import GradientDescent
from hdt_estimators.particle import ParticleFilter
from hdt_estimators.strong_tracking import StrongTracking

__all__ = [
    "DifferentialEvolution",
    "Genetic",
    "GradientDescent",
    "ParticleFilter",
    "RecursiveLeastSquares",
    "StrongTracking",
    "SwarmKalman",
]
