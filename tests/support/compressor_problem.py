"""The compressor of equations (2)-(4) as an estimation problem: only a product of its parameters is identifiable."""

import numpy as np

from hdt_core.estimation import Problem, unknown

SPEED_RAD_S = np.linspace(2000.0, 3800.0, 40)
DENSITY_KG_M3 = np.linspace(0.4, 0.6, 40)
AREA_M2 = 0.0098
DIAMETER_M = 0.11
BETA_RAD = np.deg2rad(36.0)


def flow_kg_s(theta, i):
    """Equations (2)-(4): density, inlet area and axial velocity."""
    return DENSITY_KG_M3[i] * theta[0] * 0.5 * theta[1] * SPEED_RAD_S[i] * np.tan(theta[2])


def compressor(prior=None):
    truth = np.array([AREA_M2, DIAMETER_M, BETA_RAD])
    flow = flow_kg_s(truth, np.arange(40))
    return Problem(
        names=("area_m2", "diameter_m", "beta_rad"),
        bounds=np.array([[0.005, 0.02], [0.05, 0.2], [0.2, 1.0]]),
        prior=unknown(np.array([0.012, 0.126, 0.47])) if prior is None else prior,
        measured=(flow + 0.02 * np.random.default_rng(1).standard_normal(40) * flow)[:, None],
        sigma=np.array([0.02 * flow.mean()]),
        observe=lambda _x, theta, i: flow_kg_s(theta, i)[None],
    )
