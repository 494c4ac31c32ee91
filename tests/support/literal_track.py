"""The exchanger's track by the batched pass, or by the literal recursion: flight by flight, pack by pack."""

import numpy as np
import polars as pl

from hdt_core.calibration.dsm import Dsm
from hdt_core.tracking import multiple_model_filter as mmf
from hdt_core.tracking.flight_panel import FILTERED, build_panel
from hdt_core.tracking.hypotheses import start
from hdt_core.tracking.sensor_shifts import corrections
from hdt_core.tracking.track import LOSS, _exchanger, _rows
from hdt_core.tracking.wear_model import Settings


def fouling(flights: pl.DataFrame, maintenance: pl.DataFrame, dsm: Dsm, *, literal: bool = False) -> pl.DataFrame:
    """`hx_fouling` of every row of `flights` (in order), and smoothed; `literal` does not smooth."""
    if not literal:
        return _exchanger(flights, maintenance, dsm, None, "")[0]
    faults, settings = corrections(flights), Settings(dsm.clean_level, dsm.clean_level_sd, dsm.offset_sd)
    map_sd = np.nan_to_num(flights["ln_ua_ratio_map_sd"].to_numpy().astype(float))
    panel = build_panel(flights, faults, maintenance, dsm)
    level, sd = np.empty(panel.n_rows), np.empty(panel.n_rows)
    for pack in range(panel.row.shape[1]):
        hypotheses = start(settings)
        for k, row in enumerate(panel.row[:, pack]):
            if row >= 0:
                hypotheses, _ = mmf.step(hypotheses, panel.observations.of((np.array([k]), np.array([pack]))), settings)
                (level[row],), (sd[row],) = mmf.wear_summary(hypotheses, 1)
    return _rows(flights, LOSS, FILTERED, level, sd, map_sd, faults)
