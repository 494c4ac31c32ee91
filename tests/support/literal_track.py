"""The exchanger's track by the batched pass, or by the literal recursion: flight by flight, pack by pack."""

import numpy as np
import polars as pl

from hdt_core.calibration.dsm import Dsm
from hdt_core.components.pack import HX
from hdt_core.tracking import multiple_model_filter as mmf
from hdt_core.tracking.loss_filter import loss_rows, track_loss
from hdt_core.tracking.multiple_model_filter import start
from hdt_core.tracking.segments import lay_out, wear_summary
from hdt_core.tracking.sensor_shifts import corrections
from hdt_core.tracking.track import exchanger_loss


def fouling(flights: pl.DataFrame, maintenance: pl.DataFrame, dsm: Dsm, *, literal: bool = False) -> pl.DataFrame:
    """`hx_fouling` of every row of `flights` (in order), and smoothed; `literal` does not smooth."""
    loss = exchanger_loss(flights, corrections(flights), dsm)
    if not literal:
        return track_loss(flights, maintenance, loss).health
    panel = lay_out(flights, loss.observations, maintenance, HX.code, unchecked=loss.unchecked)
    level = np.empty(panel.n_rows)
    sd = np.empty(panel.n_rows)
    for pack in range(panel.row.shape[1]):
        hypotheses = start(loss.settings)
        for k, row in enumerate(panel.row[:, pack]):
            if row >= 0:
                cell = (np.array([k]), np.array([pack]))
                hypotheses, _ = mmf.step(hypotheses, panel.observations.of(cell), loss.settings)
                (level[row],), (sd[row],) = wear_summary(hypotheses, 1)
    return loss_rows(flights, loss, HX.loss, level, sd)
