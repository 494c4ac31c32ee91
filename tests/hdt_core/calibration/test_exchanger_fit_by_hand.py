"""The fleet fit against the same estimate by dense matrices: generalised least squares through instruments."""

from itertools import pairwise

import numpy as np
import pytest
from known_fleet import fleet_with_truth

from hdt_core.calibration import exchanger as hx
from hdt_core.calibration import exchanger_fit
from hdt_core.calibration.arrays import Points, cruise_samples, flights_of, level_points, to_points
from hdt_core.physics.installed_exchanger import clean_ram_flow_kg_s
from hdt_core.records.keys import PACK

P, B = len(hx.NAMES), len(hx.BIASES)


def slopes(function, points: Points, design, bias) -> np.ndarray:
    """Derivatives by design and bias, and the residual, (n, p + 6 + 1)."""
    at = bias[points.pack].T
    by_design = [
        (function(points.signals, design + e, at) - function(points.signals, design - e, at)) / 2e-5
        for e in 1e-5 * np.eye(P)
    ]
    by_bias = [
        (function(points.signals, design, at + e[:, None]) - function(points.signals, design, at - e[:, None])) / 2e-5
        for e in 1e-5 * np.eye(B)
    ]
    return np.stack([*by_design, *by_bias, function(points.signals, design, at)], axis=1)


def weights(columns: np.ndarray, averaged: np.ndarray, law_sd: float) -> np.ndarray:
    noise = ((columns[:, P:-1] * hx.NOISE_SDS) ** 2).sum(1) / np.minimum(averaged, 6.0)
    return 1.0 / (noise + law_sd**2)


def middle_flow(points: Points, design: np.ndarray) -> float:
    """Ln of ram over pack flow, the median of all points."""
    return np.nanmedian(np.log(clean_ram_flow_kg_s(points.signals, design) / points.signals["pack_flow_kg_s"]))


def levels(flight: np.ndarray, weight: np.ndarray, loose, effect: float):
    """From rows to means of flights, the precision of these, the covariance of health, the flight of each row."""
    flights, of = np.unique(flight, return_inverse=True)
    share = (of == np.arange(len(flights))[:, None]) * weight
    walked = np.r_[0.0, np.cumsum(np.diff(flights) * loose)]
    walk = 0.3**2 + 0.01**2 * effect * np.minimum(walked[:, None], walked)
    noise = np.diag(1.0 / share.sum(1) + 0.02**2 * effect)
    return share / share.sum(1)[:, None], np.linalg.inv(walk + noise), walk, of


def by_matrices(points: Points, bias_mean, bias_sd, iterations: int, *, ram_seen: bool):
    """Design and its covariance, and biases, after so many steps.

    A flight's mean ratio follows a walk of 0.01 a flight that begins within 0.3; it scatters by 0.02 about that, beyond
    its points' own error. Of neighbouring points ten count as one, forty where nothing shows the ram flow.
    """
    effect, n_packs = (10.0 if ram_seen else 40.0), len(bias_mean)
    design, bias, health, loose = hx.MEAN.copy(), bias_mean.copy(), np.zeros(len(points)), {}
    instruments = exchanger_fit.instruments_of(points.signals)
    for iteration in range(iterations):
        hot = slopes(hx.ln_conductance_ratio, points, design, bias)
        weight = weights(hot, points.n_samples, 0.01)
        if iteration:
            weight /= 1.0 + (hot[:, -1] - health) ** 2 * weight / 9.0
        weight /= effect
        rows = {k: np.flatnonzero(points.pack == k) for k in range(n_packs)}
        to_mean, whitened = {}, {}
        for k, own in rows.items():
            to_mean[k], *whitened[k] = levels(points.flight[own], weight[own], loose.get(k, 1.0), effect)
        own_z = sum(
            (to_mean[k] @ instruments[r]).T @ whitened[k][0] @ (to_mean[k] @ instruments[r]) for k, r in rows.items()
        )
        cross = sum(
            (to_mean[k] @ instruments[r]).T @ whitened[k][0] @ (to_mean[k] @ hot[r, :-1]) for k, r in rows.items()
        )
        explained = instruments @ np.linalg.solve(own_z, cross)
        normal, right = np.zeros((P + B * n_packs,) * 2), np.zeros(P + B * n_packs)
        ram = slopes(hx.ln_ram_flow_ratio, points, design, bias)
        ram_weight = weights(ram, points.n_samples, 0.015)
        if iteration:
            ram_weight /= 1.0 + ram[:, -1] ** 2 * ram_weight / 9.0
        for k, r in rows.items():
            at = np.r_[np.arange(P), P + B * k + np.arange(B)]
            within = hot[r] - (to_mean[k] @ hot[r])[whitened[k][2]]
            z, y = to_mean[k] @ explained[r], to_mean[k] @ hot[r, -1]
            gram = (within * weight[r, None]).T @ within
            gram[:-1, :-1] += z.T @ whitened[k][0] @ z
            gram[:-1, -1] += z.T @ whitened[k][0] @ y
            if ram_seen:
                gram += (ram[r] * ram_weight[r, None] / 10.0).T @ ram[r]
            normal[np.ix_(at, at)] += gram[:-1, :-1]
            right[at] -= gram[:-1, -1]
            sensors = at[P:]
            normal[sensors, sensors] += bias_sd[k] ** -2.0
            right[sensors] += (bias_mean[k] - bias[k]) / bias_sd[k] ** 2

        flow = [middle_flow(points, design + e) for e in 1e-5 * np.vstack([np.zeros(P), np.eye(P), -np.eye(P)])]
        slope = (np.array(flow[1 : P + 1]) - flow[P + 1 :]) / 2e-5
        normal[:P, :P] += np.diag(hx.SD**-2.0) + np.outer(slope, slope) / 0.15**2
        right[:P] += (hx.MEAN - design) / hx.SD**2 + slope * (np.log(1.5) - flow[0]) / 0.15**2
        step = np.clip(design + np.clip(np.linalg.solve(normal, right)[:P], -0.5, 0.5), hx.LOW, hx.HIGH) - design
        cov, bias_cov = np.linalg.inv(normal)[:P, :P], np.linalg.inv(normal[P:, P:])
        change = bias_cov @ (right[P:] - normal[P:, :P] @ step)
        design, bias = design + step, bias + change.reshape(n_packs, B)
        for k, r in rows.items():
            left = hot[r] @ np.r_[step, change[B * k : B * (k + 1)], 1.0]
            precision, walk, of = whitened[k]
            level = walk @ precision @ to_mean[k] @ left
            health[r] = level[of]
            if iteration >= 3:
                loose[k] = 1.0 + 1000.0 * (np.abs(np.diff(level)) > 0.04)
    return design, cov, bias


@pytest.fixture(scope="module")
def points() -> Points:
    """One aircraft, both packs, two points a flight; the right one's ratio jumps on its tenth flight."""
    samples = fleet_with_truth(1, 14, seed=11).samples
    packs = samples.select(PACK).unique().sort(PACK)
    coarse = to_points(level_points(cruise_samples(samples), flights_of(samples)), packs)
    two = {n: np.repeat(v, 2) for n, v in coarse.signals.items()}
    apart = np.tile([1.0, 1.003], len(coarse))
    two = two | {n: two[n] * apart for n in ("hx_in_k", "pack_flow_kg_s", "tat_k")}
    flight, pack = np.repeat(coarse.flight, 2), np.repeat(coarse.pack, 2)
    late = (pack == 1) & (flight >= 9)
    two["hx_out_k"] = two["hx_out_k"] + np.where(late, 15.0, 0.0)
    return Points(two, pack, flight + (flight > 4), np.tile([4.0, 9.0], len(coarse)))


@pytest.mark.parametrize("ram_seen", [True, False])
@pytest.mark.parametrize("iterations", [1, 2, 5])
def test_the_fit_is_least_squares_through_instruments(points, iterations, ram_seen, monkeypatch):
    if not ram_seen:
        blind = {**points.signals, "ram_out_k": np.full(len(points), np.nan)}
        points = Points(blind, points.pack, points.flight, points.n_samples)
    mean, sd = np.tile(0.2 * hx.BIAS_SDS, (2, 1)), np.tile(hx.BIAS_SDS, (2, 1))
    mean[1] *= -1.0
    monkeypatch.setattr(exchanger_fit, "ITERATIONS", iterations)
    fit = exchanger_fit.fit_exchanger(points, mean, sd)
    design, cov, bias = by_matrices(points, mean, sd, iterations, ram_seen=ram_seen)
    scale = np.sqrt(np.diag(cov))
    np.testing.assert_allclose((fit.mean - design) / scale, 0.0, atol=2e-3)
    np.testing.assert_allclose(fit.cov / np.outer(scale, scale), cov / np.outer(scale, scale), atol=2e-3)
    np.testing.assert_allclose(fit.bias / sd, bias / sd, atol=2e-3)
    assert fit.has_ram_outlet == ram_seen


@pytest.mark.parametrize("sure", [1.0, 1e-3])
def test_steps_end_from_the_seventh_on_where_the_design_stands_still(points, monkeypatch, sure):
    """Within a ten-thousandth in every coordinate; with a design that is known beforehand that is soon."""
    monkeypatch.setattr(hx, "SD", sure * hx.SD)
    mean, sd = np.zeros((2, B)), np.tile(hx.BIAS_SDS, (2, 1))
    designs, called, first_stage = [hx.MEAN], [], exchanger_fit._first_stage
    monkeypatch.setattr(exchanger_fit, "_first_stage", lambda *args: called.append(1) or first_stage(*args))
    whole = exchanger_fit.fit_exchanger(points, mean, sd)
    n = len(called)
    for iterations in range(1, n + 1):
        monkeypatch.setattr(exchanger_fit, "ITERATIONS", iterations)
        fit = exchanger_fit.fit_exchanger(points, mean, sd)
        designs.append(fit.mean)
        assert fit.converged == (np.abs(designs[-1] - designs[-2]).max() < 1e-4)
    small = [bool(np.abs(b - a).max() < 1e-4) for a, b in pairwise(designs)]
    assert whole.converged
    assert 7 <= n < 15
    assert small[-1]
    assert not any(small[6:-1])
    assert (n == 7) == (sure < 1.0)
