"""Track a loss along its packs: the multiple-model filter, its smoother, and checkpoints from night to night.

A checkpoint, rows of a table, holds the hypotheses about a pack at the start of a segment of its flights.
"""

import hashlib
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
import polars as pl

from hdt_core.calibration.arrays import Array
from hdt_core.components import Component
from hdt_core.physics.model import Param
from hdt_core.records.keys import LEG_AT, PACK
from hdt_core.tables.twin import TwinCheckpoints, TwinHealth
from hdt_core.tracking.multiple_model_filter import Hypotheses, join
from hdt_core.tracking.segments import SEGMENT_FLIGHTS, FlightPanel, filter_segments, lay_out
from hdt_core.tracking.wear_model import Settings

STATES = 5
LABELS = ("log_weight", "pace", "since", "unlogged", "faulty")
TRACK = [*PACK, "component", "parameter"]
PLACE = [*TRACK, "chapter"]
CHECKPOINT_KEY = [*PLACE, "seen"]
"""Of a segment; and with the digest of the flights before it. The table calls a segment a chapter."""
_EMPTY = pl.DataFrame(schema=TwinCheckpoints.types())


class TrackResult(NamedTuple):
    """Health parameters, table `twin_health`, and the checkpoints from which the next night goes on."""

    health: pl.DataFrame
    checkpoints: pl.DataFrame


def join_tracks(results: Iterable[TrackResult]) -> TrackResult:
    """Concatenate the results of several losses, packs or components."""
    none = TrackResult(TwinHealth.create_empty(), TwinCheckpoints.create_empty())
    return TrackResult(*map(pl.concat, zip(none, *results, strict=True)))


class Loss(NamedTuple):
    """A component's loss to track over flights, which stand in order.

    `observations` are ratio, variance and exposure of each flight, and `unchecked` the share of its sensors that none
    vouches for (see `wear_model.Observation`), wear in units of `size`; `more_variance` (n,) adds to that of the
    filtered ln loss; `status` is the rows'.
    """

    component: Component
    param: Param
    size: float
    settings: Settings
    observations: tuple[Array, Array, Array]
    status: pl.Expr
    more_variance: tuple[Array, ...] = ()
    unchecked: Array | None = None

    @property
    def parameters(self) -> dict[str, str]:
        """Estimator of each parameter: filtered, and smoothed."""
        method = self.component.estimator
        return {self.param.name: filtered(method), f"{self.param.name}_smoothed": f"{method}, smoothed"}


def filtered(method: str) -> str:
    """Name the estimator of a value that a filter made of its flight's own estimate and those before."""
    return f"{method}, filtered"


def track_loss(
    flights: pl.DataFrame, maintenance: pl.DataFrame, loss: Loss, previous: TrackResult | None = None, seal: str = ""
) -> TrackResult:
    """Filter and smooth a loss; packs whose earlier flights are unchanged continue from `previous`.

    Parameters
    ----------
    flights : DataFrame
        Whole packs, in order.
    maintenance : DataFrame
        `operator, tail, pack, component, action, done_on`; entries count from the day they name.
    previous : TrackResult, optional
        Of an earlier call, of these losses and others.
    seal : str
        All else that results rest on.
    """
    code = loss.component.code
    panel = lay_out(flights, loss.observations, maintenance, code, loss.component.ended_by, loss.unchecked)
    names = flights.select(pl.concat_str("flight_id", loss.status, separator="="))[:, 0].to_list()
    digests = fingerprints(
        panel, list(loss.more_variance), names, f"{seal}|{loss.component.estimator}|{loss.settings}", SEGMENT_FLIGHTS
    )
    packs = flights.select(PACK).unique(maintain_order=True)
    packs = packs.with_columns(component=pl.lit(code), parameter=pl.lit(loss.param.name))
    restart = read_checkpoints(previous and previous.checkpoints, packs, digests)
    result = filter_segments(panel, loss.settings, restart.begin, restart.checkpoints)
    is_new = pl.Series(np.isfinite(result.tracks[0]))
    tracks = zip(loss.parameters, (result.tracks[:2], result.tracks[2:]), strict=True)
    health = pl.concat(loss_rows(flights, loss, name, *track).filter(is_new) for name, track in tracks)
    if previous is not None and not is_new.all():
        is_own = (pl.col("component") == code) & pl.col("parameter").is_in(list(loss.parameters))
        old_rows = previous.health.filter(is_own).select(health.columns)
        old_rows = old_rows.join(flights.filter(~is_new).select(LEG_AT), on=LEG_AT, how="semi")
        if old_rows.height != len(loss.parameters) * (~is_new).sum():  # rows before the checkpoints have been removed
            return track_loss(flights, maintenance, loss, None, seal)
        health = pl.concat([old_rows, health])
    return TrackResult(health, checkpoint_rows(packs, digests, restart, result.checkpoints))


def loss_rows(flights: pl.DataFrame, loss: Loss, parameter: str, level: Array, sd: Array) -> pl.DataFrame:
    """Build the rows of a parameter from its ln loss and sd, in units of the loss's size."""
    value = loss.size * level
    value_sd = np.sqrt(sum(loss.more_variance, (loss.size * sd) ** 2))
    if loss.param.is_share:
        value, value_sd = loss_of(value, value_sd)
    names = (loss.component.code, parameter, loss.param.unit, loss.parameters[parameter])
    return health_rows(flights, names, value, value_sd, loss.status)


def loss_of(level: Array, sd: Array) -> tuple[Array, Array]:
    """Convert ln loss and its sd to a loss and its sd."""
    ratio = np.exp(-level)
    return 1.0 - ratio, ratio * sd


class Restart(NamedTuple):
    """Restart of packs: the segment of each (packs,), hypotheses at its start, rows that stay valid."""

    begin: Array
    checkpoints: dict[tuple[int, int], Hypotheses]
    valid: pl.DataFrame


def read_checkpoints(rows: pl.DataFrame | None, packs: pl.DataFrame, digests: list[list[str]]) -> Restart:
    """Select checkpoints before which no flight has changed; without `rows` every pack starts at its first flight.

    Smoothing reaches to the end of the next segment: the last segment whose earlier flights are all unchanged has
    changed the smoothed values of the one before it, so that one is filtered again.

    Parameters
    ----------
    rows : DataFrame, optional
        Of `checkpoint_rows`.
    packs : DataFrame
        `TRACK`, in order.
    digests : list of list of str
        Of `fingerprints`: digest of each pack's flights before each segment.
    """
    now = [(*packs.row(p), c, digest) for p, segments in enumerate(digests) for c, digest in enumerate(segments)]
    keys = pl.DataFrame(now, schema=_EMPTY.select(CHECKPOINT_KEY).schema, orient="row")
    rows = _EMPTY if rows is None else rows.select(_EMPTY.columns)
    valid = rows.join(keys, on=CHECKPOINT_KEY, how="semi").sort(*CHECKPOINT_KEY, "history")
    segments_of: dict[int, set[int]] = {p: {0} for p in range(packs.height)}
    number = {row: p for p, row in enumerate(packs.rows())}
    for *pack, segment in valid.select(PLACE).unique().rows():
        segments_of[number[tuple(pack)]].add(segment)
    begin = {p: max((c - 1 for c in segments if c - 1 in segments), default=0) for p, segments in segments_of.items()}
    checkpoints = {}
    restart_places = _places((*packs.row(p), c) for p, c in begin.items() if c)
    for key, own in valid.join(restart_places, on=PLACE, how="semi").group_by(PLACE, maintain_order=True):
        checkpoints[number[key[:-1]], int(str(key[-1]))] = _hypotheses(own)
    return Restart(np.array([begin[p] for p in range(packs.height)], dtype=np.int64), checkpoints, valid)


def checkpoint_rows(
    packs: pl.DataFrame, digests: list[list[str]], restart: Restart, starts: Mapping[tuple[int, int], Hypotheses]
) -> pl.DataFrame:
    """Return rows of the checkpoints that stay valid and of new ones; the first segment needs none."""
    valid = restart.valid.join(_places((*packs.row(p), c) for p, c in starts), on=PLACE, how="anti")
    places = [place for place in sorted(starts) if place[1]]
    rows = _rows([(*packs.row(p), c, digests[p][c]) for p, c in places], [starts[place] for place in places])
    return pl.concat([valid, rows]).sort(*CHECKPOINT_KEY, "history")


def _places(rows: Iterable[tuple[Any, ...]]) -> pl.DataFrame:
    return pl.DataFrame(list(rows), schema=_EMPTY.select(PLACE).schema, orient="row")


def _rows(keys: list[tuple[Any, ...]], parts: list[Hypotheses]) -> pl.DataFrame:
    if not parts:
        return _EMPTY
    b = join(parts)
    counts = [len(part.pack) for part in parts]
    columns: dict[str, Any] = {c: getattr(b, c) for c in LABELS}
    columns |= {"mean": b.mean.tolist(), "cov": b.cov.reshape(len(b.pack), STATES**2).tolist()}
    columns |= {"history": np.concatenate([np.arange(n) for n in counts])}
    rows = pl.DataFrame(keys, schema=_EMPTY.select(CHECKPOINT_KEY).schema, orient="row")
    return TwinCheckpoints.conform(
        pl.concat([rows[np.repeat(np.arange(len(keys)), counts)], pl.DataFrame(columns)], how="horizontal")
    )


def _hypotheses(rows: pl.DataFrame) -> Hypotheses:
    n = rows.height
    labels = {c: rows[c].to_numpy() for c in LABELS}
    mean, cov = (np.array(rows[c].to_list(), dtype=float) for c in ("mean", "cov"))
    identity = {"pack": np.zeros(n, dtype=np.int64), "parent": np.arange(n), "retention": np.ones((n, STATES))}
    return Hypotheses(mean=mean, cov=cov.reshape(n, STATES, STATES), **labels, **identity)


def fingerprints(panel: FlightPanel, inputs: list[Array], names: list[str], seal: str, segment: int) -> list[list[str]]:
    """Digest each pack's flights before flight 0, `segment`, twice `segment` ...: equal only for equal flights.

    Parameters
    ----------
    panel : FlightPanel
        The observations of each flight.
    inputs : list of array, each (rows,)
        Further inputs of a row's result.
    names : list of str, (rows,)
        Flights' names.
    seal : str
        All else that results rest on.
    """
    digests = []
    for pack, n in enumerate(panel.flights):
        rows = panel.row[:n, pack]
        columns = [*(v[:n, pack] for v in panel.observations), *(values[rows] for values in inputs)]
        matrix = np.column_stack(columns).astype(float)
        digest = hashlib.blake2b(seal.encode(), digest_size=10)
        pack_digests = []
        for first in range(0, n, segment):
            pack_digests.append(digest.copy().hexdigest())
            digest.update(matrix[first : first + segment].tobytes())
            digest.update("|".join(names[r] for r in rows[first : first + segment]).encode())
        digests.append(pack_digests)
    return digests


def health_rows(
    flights: pl.DataFrame,
    names: tuple[str, str, str, str],
    value: Array | pl.Series,
    sd: Array | pl.Series,
    status: pl.Expr,
) -> pl.DataFrame:
    """Build rows of one parameter in long form; `names` are component, parameter, unit and estimator."""
    component, parameter, unit, estimator = map(pl.lit, names)
    columns = {"component": component, "parameter": parameter, "unit": unit, "status": status, "estimator": estimator}
    rows = flights.select(*LEG_AT, value=pl.Series(value), sd=pl.Series(sd), **columns)
    return rows.select(*LEG_AT, "component", "parameter", "value", "sd", "unit", "status", "estimator")
