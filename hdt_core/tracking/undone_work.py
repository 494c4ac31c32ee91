"""Leave work out of the log that the flights contradict, so that a track need not take it at its word.

A track lets the loss fall at a line of the log, and reads what the flights still show as the new part's build. The
estimates of single flights know nothing of the log: where a part was worn beyond doubt and they do not recover about
the line, by more than new parts differ, the work was not done. Where the loss is too small to show it, the log counts.
"""

from datetime import datetime, timedelta

import numpy as np
import polars as pl

from hdt_core.components import Component
from hdt_core.records.keys import PACK
from hdt_core.records.recoveries import LATE_DAYS, RECOVERY_FLIGHTS, RECOVERY_SDS
from hdt_core.records.unit_index import date_entries
from hdt_core.robust import Array, median_error

FEWEST = 5
"""Flights with an estimate that are needed on either side of a recovery."""


def without_undone(
    maintenance: pl.DataFrame, flights: pl.DataFrame, ln_loss: Array, tracked: pl.DataFrame, component: Component
) -> pl.DataFrame:
    """Return the log without work on a component that its flights contradict, once enough have been flown.

    Parameters
    ----------
    maintenance : DataFrame
        The log.
    flights : DataFrame
        `PACK`, `departed_at`; whole packs, in order.
    ln_loss : array, shape (flights,)
        Loss by each flight alone, but for a constant of the pack; NaN where it has no estimate.
    tracked : DataFrame
        `PACK`, `departed_at`, `parameter`, `value`, `sd`: the component's loss after each flight, with the whole log.
    component : Component
        Whose `ended_by` is the work that lowers its loss.
    """
    is_own = (pl.col("component") == component.code) & pl.col("action").is_in(component.ended_by)
    numbered = maintenance.with_row_index("line")
    entries = date_entries(numbered.filter(is_own)).drop_nulls([*PACK, "counts_from"]).sort("counts_from", "line")
    losses = tracked.filter(pl.col("parameter") == component.loss).select(*PACK, "departed_at", "value", "sd")
    estimates = flights.select(*PACK, "departed_at", ln_loss=pl.Series(ln_loss)).filter(pl.col("ln_loss").is_finite())
    unit_sd = component.model.param(component.loss).unit_sd or 0.0
    undone: list[int] = []
    for pack, lines in entries.partition_by(PACK, as_dict=True).items():
        own = {"operator": pack[0], "tail": pack[1], "pack": pack[2]}
        history = _History(estimates.filter(**own), losses.filter(**own).drop_nulls(), unit_sd)
        earlier: datetime | None = None
        for line, moment in lines.select("line", "counts_from").rows():
            if history.contradicts(moment, earlier):
                undone.append(line)
            earlier = moment
    return numbered.filter(~pl.col("line").is_in(undone)).drop("line")


class _History:
    """Flights of a pack: its loss by each alone, and as tracked."""

    def __init__(self, estimates: pl.DataFrame, losses: pl.DataFrame, unit_sd: float) -> None:
        self.departed_at = estimates["departed_at"]
        self.ln_loss = estimates["ln_loss"].to_numpy()
        self.losses = losses
        self.unit_sd = unit_sd

    def contradicts(self, moment: datetime, earlier: datetime | None) -> bool:
        """Whether the pack was worn before a moment, and recovers less about it than any new part would.

        Flights after the entry before it alone count: that one's recovery is another. Late and early logs count as
        such, up to `LATE_DAYS` and `RECOVERY_FLIGHTS`.
        """
        row = self._row_at(moment)
        before = self.losses.filter(pl.col("departed_at") < moment)
        if row < FEWEST or self.ln_loss.size - row < RECOVERY_FLIGHTS + FEWEST or before.is_empty():
            return False
        loss, loss_sd = before.select("value", "sd").row(-1)
        ln_loss = -np.log1p(-loss)
        # the old part's build is in doubt where its loss is: their sum is what the flights show
        new_part_sd = np.hypot(self.unit_sd, loss_sd / (1.0 - loss))
        if ln_loss - self._fall_at(row)[0] <= RECOVERY_SDS * new_part_sd:  # so is the largest fall: most lines end here
            return False
        first_row = self._row_at(moment - timedelta(LATE_DAYS))
        if earlier is not None:
            own_row = min(self._row_at(earlier) + RECOVERY_FLIGHTS, row - RECOVERY_FLIGHTS)
            first_row = max(first_row, own_row)
        falls = [self._fall_at(at) for at in range(max(first_row, FEWEST), row + RECOVERY_FLIGHTS + 1)]
        fall, fall_sd = max(falls)
        return bool(ln_loss - fall > RECOVERY_SDS * np.hypot(new_part_sd, fall_sd))

    def _row_at(self, moment: datetime) -> int:
        return int((self.departed_at < moment).sum())

    def _fall_at(self, row: int) -> tuple[float, float]:
        """Return by how much the flights from `row` on lie below those before it, and its standard deviation."""
        before = self.ln_loss[max(row - RECOVERY_FLIGHTS, 0) : row]
        after = self.ln_loss[row : row + RECOVERY_FLIGHTS]
        sd = np.hypot(before.std() * median_error(before.size), after.std() * median_error(after.size))
        return float(np.median(before) - np.median(after)), float(sd)
