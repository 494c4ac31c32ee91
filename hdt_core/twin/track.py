"""Health flight by flight: what each flight said, filtered along each pack, with its certainty."""

from typing import NamedTuple

import numpy as np
import polars as pl

from hdt_core.records.keys import IN_ORDER, LEG_AT, PACK
from hdt_core.twin import histories
from hdt_core.twin.bookmarks import first_page, read_pages, written
from hdt_core.twin.chapters import CHAPTER, pass_along
from hdt_core.twin.crossing import Array
from hdt_core.twin.dsm import Dsm
from hdt_core.twin.lumped import lumped_coefficients
from hdt_core.twin.machine import compressor_parameters
from hdt_core.twin.wave import Wave, prints, side_by_side
from hdt_core.twin.wear import Settings
from hdt_core.twin.witness import Corrections, corrections

FILTERED, SMOOTHED = "kalman_filtered", "kalman_smoothed"
LOSS, IN_HINDSIGHT = "hx_fouling", "hx_fouling_smoothed"


class Tracked(NamedTuple):
    """Health parameters in long form, and the bookmarks from which the next night goes on."""

    health: pl.DataFrame
    chapters: pl.DataFrame


def track(twin_flights: pl.DataFrame, maintenance: pl.DataFrame, dsm: Dsm) -> pl.DataFrame:
    """Health parameters of every flight and pack; what is not called smoothed takes nothing from later flights.

    Parameters
    ----------
    twin_flights : DataFrame
        Of `estimate_flights`; any subset of whole packs, all their flights so far.
    maintenance : DataFrame
        `operator, tail, pack, component, action, done_on`; entries count from the day they name.
    dsm : Dsm
        The model the flights were judged by.

    Returns
    -------
    DataFrame
        Long form: `LEG_AT`, component, parameter, value, sd, unit, status, estimator.
    """
    return track_on(twin_flights, maintenance, dsm).health


def track_on(
    twin_flights: pl.DataFrame, maintenance: pl.DataFrame, dsm: Dsm, known: Tracked | None = None, seal: str = ""
) -> Tracked:
    """`track`, going on from what is `known` of packs whose earlier flights are what they were.

    Parameters
    ----------
    known : Tracked, optional
        What an earlier call gave for the same packs, or for some of them.
    seal : str
        Names what else the track rests on, the version of the code; what is known under another is not gone on from.
    """
    flights = twin_flights.sort(IN_ORDER)
    health, chapters = _exchanger(flights, maintenance, dsm, known, f"{seal}|{dsm.dsm_version}")
    rows = [health, lumped_coefficients(flights), compressor_parameters(flights, maintenance, dsm)]
    told = _sound(pl.concat(rows))
    return Tracked(told.sort(*PACK, "departed_at", "flight_id", "component", "parameter"), chapters)


def _sound(rows: pl.DataFrame) -> pl.DataFrame:
    """Rows without value where an estimate came out as no number, or with a doubt that is none."""
    value, sd = pl.col("value"), pl.col("sd")
    broken = (~value.is_finite() | ~sd.is_finite() | (sd < 0)).fill_null(False)
    status = pl.when(broken).then(pl.lit("no_number")).otherwise("status").alias("status")
    return rows.with_columns(pl.when(~broken).then(value), pl.when(~broken).then(sd), status)


def fouling(flights: pl.DataFrame, maintenance: pl.DataFrame, dsm: Dsm, *, literal: bool = False) -> pl.DataFrame:
    """`hx_fouling` of every row of `flights` (in order), and `hx_fouling_smoothed`, which also knows flights to come,
    fifty to a hundred of them.

    `literal` walks pack by pack, flight by flight, and does not look back.
    """
    if not literal:
        return _exchanger(flights, maintenance, dsm, None, "")[0]
    faults = corrections(flights)
    wave = side_by_side(flights, faults, maintenance, dsm)
    return _rows(flights, LOSS, FILTERED, *one_by_one(wave, _settings(dsm)), _map_sd(flights), faults)


def _exchanger(flights: pl.DataFrame, maintenance: pl.DataFrame, dsm: Dsm, known: Tracked | None, seal: str) -> Tracked:
    faults, map_sd = corrections(flights), _map_sd(flights)
    wave = side_by_side(flights, faults, maintenance, dsm)
    named = flights.select(pl.concat_str("flight_id", "status", separator="="))[:, 0].to_list()
    seen = prints(wave, [map_sd, faults.variance, faults.fault], named, seal, CHAPTER)
    packs = flights.select(PACK).unique(maintain_order=True)
    pages = first_page(packs.height) if known is None else read_pages(known.chapters, packs, seen)
    passed = pass_along(wave, _settings(dsm), pages.begin, pages.bookmarks)
    new = pl.Series(np.isfinite(passed.found[0]))
    tracks = ((LOSS, FILTERED, passed.found[:2]), (IN_HINDSIGHT, SMOOTHED, passed.found[2:]))
    health = pl.concat(
        _rows(flights, name, how, told[0], told[1], map_sd, faults).filter(new) for name, how, told in tracks
    )
    if known is not None and not new.all():
        kept = known.health.filter(pl.col("parameter").is_in([LOSS, IN_HINDSIGHT])).select(health.columns)
        kept = kept.join(flights.filter(~new).select(LEG_AT), on=LEG_AT, how="semi")
        if kept.height != len(tracks) * (~new).sum():  # something removed what the bookmarks speak of
            return _exchanger(flights, maintenance, dsm, None, seal)
        health = pl.concat([kept, health])
    return Tracked(health, written(packs, seen, pages, passed.bookmarks))


def _settings(dsm: Dsm) -> Settings:
    return Settings(dsm.clean_level, dsm.clean_level_sd, dsm.offset_sd)


def _map_sd(flights: pl.DataFrame) -> Array:
    return np.asarray(np.nan_to_num(flights["ln_ua_ratio_map_sd"].to_numpy().astype(float)))


def _rows(
    flights: pl.DataFrame, name: str, how: str, level: Array, sd: Array, map_sd: Array, faults: Corrections
) -> pl.DataFrame:
    value, value_sd = loss_of(level, np.sqrt(sd**2 + map_sd**2 + faults.variance))
    status = (
        pl.when(pl.col("ln_ua_ratio").is_null())
        .then(pl.lit("predicted"))
        .when(pl.Series(faults.fault))
        .then(pl.lit("sensor_corrected"))
        .otherwise(pl.col("status"))
    )
    return flights.select(
        *LEG_AT,
        pl.lit("HX").alias("component"),
        pl.lit(name).alias("parameter"),
        pl.Series("value", value),
        pl.Series("sd", value_sd),
        pl.lit("-").alias("unit"),
        status.alias("status"),
        pl.lit(how).alias("estimator"),
    )


def one_by_one(wave: Wave, settings: Settings) -> tuple[Array, Array]:
    """Return the filtered track by the literal recursion: flight k of a pack starts from what is known after k - 1."""
    level, sd = np.empty(wave.n_rows), np.empty(wave.n_rows)
    for pack in range(wave.row.shape[1]):
        belief = histories.start(1, settings)
        for k, row in enumerate(wave.row[:, pack]):
            if row >= 0:
                belief, _ = histories.step(belief, wave.flight(np.array([k]), np.array([pack])), settings)
                mean, spread = histories.wear_summary(belief, 1)
                level[row], sd[row] = mean[0], spread[0]
    return level, sd


def loss_of(level: Array, sd: Array) -> tuple[Array, Array]:
    """Loss as a fraction and its standard deviation, from ln loss and its own."""
    left = np.exp(-level)
    return 1.0 - left, left * sd
