"""Chance of a message after each choice at the next stop: defer, wash or replace.

The forecast is the unit's own, from the loss that the work leaves, at the unit's pace and demand. A replacement leaves
no loss; a wash leaves a share that the fleet's washes after like losses and findings show, with the twin's prior as one
wash more.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import timedelta

import numpy as np
import polars as pl

from hdt_core.components import components
from hdt_core.components.declaration import CLEANED, INSPECTED, NO_FAULT, REPLACED
from hdt_core.margin.first_passage import NODES
from hdt_core.prognosis.hazard import AHEAD
from hdt_core.records.keys import PACK
from hdt_core.records.recoveries import LATE_DAYS, RECOVERY_FLIGHTS
from hdt_core.robust import Array
from hdt_core.tracking.multiple_model_filter import WASH_LEAVES, WASH_LEAVES_SD

DEFER, WASH, REPLACE = CHOICES = ("defer", "wash", "replace")
"""In order of the loss that they leave, the greatest first."""
ACTION = {WASH: CLEANED, REPLACE: REPLACED}
LEAST_WASHES, LIKE_LOSS = 5, 0.1
"""Washes from which on a fleet's own count, and how far the loss before them may be from that at hand. [-]"""
EVENTS = [f"p_event_{ahead}" for ahead in AHEAD]
PRIOR = "prior"
FAULT_OF_UNIT = pl.Schema({"operator": pl.String, "tail": pl.String, "pack": pl.Int32, "fault": pl.String})

Predict = Callable[[Array, Array], pl.DataFrame]
"""Predict some units, by number, from other losses: the columns of `prognoses`."""


@dataclass(frozen=True, slots=True)
class Washes:
    """Washes on record.

    Attributes
    ----------
    loss : ndarray, shape (washes,)
        Before the wash. [-]
    share_left, share_left_sd : ndarray, shape (washes,)
        Share of it that was left, and its standard deviation. [-]
    fault : ndarray of str, shape (washes,)
        What the log has found of the part that was washed, else empty.
    inspected : DataFrame
        `PACK`, `fault`: of units in service, what an inspection found since their last work.
    """

    loss: Array
    share_left: Array
    share_left_sd: Array
    fault: np.ndarray
    inspected: pl.DataFrame = field(default_factory=lambda: pl.DataFrame(schema=FAULT_OF_UNIT))

    def faults_of(self, units: pl.DataFrame) -> np.ndarray:
        """Return what was found of each unit (`PACK`), empty where nothing was. (n,)"""
        faults = units.select(PACK).join(self.inspected, on=PACK, how="left", maintain_order="left", validate="m:1")
        return faults["fault"].fill_null("").to_numpy()

    def _are_like(self, loss: Array, fault: np.ndarray) -> Array:
        """Whether each wash counts for each unit: (n, washes), none where there are too few."""
        is_near = np.abs(loss[:, None] - self.loss) <= LIKE_LOSS
        are_like = is_near & ((fault[:, None] == "") | (fault[:, None] == self.fault))
        return np.asarray(are_like & (are_like.sum(axis=1) >= LEAST_WASHES)[:, None])

    def share_left_of(self, loss: Array, fault: np.ndarray) -> tuple[Array, Array]:
        """Return the mean and spread of the share that a wash leaves of each loss. (n,) each"""
        weight = self._are_like(loss, fault) / (1.0 + (self.share_left_sd / WASH_LEAVES_SD) ** 2)
        total = 1.0 + weight.sum(axis=1)
        mean = (WASH_LEAVES + weight @ self.share_left) / total
        scatter = (weight * (self.share_left - mean[:, None]) ** 2).sum(axis=1)
        variance = (WASH_LEAVES_SD**2 + (WASH_LEAVES - mean) ** 2 + scatter) / total
        return mean, np.sqrt(variance)

    def losses_left(self, loss: Array, fault: np.ndarray) -> Array:
        """Return equally likely losses that a wash may leave of each loss, none above it. (n, len(NODES))"""
        mean, sd = self.share_left_of(loss, fault)
        shares = np.clip(mean[:, None] + sd[:, None] * NODES, 0.0, 1.0)
        return np.asarray(np.minimum(loss[:, None], np.maximum(loss, 0.0)[:, None] * shares))

    def rests_on(self, loss: Array, fault: np.ndarray) -> list[str]:
        """Name what the share left of each loss rests on: `prior`, or `7 washes`."""
        return [f"{n} washes" if n else PRIOR for n in self._are_like(loss, fault).sum(axis=1)]


NO_WASHES = Washes(np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0, str))


def learn_washes(losses: pl.DataFrame, work: pl.DataFrame, log: pl.DataFrame) -> Washes:
    """Measure the washes of a component that the flights show, by medians before and after.

    Parameters
    ----------
    losses : DataFrame
        `PACK`, `departed_at`, `loss`, `loss_sd` of each flight.
    work : DataFrame
        The component's rows of `recoveries.judge_work`.
    log : DataFrame
        The component's rows of `raw_maintenance`.
    """
    inspections = _inspections(log)
    shown = work.filter("in_force", "is_shown", action=CLEANED)
    washes = shown.select("operator", "tail", "flown_from", "finding", pack="position")
    washes = _with_fault(washes.sort("flown_from"), inspections).with_row_index("wash")
    flights = washes.join(losses, on=PACK, validate="m:m").drop_nulls(["loss", "loss_sd"])
    flights = flights.with_columns(is_after=pl.col("departed_at") >= pl.col("flown_from"))
    distance = (pl.col("departed_at") - pl.col("flown_from")).abs()
    # twice the flights that a log may be off, so that most lie on the right side of the work
    is_near = distance.rank("ordinal").over("wash", "is_after") <= 2 * RECOVERY_FLIGHTS
    medians = flights.filter(is_near).group_by("wash", "is_after").agg(pl.median("loss", "loss_sd"))
    before = medians.filter(~pl.col("is_after"), pl.col("loss") > 0.0)
    pairs = before.join(medians.filter("is_after"), on="wash", suffix="_after", validate="1:1")
    pairs = pairs.join(washes.select("wash", "fault"), on="wash", validate="1:1").sort("wash")
    loss, loss_sd, loss_after, loss_after_sd = (
        pairs[name].to_numpy() for name in ("loss", "loss_sd", "loss_after", "loss_sd_after")
    )
    share_left = np.clip(loss_after / loss, 0.0, 1.0)
    share_left_sd = np.hypot(loss_after_sd, share_left * loss_sd) / loss
    return Washes(loss, share_left, share_left_sd, pairs["fault"].to_numpy(), _fault_since(work, inspections))


def _inspections(log: pl.DataFrame) -> pl.DataFrame:
    """Return inspections of a position that found something or nothing: `PACK`, `counts_from`, `finding`."""
    inspections = log.filter(pl.col("finding") != "", pl.col("pack").is_not_null(), action=INSPECTED)
    return inspections.select(*PACK, "counts_from", "finding").sort("counts_from")


def _with_fault(washes: pl.DataFrame, inspections: pl.DataFrame) -> pl.DataFrame:
    """Add `fault`: what the wash's own line has found, else the last inspection in the days before; empty without."""
    before = washes.join_asof(
        inspections.rename({"finding": "inspected"}),
        left_on="flown_from",
        right_on="counts_from",
        by=PACK,
        tolerance=timedelta(days=LATE_DAYS),
        check_sortedness=False,
    )
    own = pl.when(pl.col("finding") != "").then("finding")
    return before.with_columns(fault=pl.coalesce(own, "inspected", pl.lit("")))


def _fault_since(work: pl.DataFrame, inspections: pl.DataFrame) -> pl.DataFrame:
    """Return what the last inspection since the last work on each unit found, if not nothing: `PACK`, `fault`."""
    last_work = work.filter("in_force").group_by("operator", "tail", pack="position").agg(pl.max("flown_from"))
    inspected = inspections.join(last_work, on=PACK, how="left", maintain_order="left", validate="m:1")
    is_since = (pl.col("counts_from") > pl.col("flown_from")).fill_null(True)
    last = inspected.filter(is_since).group_by(PACK).agg(fault=pl.col("finding").last())
    return last.filter(pl.col("fault") != NO_FAULT)


def forecast_choices(
    units: pl.DataFrame, loss: Array, component: str, washes: Washes, predict: Predict
) -> pl.DataFrame:
    """Forecast units from the loss that each choice leaves; a more thorough one never has the greater chance.

    Parameters
    ----------
    units : DataFrame
        `PACK`, `flight_id`: the last flight of each unit.
    loss : array, shape (n,)
        After that flight. [-]
    component : str
        Code; its `ended_by` decides what may be done.
    washes : Washes
        On record.
    predict : callable
        `Predict` of these units.

    Returns
    -------
    DataFrame
        Of the table `prognosis_choices`.
    """
    fault = washes.faults_of(units)
    losses_left = {
        DEFER: loss[:, None],
        WASH: washes.losses_left(loss, fault),
        REPLACE: np.minimum(loss, 0.0)[:, None],
    }
    ended_by = components()[component].ended_by
    parts = []
    for choice, left in losses_left.items():
        if choice != DEFER and ACTION[choice] not in ended_by:
            continue
        forecasts = predict(np.repeat(np.arange(len(left)), left.shape[1]), left.ravel())
        chances = forecasts.group_by(*PACK, "flight_id", "component", "departed_at").agg(pl.mean(*EVENTS))
        effects = units.select(*PACK, "flight_id").with_columns(
            choice=pl.lit(choice),
            loss_left=left.mean(axis=1),
            loss_left_sd=left.std(axis=1),
            rests_on=pl.Series(washes.rests_on(loss, fault)) if choice == WASH else pl.lit(None, pl.String),
        )
        parts.append(chances.join(effects, on=[*PACK, "flight_id"], validate="1:1"))
    rows = pl.concat(parts).sort(*PACK, pl.col("choice").cast(pl.Enum(CHOICES)))
    return rows.with_columns(pl.col(EVENTS).cum_min().over(PACK))
