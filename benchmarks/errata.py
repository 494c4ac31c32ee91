"""The numbers and the figure of docs/errata.md: `python -m benchmarks.errata [--folder DIR]`, for the figure."""

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

from benchmarks.harness import DOCS, Texts, run
from benchmarks.spring_mass_damper import PAPER
from hdt_benchmark.spring_mass_damper import euler_position_m
from hdt_core.physics.compressor import inlet_flow_kg_s, pressure_ratio
from hdt_core.physics.effectiveness import counterflow_effectiveness, crossflow_effectiveness
from hdt_core.physics.heat_exchanger import (
    CP_COLD_J_KG_K,
    CP_HOT_J_KG_K,
    HEAT_EXCHANGER,
    clean_conductance_w_k,
    measured_conductance_w_k,
    outlets_k,
)
from hdt_core.physics.lumped_exchanger import effectiveness_ceiling, lumped_exchanger, tied_coefficient_w_k

mpl.rcParams["svg.hashsalt"] = "hdt"  # the same figure, byte for byte, every time

HOT_KG_S, HOT_IN_K, COLD_IN_K = 0.9, 390.0, 250.0
RAM_KG_S = (1.0, 1.6, 2.5)


def tied_h(ua_w_k: np.ndarray, ram_kg_s: float) -> np.ndarray:
    """H that equations (7)-(8) give to a cross-flow exchanger of this UA in steady cruise."""
    hot_out, _ = outlets_k(HOT_KG_S, ram_kg_s, HOT_IN_K, COLD_IN_K, ua_w_k)
    return tied_coefficient_w_k(HOT_KG_S, ram_kg_s, HOT_IN_K, hot_out, COLD_IN_K)


def last_explained_ua_w_k(ram_kg_s: float) -> float:
    """Largest UA for which some H > 0 exists."""
    ua = np.linspace(300.0, 6000.0, 57001)
    return float(ua[tied_h(ua, ram_kg_s) > 0.0].max())


def fleet(ua_w_k: float, n_flights: int = 1500, seed: int = 1) -> tuple[float, float, float]:
    """Share of flights with no H, and relative sd of H where there is one, and of UA, over a fleet losing 0 to 30 %.

    30 samples a flight; hot flow 6 % and ram flow 20 % from flight to flight; the ram map 4 % off and each inlet sensor
    0.5 K, both constant over a flight; 0.5 K noise.
    """
    rng = np.random.default_rng(seed)
    points = 30
    design = {p.name: p.nominal for p in HEAT_EXCHANGER.free("design")} | {"hx_ua_reference_w_k": ua_w_k}

    def per_flight(mean: float, sd: float) -> np.ndarray:
        return np.repeat(mean + sd * rng.normal(size=n_flights), points)

    hot = per_flight(HOT_KG_S, 0.06 * HOT_KG_S)
    ram = np.maximum(per_flight(1.6, 0.32), 0.5)
    hot_in = per_flight(HOT_IN_K, 5.0)
    cold_in = per_flight(COLD_IN_K, 3.0)
    ua_share = 1.0 - np.repeat(np.linspace(0.0, 0.3, n_flights), points)
    hot_out, _ = outlets_k(hot, ram, hot_in, cold_in, ua_share * clean_conductance_w_k(hot, ram, **design))
    seen_ram = ram * (1.0 + per_flight(0.0, 0.04))
    seen_in, seen_out, seen_cold = (
        hot_in + per_flight(0.0, 0.5), hot_out + 0.5 * rng.normal(size=len(hot)), cold_in + per_flight(0.0, 0.5),
    )  # fmt: skip
    # all but the outlet is constant over a flight, so least squares is that of the mean outlet
    means = [column.reshape(-1, points).mean(axis=1) for column in (hot, seen_ram, seen_in, seen_out, seen_cold)]
    h_w_k = tied_coefficient_w_k(*means)
    ua_ratio = measured_conductance_w_k(*means) / clean_conductance_w_k(*means[:2], **design)
    explained = h_w_k > 0.0
    clean = np.arange(n_flights) < n_flights // 4
    spread = np.std(np.log(ua_ratio / ua_share[::points])[clean])
    ln_h = np.log(h_w_k[explained & clean])
    robust = 0.7413 * np.subtract(*np.quantile(ln_h, [0.75, 0.25])) if len(ln_h) > 20 else np.nan
    return float(np.mean(~explained)), float(robust), float(spread)


def untied_sd(ram_cv: float, points: int = 30) -> tuple[float, float, float, float]:
    """Relative sd of H_h and H_c free, their correlation, and sd of the tied H; 0.5 K noise, H 2500 W/K, Wr varied."""
    model = lumped_exchanger("quasi_steady")
    ram = 1.6 * (1.0 + ram_cv * np.sqrt(3.0) * np.linspace(-1.0, 1.0, points))
    inputs = {"hot_flow_kg_s": HOT_KG_S, "ram_flow_kg_s": ram, "hot_in_k": HOT_IN_K, "cold_in_k": COLD_IN_K}
    columns = []
    for name in ("hx_h_hot_w_k", "hx_h_cold_w_k"):
        outlet = model.predict({name: 2500.0 * (1.0 + 1e-30j)}, inputs)["hot_out_k"]
        columns.append(outlet.imag / 1e-30 / 0.5)
    free = np.array(columns) @ np.array(columns).T
    cov = np.linalg.inv(free)
    tied = 1.0 / np.sqrt(np.sum((columns[0] + columns[1]) ** 2))
    sd = np.sqrt(np.diag(cov))
    return float(sd[0]), float(sd[1]), float(cov[0, 1] / sd[0] / sd[1]), float(tied)


def time_constants_s(mass_kg: float) -> np.ndarray:
    """Slow and fast time constant of equations (7)-(8) at H 2500 W/K, cruise flows, the same mass on both sides."""
    model = lumped_exchanger("exact")
    values = model.nominal | {"hx_mass_hot_kg": mass_kg, "hx_mass_cold_kg": mass_kg}
    values |= {"hot_flow_kg_s": HOT_KG_S, "ram_flow_kg_s": 1.6, "hot_in_k": HOT_IN_K, "cold_in_k": COLD_IN_K}
    steps = ((0, 0), (1, 0), (0, 1))
    columns = [model.rates(**values, hot_volume_k=300.0 + a, cold_volume_k=280.0 + b) for a, b in steps]
    matrix = np.array([np.subtract(columns[1], columns[0]), np.subtract(columns[2], columns[0])]).T
    return np.sort(-1.0 / np.linalg.eigvals(matrix).real)[::-1]


def exact_fit_to_euler() -> np.ndarray:
    """Damping and stiffness that the exact equation finds in noise-free Euler data of c 0.5, k 2.0."""
    t = np.arange(1001) * 0.01
    euler = euler_position_m(np.sin(np.pi * t), 0.01, 0.5, 2.0)

    def residuals(theta: np.ndarray) -> np.ndarray:
        def rate(at: float, x: np.ndarray) -> list[float]:
            return [x[1], np.sin(np.pi * at) - theta[0] * x[1] - theta[1] * x[0]]

        return solve_ivp(rate, (0.0, 10.0), [0.0, 0.0], t_eval=t, rtol=1e-9, atol=1e-11).y[0] - euler

    return least_squares(residuals, [0.5, 2.0]).x


def resimulated(damping_n_s_m: float, stiffness_n_m: float) -> tuple[float, float]:
    """MSE [m2] and MAPE [-] of the position that these parameters give, against that of the truth: c 0.5, k 2.0.

    Set-up of section 3.2.2: 10 s at 0.01 s by Euler's rule, m 1 kg, F = sin(pi t) N. Nothing is estimated and nothing
    drawn: what table 1 prints goes in, what table 2 should print comes out.
    """
    force_n = np.sin(np.pi * 0.01 * np.arange(1001))
    truth = euler_position_m(force_n, 0.01, 0.5, 2.0)
    off = np.abs(euler_position_m(force_n, 0.01, damping_n_s_m, stiffness_n_m) - truth)
    return float(np.mean(off**2)), float(np.mean(off[truth != 0.0] / np.abs(truth[truth != 0.0])))


def compressor_eigenvalues() -> np.ndarray:
    """Eigenvalues of the information in ln A, ln D and beta, 5,345 points, flow to 2 %."""
    rng = np.random.default_rng(5)
    inlet_pa = rng.uniform(25e3, 50e3, 5345)
    inlet_k = rng.uniform(240, 265, 5345)
    speed = rng.uniform(2500, 3900, 5345)
    columns = []
    for i in range(3):
        ln_a, ln_d, beta = np.array([np.log(0.01), np.log(0.11), 0.61]) + 1e-30j * np.eye(3)[i]
        group = np.exp(ln_a + ln_d) * np.tan(beta)
        columns.append(np.log(inlet_flow_kg_s(group, inlet_pa, inlet_k, speed)).imag / 1e-30 / 0.02)
    eigenvalues = np.linalg.eigvalsh(np.array(columns) @ np.array(columns).T)
    rounding = 1e-12 * eigenvalues.max()
    return np.where(np.abs(eigenvalues) < rounding, 0.0, eigenvalues)


def figure(folder: Path) -> Path:
    """Three panels: effectiveness and ceilings, H against UA, share of flights without H against UA."""
    drawing = Figure(figsize=(13.5, 4.2), layout="constrained")
    left, middle, right = drawing.subplots(1, 3)
    ua = np.linspace(100.0, 3000.0, 600)
    for ram, colour in zip(RAM_KG_S, ("tab:red", "tab:blue", "tab:green"), strict=True):
        ntu = ua / (HOT_KG_S * CP_HOT_J_KG_K)
        ratio = HOT_KG_S / ram
        ceiling = effectiveness_ceiling(HOT_KG_S * CP_HOT_J_KG_K, ram * CP_COLD_J_KG_K)
        left.plot(ua, crossflow_effectiveness(ntu, ntu * ratio), color=colour, label=f"cross-flow, ram {ram} kg/s")
        left.axhline(ceiling, color=colour, linestyle="--", linewidth=1.0)
        h = tied_h(ua, ram)
        h[np.abs(h) > 40e3] = np.nan
        middle.plot(ua, h / 1e3, color=colour, label=f"ram {ram} kg/s")
        middle.axvline(last_explained_ua_w_k(ram), color=colour, linestyle=":", linewidth=1.0)
    ntu = ua / (HOT_KG_S * CP_HOT_J_KG_K)
    counterflow = counterflow_effectiveness(ntu, np.full_like(ntu, 0.9 / 1.6))
    left.plot(ua, counterflow, "k:", linewidth=1.0, label="counterflow, 1.6 kg/s")
    title = "Dashed: ceiling of equations (7)-(8)"
    left.set(xlabel="UA [W/K]", ylabel="hot-side effectiveness [-]", title=title, ylim=(0, 1))
    middle.axhline(0.0, color="k", linewidth=0.8)
    names = {"xlabel": "true UA [W/K]", "ylabel": "H fitted by (7)-(8) [kW/K]"}
    middle.set(**names, title="H runs through infinity", ylim=(-30, 30))
    uas = np.arange(600.0, 2601.0, 100.0)
    right.plot(uas, [100.0 * fleet(u, 400)[0] for u in uas], "o-", color="tab:purple", markersize=4)
    right.axvspan(1200.0, 2500.0, color="0.9", zorder=0, label="plausible pack exchanger")
    right.set(xlabel="clean UA at reference [W/K]", ylabel="flights with H <= 0 [%]", title="A fleet losing 0 to 30 %")
    for axis in (left, middle, right):
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "errata_lumped_exchanger.svg"
    drawing.savefig(path, metadata={"Date": None})
    return path


def main(folder: Path = DOCS / "plots") -> Texts:
    """Print every number, then draw."""
    print("tied H [W/K] of a cross-flow exchanger, hot 0.9 kg/s, 390/250 K")
    for ram in RAM_KG_S:
        row = "  ".join(f"UA {ua:.0f}: {tied_h(np.array([ua]), ram)[0]:8.0f}" for ua in (800.0, 1200.0, 1600.0, 2000.0))
        print(f"  ram {ram}: {row}; none above UA {last_explained_ua_w_k(ram):.0f}")
    for ua in (1200.0, 1600.0, 2000.0):
        none, h_sd, ua_sd = fleet(ua)
        spread = f"sd of ln H {h_sd:.2f}" if np.isfinite(h_sd) else "hardly an H"
        print(
            f"fleet of UA {ua:.0f}: no H for {100 * none:.0f} % of flights; of the clean: {spread}, ln UA {ua_sd:.3f}"
        )
    for cv in (0.01, 0.05, 0.2):
        hot, cold, correlation, tied = untied_sd(cv)
        print(
            f"ram flow varies {100 * cv:.0f} %: sd H_h {100 * hot:.1f} %, H_c {100 * cold:.1f} % "
            f"(correlation {correlation:.5f}), tied {100 * tied:.2f} %"
        )
    for mass in (0.03, 8.0):
        slow, fast = time_constants_s(mass)
        print(f"time constants with {mass} kg a side: {1e3 * fast:.0f} and {1e3 * slow:.0f} ms")
    print("information eigenvalues (ln A, ln D, beta):", *(f"{v:.1e}" for v in compressor_eigenvalues()))
    print(f"equation (5) at 0.1731 m, 36,500 rpm, 248 K: r_p {pressure_ratio(0.1731, 248.0, 36500 * np.pi / 30):.2f}")
    for top in (100.0, 500.0, 1000.0, 4095.0):
        slope_sd = 2.9304e-5 * top / np.sqrt(12.0)
        rest_sd = 0.0055 * np.sqrt(np.pi / 2.0)
        print(
            f"equation (6) over VDA 0-{top:.0f}: D at the end {0.1731 - 2.9304e-5 * top:.4f} m, "
            f"R2 {slope_sd**2 / (slope_sd**2 + rest_sd**2):.3f}"
        )
    for name, (c, k, mse, mape, _) in PAPER.items():
        own_mse, own_mape = resimulated(c, k)
        print(f"{name} c {c}, k {k}: MSE {own_mse:.2e} where {mse:g} is printed, MAPE {own_mape:.3f} where {mape:g} is")
    c, k = exact_fit_to_euler()
    print(f"exact equation fitted to noise-free Euler data: c {c:.4f}, k {k:.4f}")
    yield "", f"drew {figure(folder)}"


if __name__ == "__main__":
    run(main)
