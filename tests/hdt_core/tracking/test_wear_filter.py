"""The wear filter against an enumeration of every hypothesis, one 5-vector at a time, with its numbers written out."""

from typing import Any, NamedTuple

import numpy as np
import pytest
from scipy.stats import norm, truncnorm

from hdt_core.tracking import multiple_model_filter as mmf
from hdt_core.tracking.multiple_model_filter import Hypotheses, join, normalise, prune, start
from hdt_core.tracking.segments import smooth, wear_summary
from hdt_core.tracking.wear_model import Observation, Settings

PACES = [(0.45, 1.5e-4, 2e-4, 4e-5, 4e-5), (0.45, 1e-3, 8e-4, 6e-5, 6e-5), (0.10, 6e-3, 4e-3, 6e-5, 5e-4)]
UNCHECKED = 0.6
"""Share of the ratio's sensors that no other vouches for."""
ENTRY = [(0.50, 0.004, 0.005), (0.20, 0.030, 0.020), (0.18, 0.090, 0.040), (0.12, 0.200, 0.080)]
SETTINGS = Settings(level=0.02, level_sd=0.01, offset_sd=0.05, wash_share=0.25)
ROW = np.array([-1.0, 0.0, 1.0, 1.0, 1.0])


class One(NamedTuple):
    """A hypothesis: log weight, mean, cov, pace, flights since renewal, unlogged, faulty; and how it came about."""

    lw: float
    m: np.ndarray
    p: np.ndarray
    pace: int
    since: int
    unlogged: bool = False
    faulty: bool = False
    parent: int = -1
    event: np.ndarray = np.ones(5)
    move: Any = None
    before: Any = None


def renew(h: One, chance: float, unlogged: bool) -> list[One]:
    children = []
    for j, (share, rate, rate_sd, *_) in enumerate(PACES):
        drop = np.diag([0.0, 0.0, 1.0, 0.0, 1.0])
        m = drop @ h.m
        p = drop @ h.p @ drop
        m[:2] = 0.003, rate
        p += np.diag([0.006**2, rate_sd**2, 0.0, 0.04**2, 0.0])
        event = h.event * drop.diagonal()
        child = h._replace(lw=h.lw + np.log(share * chance), m=m, p=p, pace=j, since=0, unlogged=unlogged, event=event)
        children.append(child)
    return children


def wash(h: One, chance: float, leaves: float, leaves_sd: float) -> One:
    keep = np.diag([leaves, 1.0, 1.0, 1.0, 1.0])
    more = np.diag([leaves_sd**2 * (h.m[0] ** 2 + h.p[0, 0]), PACES[h.pace][2] ** 2, 0.0, 0.0, 0.0])
    event = h.event * keep.diagonal()
    return h._replace(lw=h.lw + np.log(chance), m=keep @ h.m, p=keep @ h.p @ keep + more, since=0, event=event)


def wear_out(h: One, chance: float, more: float, more_sd: float) -> One:
    wear = np.array([1.0, 0, 0, 0, 0])
    return h._replace(lw=h.lw + np.log(chance), m=h.m + more * wear, p=h.p + more_sd**2 * np.diag(wear))


def pass_flight(h: One, row: int) -> One:
    """One flight later: the rate's noise a variance, the map's error a stationary process of forty flights."""
    keep = 1.0 if h.faulty else np.exp(-1.0 / 40.0)
    move = np.diag([1.0, 1.0, 1.0, 1.0, keep])
    move[0, 1] = 1.0
    *_, late, early = PACES[h.pace]
    rate_step = late + (early - late) * np.exp(-(h.since + 1) / 20.0)
    noise = [7e-4**2, rate_step**2, 0.0, 0.0, 0.005**2 if h.faulty else 0.005**2 * (1.0 - keep**2)]
    return h._replace(
        lw=h.lw + (np.log(29 / 30) if h.faulty else 0.0), m=move @ h.m, p=move @ h.p @ move.T + np.diag(noise),
        since=h.since + 1, parent=row, event=np.ones(5), move=move,
    )  # fmt: skip


def apply_log(h: One, due: int, log_kept: bool) -> list[One]:
    """What an entry, or its absence on the ninth flight, does: 1 washed, 2 replaced."""
    recent = h.since <= 8
    missing = h.unlogged and h.since == 9 and log_kept
    h = h._replace(lw=h.lw + (np.log(0.03) if missing else 0.0), unlogged=h.unlogged and not due and not missing)
    if not due or recent:
        return [h]
    not_done = h._replace(lw=h.lw + np.log(0.02 / 60))
    return [not_done, *(renew(h, 1 / 60, h.unlogged) if due == 2 else [wash(h, 1 / 60, 0.3, 0.2)])]


def branch(h: One, ratio: float, variance: float, opened: int) -> list[One]:
    off = ratio - SETTINGS.level - ROW @ h.m
    sd = np.sqrt(ROW @ h.p @ ROW + variance)
    surprised = abs(off) > 2.0 * sd
    open_kind = opened if h.since > 8 else 0
    children = [h._replace(lw=h.lw + (np.log(0.5) if open_kind else 0.0))]
    if open_kind:
        children += renew(h, 0.5 / 60, h.unlogged) if open_kind == 2 else [wash(h, 0.5 / 60, 0.3, 0.2)]
    if surprised and off > 0 and not open_kind:
        children += [*renew(h, 0.75 / 400, True), wash(h, 1 / 2000, 0.35, 0.3)]
        children.append(wash(h, 0.25 / 400, 0.3, 0.2)._replace(unlogged=True))
    if surprised and off < 0:
        children += [wear_out(h, 1 / 200, 0.02, 0.02), wear_out(h, 1 / 2000, 0.17, 0.17)]
    if surprised and h.faulty:
        mask = np.diag([1.0, 1.0, 1.0, 1.0, 0.0])
        p = mask @ h.p @ mask + np.diag([0, 0, 0, 0, 0.005**2])
        event = h.event * mask.diagonal()
        children.append(h._replace(lw=h.lw + np.log(1 / 30), m=mask @ h.m, p=p, faulty=False, event=event))
    elif surprised:
        p = h.p + np.diag([0, 0, 0, 0, 0.2**2])
        children.append(h._replace(lw=h.lw + np.log(UNCHECKED / 700), p=p, faulty=True))
    return children


def update_one(h: One, ratio: float, variance: float) -> One:
    """Bayes' rule for a flight of which one in a hundred is an outlier of sd 0.3, the two cases merged by moments."""
    total = ROW @ h.p @ ROW + variance
    off = ratio - SETTINGS.level - ROW @ h.m
    sound = 0.99 * norm.pdf(off, scale=np.sqrt(total))
    stray = 0.01 * norm.pdf(off, scale=np.sqrt(total + 0.3**2))
    use = sound / (sound + stray)
    gain = h.p @ ROW / total
    p = h.p - np.outer(gain, gain) * total * use + use * (1.0 - use) * off**2 * np.outer(gain, gain)
    return h._replace(lw=h.lw + np.log(sound + stray), m=h.m + use * gain * off, p=p, before=h)


def one_flight(states: list[One], ratio, variance, exposure, opened, due, log_kept) -> list[One]:
    wear = max(sum(np.exp(h.lw) * h.m[0] for h in states), 0.0)
    at_reference = ratio + np.log(1.0 + (np.exp(wear) - 1.0) * exposure) - wear
    aged_states = [b for row, h in enumerate(states) for b in apply_log(pass_flight(h, row), due, log_kept)]
    if np.isnan(ratio):
        after = [h._replace(before=h) for h in aged_states]
    else:
        split = [b for h in aged_states for b in branch(h, at_reference, variance, opened)]
        after = [update_one(h, at_reference, variance) for h in split]
    total = np.log(sum(np.exp(h.lw) for h in after))
    return [h._replace(lw=h.lw - total) for h in after]


def above_zero(weight, mean, sd) -> tuple[float, float]:
    """Mean and sd of normals cut off below 0."""
    weight, mean, sd = (np.array(v) for v in (weight, mean, sd))
    means, variances = truncnorm.stats(-mean / sd, np.inf, mean, sd, moments="mv")
    middle = weight @ means
    return middle, np.sqrt(weight @ (variances + (means - middle) ** 2))


def first(n_states: int, since: int = 3) -> list[One]:
    """Of a pack worn by 0.1 and, with a second state, of one that is faulty."""
    cov = np.diag([0.03**2, 8e-4**2, 0.04**2, 0.03**2, 0.005**2])
    cov[0, 2] = cov[2, 0] = 0.5 * 0.03 * 0.04
    sound = One(np.log(0.8 if n_states > 1 else 1.0), np.array([0.1, 1e-3, 0.01, -0.01, 0.0]), cov, 1, since)
    sick = One(np.log(0.2), np.array([0.05, 6e-3, 0.0, 0.01, -0.06]), 1.2 * cov, 2, 30, faulty=True)
    return [sound, sick][:n_states]


def flat(states: list[One]) -> Hypotheses:
    k = len(states)
    columns = [np.array([getattr(h, name) for h in states]) for name in ("lw", "m", "p", "pace", "since")]
    flags = [np.array([getattr(h, name) for h in states]) for name in ("unlogged", "faulty")]
    return Hypotheses(np.zeros(k, dtype=int), *columns, *flags, np.arange(k), np.ones((k, 5)))


NAN = float("nan")
# ratio, exposure, log open, log due, log kept of ten flights
QUIET = [(-0.08, 1.0, 0, 0, 0), (-0.1, 1.2, 0, 0, 0), (NAN, 1.0, 0, 0, 0), (-0.09, 0.8, 0, 0, 0)]
CASES = {
    "clog, then a fault that passes": [*QUIET, (-0.27, 1.0, 0, 0, 0), (-0.28, 1.1, 0, 0, 0), (-0.08, 0.9, 0, 0, 0)],
    "another core, never logged": [*QUIET[:2], (0.13, 1.0, 0, 0, 0), *[(0.06, 1.0, 0, 0, 1)] * 9, QUIET[0]],
    "replaced by the log": [*QUIET, (0.06, 1.0, 2, 0, 1), (0.07, 1.1, 2, 2, 1), (0.05, 1.0, 0, 0, 1), *QUIET[:2]],
    "washed by the log": [*QUIET, (0.0, 1.0, 1, 0, 1), (0.01, 1.1, 1, 1, 1), (-0.02, 1.0, 0, 0, 1), QUIET[0]],
    "an entry counts from the ninth flight on, never before": [*QUIET, (-0.09, 1.0, 2, 2, 1), (-0.08, 1.0, 1, 0, 1)],
    "an entry on a silent day": [*QUIET[:2], (NAN, 1.0, 2, 2, 1), *[(0.03, 1.0, 0, 0, 1)] * 3],
}


@pytest.fixture(scope="module", params=CASES, ids=lambda c: c.replace(" ", "-"))
def recursions(request: pytest.FixtureRequest) -> tuple[list[list[One]], list[Hypotheses], list[Any]]:
    """Enumerated states after each flight, the filter's with nothing dropped or merged, and its branchings."""
    start = first(1, since=3) if "never" in request.param else first(2, since=30)
    enumerated = [start]
    filtered = [flat(start)]
    branchings = []
    with pytest.MonkeyPatch.context() as patched:
        for name, value in {"LEAST_WEIGHT": 1e-290, "WEAR_BIN": 1e-13, "MOST": 10**6}.items():
            patched.setattr(mmf, name, value)
        for ratio, exposure, *log in CASES[request.param]:
            enumerated.append(one_flight(enumerated[-1], ratio, 5e-4, exposure, *log))
            observation = Observation(*(np.array([v]) for v in (ratio, 5e-4, exposure, *log, UNCHECKED)))
            after, branching = mmf.step(filtered[-1], observation, SETTINGS)
            filtered.append(after)
            branchings.append(branching)
    return enumerated, filtered, branchings


def unite(states: list[One]) -> list[tuple[Any, ...]]:
    """Weight and numbers of each state; those that came about in two ways, by the log and beside it, are one."""
    weights: dict[tuple[Any, ...], float] = {}
    numbers: dict[tuple[Any, ...], tuple[Any, ...]] = {}
    for h in states:
        row = (h.m[0], h.m.sum(), h.p.sum(), h.pace, h.since, h.unlogged, h.faulty)
        key = tuple(np.round(np.array(row, float), 11))
        weights[key] = weights.get(key, 0.0) + np.exp(h.lw)
        numbers[key] = row
    return [(weights[key], *numbers[key]) for key in weights]


def test_filter_equals_enumeration(recursions):
    for states, batch in zip(*recursions[:2], strict=True):
        ours = sorted(zip(np.exp(batch.log_weight), batch.mean[:, 0], batch.mean.sum(1), batch.cov.sum((1, 2)),
                          batch.pace, batch.since, batch.unlogged, batch.faulty, strict=True))  # fmt: skip
        by_hand = sorted(unite(states))
        assert len(ours) == len(by_hand)
        np.testing.assert_allclose(np.array(ours, float), np.array(by_hand, float), rtol=1e-6, atol=1e-12)
        mean, sd = wear_summary(batch, 1)
        expected = above_zero(*zip(*((np.exp(h.lw), h.m[0], np.sqrt(h.p[0, 0])) for h in states), strict=True))
        np.testing.assert_allclose((mean[0], sd[0]), expected, rtol=1e-6)


def test_smoother_equals_every_path(recursions):
    """Each last hypothesis walked back to the first by itself; those through one state merged by their moments."""
    enumerated, filtered, branchings = recursions
    smoothed = smooth(filtered[1:], branchings)
    paths = [(np.exp(h.lw), h, h.m, h.p) for h in enumerated[-1]]
    for k in range(len(enumerated) - 1, 0, -1):
        nodes: dict[int, list[Any]] = {}
        for w, h, m, p in paths:
            nodes.setdefault(id(h), []).append((w, m[0], p[0, 0]))
        merged = []
        for rows in nodes.values():
            w, m, p = np.array(rows).T
            mean = w @ m / w.sum()
            merged.append((w.sum(), mean, np.sqrt(w @ (p + (m - mean) ** 2) / w.sum())))
        np.testing.assert_allclose(np.ravel(smoothed[k - 1]), above_zero(*zip(*merged, strict=True)), rtol=1e-5)
        back = []
        for w, h, m, p in paths:
            up = enumerated[k - 1][h.parent]
            gain = up.p @ (np.diag(h.event) @ h.move).T @ np.linalg.inv(h.before.p)
            back.append((w, up, up.m + gain @ (m - h.before.m), up.p + gain @ (p - h.before.p) @ gain.T))
        paths = back


def test_start_spans_every_hypothesis():
    """Every pace and every wear at entry."""
    states = start(SETTINGS)
    assert states.pack.tolist() == [0] * 12
    shares = [p[0] * e[0] for p in PACES for e in ENTRY]
    np.testing.assert_allclose(np.exp(states.log_weight), shares)
    np.testing.assert_allclose(states.mean[:, :2], [(e[1], p[1]) for p in PACES for e in ENTRY])
    assert not states.mean[:, 2:].any()
    assert states.pace.tolist() == [0] * 4 + [1] * 4 + [2] * 4
    assert {len(column) for column in states} == {12}


def test_start_covariance_by_hand():
    """Of the offset 0.05 the unit has 0.04, the sensors the rest, 0.03, and the level's own error."""
    rest = (0.03**2 + 0.01**2, 0.04**2, 0.005**2)
    expected = [np.diag([e[2] ** 2, p[2] ** 2, *rest]) for p in PACES for e in ENTRY]
    np.testing.assert_allclose(start(SETTINGS).cov, expected)


def test_start_has_no_event_behind():
    states = start(SETTINGS)
    assert (states.since[:4] == [0, 10**6, 10**6, 10**6]).all()
    assert not (states.faulty | states.unlogged).any()


def test_wear_is_never_negative():
    """Of a normal variable a hundred deviations below 0 as much is left above as of one thirty below: sd / 30."""
    below = flat(first(1))._replace(mean=np.array([[-1.0, 0, 0, 0, 0]]), cov=np.diag([1e-4] * 5)[None])
    mean, sd = (v[0] for v in wear_summary(below, 1))
    assert (mean, sd) == pytest.approx((0.01 / 30, 0.01 / 30), rel=0.05)


@pytest.mark.parametrize(
    ("level_sd", "offset_sd", "sensors_sd"), [(0.02, 0.041, np.hypot(0.015, 0.02)), (0.0, 0.05, 0.03)]
)
def test_sensors_keep_their_own_spread(level_sd, offset_sd, sensors_sd):
    assert Settings(0.0, level_sd, offset_sd).sensors_sd == pytest.approx(sensors_sd)


def some(weights: list[float], wear: list[float], pack: list[int] | None = None, **changes: Any) -> Hypotheses:
    k = len(weights)
    states = [One(np.log(w), np.array([x, 1e-3, 0, 0, 0]), np.diag([1e-4, 1e-6, 1e-3, 1e-3, 1e-5]), 1, r)
              for r, (w, x) in enumerate(zip(weights, wear, strict=True))]  # fmt: skip
    return flat(states)._replace(pack=np.array(pack or [0] * k), **changes)


def test_like_hypotheses_are_merged():
    """Within a bin of 0.01 of wear, alike in pace and fault; the labels are the heavier one's."""
    after, into = prune(some([0.5, 0.3, 0.15, 0.05], [0.1, 0.104, 0.106, 0.1], faulty=np.array([0, 0, 0, 1]) > 0))
    assert into.tolist() == [0, 0, 1, 2]
    np.testing.assert_allclose(np.exp(after.log_weight), [0.8, 0.15, 0.05])
    assert after.mean[0, 0] == pytest.approx((0.5 * 0.1 + 0.3 * 0.104) / 0.8)
    assert after.cov[0, 0, 0] == pytest.approx(1e-4 + 0.5 * 0.3 / 0.8**2 * 0.004**2)
    assert after.since.tolist() == [0, 2, 3]


def test_light_hypotheses_are_dropped():
    after, into = prune(some([1.0 - 1e-6, 0.999e-6, 1.001e-6], [0.0, 0.05, 0.1]))
    assert into.tolist() == [0, -1, 1]
    assert np.exp(after.log_weight).sum() == pytest.approx(1.0)


def test_forty_hypotheses_of_pack_remain():
    weights = np.arange(1.0, 46.0) / np.arange(1.0, 46.0).sum()
    after, into = prune(some([*weights, 1.0], [*(0.02 * np.arange(45)), 0.0], [0] * 45 + [1]))
    assert after.pack.tolist() == [0] * 40 + [1]
    assert into.tolist() == [-1] * 5 + list(range(39, -1, -1)) + [40]
    np.testing.assert_allclose(np.exp(after.log_weight[:40]), weights[44:4:-1] / weights[5:].sum())


def test_weights_sum_to_one_per_pack():
    weights = np.exp(normalise(some([2.0, 6.0, 5.0], [0.0] * 3, [0, 0, 1])).log_weight)
    np.testing.assert_allclose(weights, [0.25, 0.75, 1.0])


def test_packs_join_side_by_side():
    many = join([some([1.0], [0.1]), some([0.5, 0.5], [0.2, 0.3], [1, 1])])
    assert many.n_packs == 2
    assert many.of(1).mean[:, 0].tolist() == [0.2, 0.3]
    assert many.of_first(1).mean[:, 0].tolist() == [0.1]
    assert many.of_first(2) is many
