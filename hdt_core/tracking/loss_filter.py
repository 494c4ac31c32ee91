"""Track a loss along its packs: the multiple-model filter, its smoother, and checkpoints from night to night."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import polars as pl

from hdt_core.calibration.arrays import Array
from hdt_core.components import Component
from hdt_core.physics.model import Param
from hdt_core.records.keys import LEG_AT, PACK
from hdt_core.tables.twin import TwinCheckpoints, TwinHealth
from hdt_core.tracking.checkpoints import checkpoint_rows, read_checkpoints
from hdt_core.tracking.flight_panel import FILTERED, fingerprints, health_rows, lay_out
from hdt_core.tracking.segments import SEGMENT_FLIGHTS, filter_segments
from hdt_core.tracking.wear_model import Settings

SMOOTHED = "kalman_smoothed"


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
        return {self.param.name: FILTERED, f"{self.param.name}_smoothed": SMOOTHED}


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
    loss : Loss
    previous : TrackResult, optional
        Of an earlier call, of these losses and others.
    seal : str
        All else that results rest on.
    """
    code = loss.component.code
    panel = lay_out(flights, loss.observations, maintenance, code, loss.component.ended_by, loss.unchecked)
    names = flights.select(pl.concat_str("flight_id", loss.status, separator="="))[:, 0].to_list()
    digests = fingerprints(panel, list(loss.more_variance), names, f"{seal}|{loss.settings}", SEGMENT_FLIGHTS)
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
    value, value_sd = loss.size * level, np.sqrt(sum(loss.more_variance, (loss.size * sd) ** 2))
    if loss.param.is_share:
        value, value_sd = loss_of(value, value_sd)
    names = (loss.component.code, parameter, loss.param.unit, loss.parameters[parameter])
    return health_rows(flights, names, value, value_sd, loss.status)


def loss_of(level: Array, sd: Array) -> tuple[Array, Array]:
    """Convert ln loss and its sd to a loss and its sd."""
    ratio = np.exp(-level)
    return 1.0 - ratio, ratio * sd
