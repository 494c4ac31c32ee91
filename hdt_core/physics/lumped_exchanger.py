"""The paper's heat exchanger, equations (7) and (8): two states, each stream one stirred volume.

Its exchange is driven by the difference of the outlet temperatures, so it cannot represent an efficient exchanger: see
`effectiveness_ceiling` and docs/errata.md. `hdt_core.physics.heat_exchanger` is the default for health.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import numpy as np

from hdt_core.physics.heat_exchanger import CP_COLD_J_KG_K, CP_HOT_J_KG_K
from hdt_core.physics.model import Array, Equation, Param, PhysicsModel, Signal, State

Factors = tuple[Array, Array, Array, Array]
"""Entries of a 2 x 2 matrix, row by row: the state x, with x' = [[p, q], [r, s]] x, is multiplied by it each step."""
Form = Literal["quasi_steady", "exact", "euler", "tustin"]


def exact_factors(p: Array, q: Array, r: Array, s: Array, dt_s: float) -> Factors:
    """exp([[p, q], [r, s]] dt): the eigenvalues are real and below 0, so only decaying exponentials appear."""
    half_spread = np.sqrt(0.25 * (p - s) ** 2 + q * r)
    slow = np.exp((0.5 * (p + s) + half_spread) * dt_s)
    fast = np.exp((0.5 * (p + s) - half_spread) * dt_s)
    mean = 0.5 * (slow + fast)
    divisor = np.where(half_spread == 0.0, 1.0, half_spread)
    lean = np.where(half_spread == 0.0, dt_s * mean, 0.5 * (slow - fast) / divisor)
    return mean + 0.5 * (p - s) * lean, q * lean, r * lean, mean - 0.5 * (p - s) * lean


def tustin_factors(p: Array, q: Array, r: Array, s: Array, dt_s: float) -> Factors:
    """(I - A dt/2)^-1 (I + A dt/2): stable at any step, but it rings where the step exceeds the time constants."""
    p, q, r, s = (0.5 * dt_s * x for x in (p, q, r, s))
    det = (1.0 - p) * (1.0 - s) - q * r
    return ((1.0 - s) * (1.0 + p) + q * r) / det, 2.0 * q / det, 2.0 * r / det, ((1.0 - p) * (1.0 + s) + q * r) / det


def euler_factors(p: Array, q: Array, r: Array, s: Array, dt_s: float) -> Factors:
    """I + A dt: stable only where the step is well below the fastest time constant."""
    return 1.0 + p * dt_s, q * dt_s, r * dt_s, 1.0 + s * dt_s


def effectiveness_ceiling(hot_rate_w_k: Array, cold_rate_w_k: Array) -> Array:
    """Return the hot-side effectiveness that equations (7)-(8) reach at infinite H and never pass. [-]

    Parameters
    ----------
    hot_rate_w_k, cold_rate_w_k : array
        Heat-capacity rate, flow times specific heat, of each side. [W/K]

    Notes
    -----
    Two stirred volumes at one temperature: 1 / (1 + W_h C_h / (W_r C_c)). A real exchanger may do better, and then
    no H > 0 explains it.

    Examples
    --------
    >>> round(float(effectiveness_ceiling(np.float64(0.9), np.float64(1.6))), 3)
    0.64
    """
    return 1.0 / (1.0 + hot_rate_w_k / cold_rate_w_k)


def tied_coefficient_w_k(
    hot_flow_kg_s: Array, ram_flow_kg_s: Array, hot_in_k: Array, hot_out_k: Array, cold_in_k: Array
) -> Array:
    r"""H of equations (7)-(8) with H_h = H_c, in closed form from one steady sample. [W/K]

    Negative, or infinite, where the sample lies at or above `effectiveness_ceiling`: the model has no answer there.

    Notes
    -----
    At steady state only the ratio below enters, and the balance of heat forces H_h = H_c:

    .. math:: \kappa = \frac{T_{hi} - T_{ho}}{T_{ho} - T_{ci}}, \quad
       \frac{1}{H} = \frac{1}{\kappa W_h C_h} - \frac{1}{W_r C_c}

    Examples
    --------
    >>> operating = dict(hot_flow_kg_s=0.9, ram_flow_kg_s=1.6, hot_in_k=390.0, cold_in_k=250.0)
    >>> hot, _ = steady_outlets_k(**operating, hx_h_hot_w_k=2500.0, hx_h_cold_w_k=2500.0)
    >>> round(float(tied_coefficient_w_k(**operating, hot_out_k=hot)), 6)
    2500.0
    """
    inverse = (hot_out_k - cold_in_k) / ((hot_in_k - hot_out_k) * hot_flow_kg_s * CP_HOT_J_KG_K)
    with np.errstate(divide="ignore"):
        return 1.0 / (inverse - 1.0 / (ram_flow_kg_s * CP_COLD_J_KG_K))


def steady_outlets_k(
    *,
    hot_flow_kg_s: Array,
    ram_flow_kg_s: Array,
    hot_in_k: Array,
    cold_in_k: Array,
    hx_h_hot_w_k: Array,
    hx_h_cold_w_k: Array,
) -> tuple[Array, Array]:
    """Outlet temperatures in the steady state of equations (7) and (8), hot then cold. [K]

    Examples
    --------
    >>> operating = dict(hot_flow_kg_s=0.9, ram_flow_kg_s=1.6, hot_in_k=390.0, cold_in_k=250.0)
    >>> hot, cold = steady_outlets_k(**operating, hx_h_hot_w_k=2500.0, hx_h_cold_w_k=2500.0)
    >>> round(hot, 1), round(cold, 1)
    (317.4, 291.0)
    """
    a = hx_h_hot_w_k / (hot_flow_kg_s * CP_HOT_J_KG_K)
    b = hx_h_cold_w_k / (ram_flow_kg_s * CP_COLD_J_KG_K)
    span_k = (hot_in_k - cold_in_k) / (1.0 + a + b)
    return hot_in_k - a * span_k, cold_in_k + b * span_k


def rates_k_s(
    *,
    hot_flow_kg_s: Array,
    ram_flow_kg_s: Array,
    hot_in_k: Array,
    cold_in_k: Array,
    hx_h_hot_w_k: Array,
    hx_h_cold_w_k: Array,
    hx_mass_hot_kg: Array,
    hx_mass_cold_kg: Array,
    hot_volume_k: Array,
    cold_volume_k: Array,
) -> tuple[Array, Array]:
    """Equations (7) and (8): rate of change of the hot and the cold outlet temperature. [K/s]

    Both cold temperatures are printed as T_cc; read here as inlet where the ram air enters, and as outlet elsewhere.
    `hx_mass_*_kg` is the air-equivalent mass of stream and core: with the paper's own definition, the fluid alone, the
    time constants are 5 to 24 ms and nothing can be seen at 1 Hz.
    """
    across_k = hot_volume_k - cold_volume_k
    hot = hot_flow_kg_s * (hot_in_k - hot_volume_k) - hx_h_hot_w_k / CP_HOT_J_KG_K * across_k
    cold = ram_flow_kg_s * (cold_in_k - cold_volume_k) + hx_h_cold_w_k / CP_COLD_J_KG_K * across_k
    return hot / hx_mass_hot_kg, cold / hx_mass_cold_kg


def _matrix_per_s(
    *,
    hot_flow_kg_s: Array,
    ram_flow_kg_s: Array,
    hx_h_hot_w_k: Array,
    hx_h_cold_w_k: Array,
    hx_mass_hot_kg: Array,
    hx_mass_cold_kg: Array,
    **_: Any,
) -> Factors:
    """[[p, q], [r, s]] of equations (7) and (8) about their steady state."""
    hot_exchange = hx_h_hot_w_k / (hx_mass_hot_kg * CP_HOT_J_KG_K)
    cold_exchange = hx_h_cold_w_k / (hx_mass_cold_kg * CP_COLD_J_KG_K)
    return (
        -hot_flow_kg_s / hx_mass_hot_kg - hot_exchange,
        hot_exchange,
        cold_exchange,
        -ram_flow_kg_s / hx_mass_cold_kg - cold_exchange,
    )


_FACTORS: dict[str, Callable[..., Factors]] = {
    "exact": exact_factors, "euler": euler_factors, "tustin": tustin_factors,
}  # fmt: skip


def lumped_exchanger(form: Form = "exact") -> PhysicsModel:
    """Declare equations (7)-(8) in a form; `hx_h_loss` is the relative loss of both coefficients.

    Parameters
    ----------
    form : {"quasi_steady", "exact", "euler", "tustin"}
        `quasi_steady` has no states and needs no masses: at 1 Hz in cruise it is as accurate. `exact` propagates by the
        matrix exponential with constant inputs. `euler` and `tustin` are the sequential forms; Euler needs a step well
        below the fastest time constant.
    """
    if form == "quasi_steady":
        return PhysicsModel("lumped_exchanger", _INPUTS, _OUTPUTS, _COEFFICIENTS, _with_loss(steady_outlets_k))
    return PhysicsModel(
        "lumped_exchanger",
        _INPUTS,
        _OUTPUTS,
        _COEFFICIENTS + _MASSES,
        _with_loss(_read_volumes),
        _STATES,
        _with_loss(rates_k_s),
        _with_loss(partial(_step, _FACTORS[form])),
    )


def _step(
    factors_of: Callable[..., Factors],
    *,
    hot_volume_k: Array,
    cold_volume_k: Array,
    hx_mass_hot_kg: Array,
    hx_mass_cold_kg: Array,
    dt_s: float,
    **inputs: Any,
) -> tuple[Array, Array]:
    """Multiply the departure from the steady state by the factors; `inputs` are inputs and coefficients."""
    hot_k, cold_k = steady_outlets_k(**inputs)
    matrix = _matrix_per_s(hx_mass_hot_kg=hx_mass_hot_kg, hx_mass_cold_kg=hx_mass_cold_kg, **inputs)
    hh, hc, ch, cc = factors_of(*matrix, dt_s)
    above_hot_k = hot_volume_k - hot_k
    above_cold_k = cold_volume_k - cold_k
    return hot_k + hh * above_hot_k + hc * above_cold_k, cold_k + ch * above_hot_k + cc * above_cold_k


def _with_loss(equation: Equation) -> Equation:
    """Return the equation with both coefficients reduced by the loss, the health parameter."""

    def with_reduced_coefficients(*, hx_h_loss: Array, hx_h_hot_w_k: Array, hx_h_cold_w_k: Array, **others: Any) -> Any:
        share = 1.0 - hx_h_loss
        return equation(hx_h_hot_w_k=share * hx_h_hot_w_k, hx_h_cold_w_k=share * hx_h_cold_w_k, **others)

    return with_reduced_coefficients


def _read_volumes(*, hot_volume_k: Array, cold_volume_k: Array, **_: Any) -> tuple[Array, Array]:
    """Return the outlets: air leaves a stirred volume at the volume's temperature."""
    return hot_volume_k, cold_volume_k


_INPUTS = (
    Signal("hot_flow_kg_s", "kg/s", sigma=0.01),
    Signal("ram_flow_kg_s", "kg/s"),
    Signal("hot_in_k", "K", sigma=0.5),
    Signal("cold_in_k", "K", sigma=0.2),
)
_OUTPUTS = (Signal("hot_out_k", "K", sigma=0.5), Signal("ram_out_k", "K", sigma=0.5))
_COEFFICIENTS = (
    Param("hx_h_hot_w_k", "W/K", 2500.0, (1.0, 1e6), "design"),
    Param("hx_h_cold_w_k", "W/K", 2500.0, (1.0, 1e6), "design"),
    Param("hx_h_loss", "-", 0.0, (-0.5, 0.95), "health", drift=0.005),
)
_MASSES = (
    Param("hx_mass_hot_kg", "kg", 8.0, (0.01, 50.0), "design"),
    Param("hx_mass_cold_kg", "kg", 8.0, (0.01, 50.0), "design"),
)
_STATES = (State("hot_volume_k", "K", 320.0), State("cold_volume_k", "K", 290.0))
