"""The batched exchanger fits: truth recovered, SciPy's answer, each flight for itself."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from hdt_benchmark.exchanger import ExchangerSamples, fit_conductance_scale, fit_lumped_log
from hdt_core.physics.effectiveness import crossflow_effectiveness
from hdt_core.physics.heat_exchanger import HEAT_EXCHANGER, capacity_rates, clean_conductance_w_k, outlets_k
from hdt_core.physics.lumped_exchanger import lumped_exchanger, steady_outlets_k

COLUMNS = ("hot_flow_kg_s", "ram_flow_kg_s", "hot_in_k", "hot_out_k", "cold_in_k", "weight_per_k2")
DESIGN = {p.name: p.nominal for p in HEAT_EXCHANGER.free("design")}


def snapshots(lengths, loss, sigma_k=0.5, seed=0):
    """Cruise snapshots of flights of different lengths; loss is one number a flight."""
    rng = np.random.default_rng(seed)
    starts = np.concatenate([[0], np.cumsum(lengths)])
    n = starts[-1]
    hot, ram = 0.9 * rng.lognormal(0.0, 0.06, n), 1.6 * rng.lognormal(0.0, 0.15, n)
    hot_in, cold_in = 390.0 + 5.0 * rng.normal(size=n), 250.0 + 3.0 * rng.normal(size=n)
    clean = clean_conductance_w_k(hot, ram, **DESIGN)
    hot_out, _ = outlets_k(hot, ram, hot_in, cold_in, clean * (1.0 - np.repeat(loss, lengths)))
    measured_k = hot_out + sigma_k * rng.normal(size=n)
    return ExchangerSamples(
        hot, ram, hot_in, measured_k, cold_in, np.full(n, 1.0 / max(sigma_k, 0.01) ** 2), starts
    ), clean


def changed(samples, **columns):
    return ExchangerSamples(**({n: getattr(samples, n) for n in (*COLUMNS, "starts")} | columns))


def test_conductance_comes_back_without_noise():
    loss = np.linspace(-0.2, 0.8, 40)
    samples, clean = snapshots(np.full(40, 12), loss, sigma_k=0.0)
    fits = fit_conductance_scale(samples, clean)
    np.testing.assert_allclose(-np.expm1(fits.mean), loss, atol=2e-8)
    assert set(fits.status) == {"converged"}


def test_spread_is_what_the_information_says():
    """1,000 flights: standardised errors have mean 0 and standard deviation 1."""
    loss = np.full(1000, 0.15)
    samples, clean = snapshots(np.full(1000, 30), loss, seed=3)
    fits = fit_conductance_scale(samples, clean)
    standardised = (fits.mean - np.log1p(-loss)) / fits.sd
    assert abs(standardised.mean()) < 0.1
    assert standardised.std() == pytest.approx(1.0, abs=0.07)
    assert np.mean(fits.chi2) == pytest.approx(29.0, rel=0.03)


def test_conductance_agrees_with_scipy():
    samples, clean = snapshots(np.full(5, 30), np.array([0.0, 0.1, 0.2, 0.4, 0.6]), seed=5)
    fits = fit_conductance_scale(samples, clean)
    for f in range(5):
        at = slice(samples.starts[f], samples.starts[f + 1])
        flow, ram, hot_in, hot_out, cold_in, _ = (column[at] for column in samples.columns())
        rate, ratio = capacity_rates(flow, ram, hot_in, hot_out, cold_in)

        def residuals(theta, ntu=clean[at] / rate, ratio=ratio, span=hot_in - cold_in, cooled=hot_in - hot_out):
            ntu = np.exp(theta[0]) * ntu
            return 2.0 * (span * crossflow_effectiveness(ntu, ntu * ratio) - cooled)

        answer = least_squares(residuals, [0.0], method="lm", xtol=1e-12, ftol=1e-14)
        assert fits.mean[f] == pytest.approx(answer.x[0], abs=1e-6)
        assert fits.information[f] == pytest.approx((answer.jac.T @ answer.jac).item(), rel=1e-4)
        assert fits.chi2[f] == pytest.approx(2.0 * answer.cost, rel=1e-6)


def test_conductance_is_that_of_the_outlets():
    """Specific heats at the outlet of the model instead of the measured one: UA to a thousandth of its sd."""
    samples, clean = snapshots(np.full(5, 30), np.array([0.0, 0.1, 0.2, 0.4, 0.6]), seed=5)
    fits = fit_conductance_scale(samples, clean)
    for f in range(5):
        at = slice(samples.starts[f], samples.starts[f + 1])
        flows = samples.hot_flow_kg_s[at], samples.ram_flow_kg_s[at], samples.hot_in_k[at], samples.cold_in_k[at]

        def residuals(theta, flows=flows, at=at):
            return 2.0 * (samples.hot_out_k[at] - outlets_k(*flows, np.exp(theta[0]) * clean[at])[0])

        answer = least_squares(residuals, [0.0], method="lm", xtol=1e-12, ftol=1e-14)
        assert fits.mean[f] == pytest.approx(answer.x[0], abs=1e-3 * fits.sd[f])
        assert fits.information[f] == pytest.approx((answer.jac.T @ answer.jac).item(), rel=6e-3)
        assert fits.chi2[f] == pytest.approx(2.0 * answer.cost, rel=6e-3)


def test_ragged_flights_with_holes_keep_to_themselves():
    """Ragged flights, an empty one, missing values, impossible samples: each as if it were fitted alone."""
    rng = np.random.default_rng(7)
    lengths = rng.integers(0, 60, 200)
    lengths[5] = 0
    samples, clean = snapshots(lengths, rng.uniform(0.0, 0.5, 200), seed=7)
    holes = {
        n: np.where(rng.random(len(clean)) < 0.05, np.nan, getattr(samples, n)) for n in ("hot_flow_kg_s", "hot_out_k")
    }
    holes["ram_flow_kg_s"] = np.where(rng.random(len(clean)) < 0.02, 0.0, samples.ram_flow_kg_s)
    holes["cold_in_k"] = np.where(rng.random(len(clean)) < 0.02, samples.hot_in_k, samples.cold_in_k)
    broken = changed(samples, **holes)
    for fit in (fit_conductance_scale, lambda samples, _: fit_lumped_log(samples, 1.0, 8.0, 8.0)):
        together = fit(broken, clean)
        assert together.status[5] == "not_identifiable"
        assert np.isnan(together.mean[5])
        assert together.sd[5] == np.inf
        for f in range(0, 200, 20):
            at = slice(samples.starts[f], samples.starts[f + 1])
            columns = {n: getattr(broken, n)[at] for n in COLUMNS}
            alone = fit(ExchangerSamples(**columns, starts=np.array([0, lengths[f]])), clean[at])
            np.testing.assert_allclose(alone.mean[0], together.mean[f], rtol=1e-9, atol=1e-12)
            np.testing.assert_allclose(alone.information[0], together.information[f], rtol=1e-8)
            assert (alone.n_used[0], alone.code[0]) == (together.n_used[f], together.code[f])


def test_samples_that_say_nothing_are_passed_over():
    samples, clean = snapshots(np.array([30]), np.array([0.2]), seed=13)
    spoiled = samples.hot_out_k.copy()
    spoiled[::2] = 999.0
    weight = np.where(np.arange(30) % 2 == 0, 0.0, 4.0)
    every_other = ExchangerSamples(
        *(getattr(samples, n)[1::2] for n in ("hot_flow_kg_s", "ram_flow_kg_s", "hot_in_k", "hot_out_k", "cold_in_k")),
        np.full(15, 4.0),
        np.array([0, 15]),
    )
    left_out = fit_conductance_scale(changed(samples, hot_out_k=spoiled, weight_per_k2=weight), clean)
    assert left_out.n_used[0] == 15
    assert left_out.mean[0] == pytest.approx(fit_conductance_scale(every_other, clean[1::2]).mean[0], abs=1e-12)


def test_temperatures_no_exchanger_can_show():
    samples, clean = snapshots(np.array([10, 10]), np.zeros(2))
    warm = np.concatenate([samples.hot_in_k[:10] + 5.0, samples.cold_in_k[10:] - 5.0])
    fits = fit_conductance_scale(changed(samples, hot_out_k=warm), clean)
    assert set(fits.status) <= {"at_bound", "max_steps"}
    assert fits.mean[0] < -3.0
    assert fits.mean[1] > 3.0


@pytest.mark.parametrize(
    ("hot_flow", "ram_flow", "ua"), [(0.25, 0.35, 1800.0), (0.25, 0.25, 8e3), (0.9, 0.9, 6e4), (0.03, 9.0, 200.0)]
)
def test_many_transfer_units_need_more_terms(hot_flow, ram_flow, ua):
    """A small flow through a large exchanger: NTU of 6, 29 and 60; and far more ram than hot air."""
    n = 40
    hot, ram = np.full(n, hot_flow), np.full(n, ram_flow)
    clean = np.full(n, ua)
    hot_out, _ = outlets_k(hot, ram, 390.0, 250.0, 0.9 * clean)
    samples = ExchangerSamples(
        hot, ram, np.full(n, 390.0), hot_out, np.full(n, 250.0), np.full(n, 4.0), np.array([0, n])
    )
    assert fit_conductance_scale(samples, clean).mean[0] == pytest.approx(np.log(0.9), abs=1e-8)


def record(h_w_k=2300.0, seconds=900, mass_kg=8.0, sigma_k=0.0, seed=0):
    """A log simulated by the declared model in its Tustin form, with door steps."""
    t = np.arange(seconds)
    inputs = {
        "hot_flow_kg_s": 0.9 * (1.0 + 0.02 * np.sin(t / 30.0)),
        "ram_flow_kg_s": 1.6 * (1.0 + 0.2 * ((t // 100) % 2)),
        "hot_in_k": 390.0 + 3.0 * np.sin(t / 50.0),
        "cold_in_k": 250.0 + np.cos(t / 90.0),
    }
    h = {"hx_h_hot_w_k": h_w_k, "hx_h_cold_w_k": h_w_k}
    first = steady_outlets_k(**{k: v[0] for k, v in inputs.items()}, **h)
    masses = {"hx_mass_hot_kg": mass_kg, "hx_mass_cold_kg": mass_kg}
    states = dict(zip(("hot_volume_k", "cold_volume_k"), first, strict=True))
    hot_out = lumped_exchanger("tustin").simulate(h | masses, inputs, 1.0, states)["hot_out_k"]
    noisy = hot_out + sigma_k * np.random.default_rng(seed).normal(size=seconds)
    columns = (inputs["hot_flow_kg_s"], inputs["ram_flow_kg_s"], inputs["hot_in_k"], noisy, inputs["cold_in_k"])
    return ExchangerSamples(*columns, np.full(seconds, 4.0), np.array([0, seconds]))


@pytest.mark.parametrize("h_w_k", [400.0, 2300.0, 20000.0])
@pytest.mark.parametrize("mass_kg", [0.5, 8.0, 30.0])
def test_log_gives_back_what_the_declared_model_simulated(h_w_k, mass_kg):
    fit = fit_lumped_log(record(h_w_k, 300, mass_kg), 1.0, mass_kg, mass_kg)
    assert fit.mean[0] == pytest.approx(np.log(h_w_k), abs=1e-7)
    assert fit.status[0] == "converged"


def test_log_agrees_with_scipy_over_the_declared_model():
    samples = record(sigma_k=0.5, seconds=300)
    inputs = {
        "hot_flow_kg_s": samples.hot_flow_kg_s,
        "ram_flow_kg_s": samples.ram_flow_kg_s,
        "hot_in_k": samples.hot_in_k,
        "cold_in_k": samples.cold_in_k,
    }

    def residuals(theta):
        h = {"hx_h_hot_w_k": np.exp(theta[0]), "hx_h_cold_w_k": np.exp(theta[0])}
        first = steady_outlets_k(**{k: v[0] for k, v in inputs.items()}, **h)
        states = dict(zip(("hot_volume_k", "cold_volume_k"), first, strict=True))
        return 2.0 * (samples.hot_out_k - lumped_exchanger("tustin").simulate(h, inputs, 1.0, states)["hot_out_k"])

    fit = fit_lumped_log(samples, 1.0, 8.0, 8.0)
    answer = least_squares(residuals, [np.log(2500.0)], method="lm")
    assert fit.mean[0] == pytest.approx(answer.x[0], abs=1e-6)
    assert fit.information[0] == pytest.approx((answer.jac.T @ answer.jac).item(), rel=1e-4)


def test_a_gap_in_the_log_costs_only_its_samples():
    whole = record(sigma_k=0.3)
    hot_out, ram = whole.hot_out_k.copy(), whole.ram_flow_kg_s.copy()
    hot_out[100:150] = np.nan
    ram[20] = np.nan
    fit = fit_lumped_log(changed(whole, hot_out_k=hot_out, ram_flow_kg_s=ram), 1.0, 8.0, 8.0)
    assert fit.n_used[0] == 850
    assert fit.mean[0] == pytest.approx(fit_lumped_log(whole, 1.0, 8.0, 8.0).mean[0], abs=3.0 * fit.sd[0])
