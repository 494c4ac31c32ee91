"""Conductance index of a fleet's heat exchangers, from recorded signals alone: no design value, no twin.

An indicator of wear and ice, precise enough to select the legs for calibration; monitoring keeps all legs.
"""

from dataclasses import dataclass

import numpy as np
import polars as pl

from hdt_core.flight.cross_checks import SMOOTHED_FLIGHTS
from hdt_core.flight.quality import flow_steps
from hdt_core.physics.model import Array
from hdt_core.records.keys import FLIGHT, LEG, PACK
from hdt_core.records.unit_index import number_units
from hdt_core.robust import MAD_TO_SD, huber_slopes

BLOCK_FLIGHTS = 10
"""Flights within which wear is nearly constant: an offset for each block removes it from the regression."""
HUBER_STEPS = 12
LEAST_NOISE = 0.01  # residual of the regression within a cruise, which averaging over a log's minutes does not reduce
SCAN_LENGTHS = (2, 3, 4, 6, 9)
"""Samples in a row; an ice episode lasts a quarter of an hour to an hour."""
TERMS = ("pack_flow", "door", "ram_density", "mach", "door_door", "door_density", "flow_door")


@dataclass(frozen=True, slots=True)
class Manifold:
    """The fleet's law of the conductance index.

    Attributes
    ----------
    centre, slopes : tuple of float
        Of `TERMS`: the operating point that the index belongs to, and how the measured ratio depends on the terms.
    noise : float
        Of the index, from sample to sample; of the fleet, not of the leg, which ice would inflate.
    """

    centre: tuple[float, ...]
    slopes: tuple[float, ...]
    noise: float


def learn_manifold(samples: pl.DataFrame, legs: pl.DataFrame) -> Manifold | None:
    r"""Learn the log temperature ratio of the exchanger as a function of the operating point; None for too few samples.

    Parameters
    ----------
    samples : DataFrame
        Samples with `monitored`, sorted by `LEG` and time.
    legs : DataFrame
        `LEG` and `flight_number`.

    Notes
    -----
    .. math:: y = \ln \frac{T_{hi} - T_{ho}}{T_{ho} - T_{ci}}

    rises with conductance and ram flow and falls with pack flow. Its dependence on pack flow, door, ram density and
    Mach (second order in the logarithms) is learned by Huber regression with an offset for every ten flights of a
    pack: wear, unit, and constant sensor errors go into the offsets, so a healthy fleet is not required.

    References
    ----------
    .. [1] P. J. Huber, Robust estimation of a location parameter, Ann. Math. Statist. 35(1), 1964.
    """
    numbers = legs.select(*LEG, "flight_number")
    usable = _usable(samples, *LEG).join(numbers, on=LEG, how="left", maintain_order="left", validate="m:1")
    if usable.height <= 10 * len(TERMS):
        return None
    x = usable.select(TERMS).to_numpy()
    slopes = _slopes(usable)
    centre = np.median(x, axis=0)
    off = usable.with_columns(pl.Series("index", usable["y"].to_numpy() - (x - centre) @ slopes))
    step = off.select((pl.col("index") - pl.col("index").shift(1).over(LEG)).abs().median()).item()
    noise = max(MAD_TO_SD * (1.0 if step is None else float(step)) / 2**0.5, LEAST_NOISE)
    return Manifold(tuple(centre.tolist()), tuple(slopes.tolist()), noise)


def add_conductance_index(samples: pl.DataFrame, manifold: Manifold | None) -> pl.DataFrame:
    """Add `conductance_index`, the log temperature ratio of the exchanger at a common operating point. [-]

    Only samples with `monitored` get an index, the others null. A loss of conductance of 10 % lowers it by 0.08 to
    0.12.
    """
    if manifold is None:
        return samples.with_columns(pl.lit(None, pl.Float64).alias("conductance_index"))
    terms = zip(TERMS, manifold.centre, manifold.slopes, strict=True)
    # one term after the other: Polars' own sum across columns rounds by the number of its threads
    index = pl.col("y") - sum(((pl.col(name) - centre) * slope for name, centre, slope in terms), pl.lit(0.0))
    rows = samples.with_row_index("_row")
    indices = _usable(rows, "_row").select("_row", index.alias("conductance_index"))
    # joined by row number alone, because the samples are too wide to copy
    column = rows.select("_row").join(indices, on="_row", how="left", maintain_order="left", validate="m:1")
    return samples.with_columns(column["conductance_index"])


def _usable(samples: pl.DataFrame, *keys: str) -> pl.DataFrame:
    """Return samples with a finite temperature ratio, as `keys`, y and `TERMS`."""
    rows = samples.filter("monitored").select(*keys, *_regressors()).drop_nulls(["y", *TERMS])
    return rows.filter(pl.all_horizontal(pl.col("y", *TERMS).is_finite()))


def _regressors() -> list[pl.Expr]:
    hot = pl.col("hx_in_k")
    out = pl.col("hx_out_k")
    cold = pl.col("tat_k")
    flow = pl.col("pack_flow_kg_s").log()
    door = pl.col("ram_door_open").clip(lower_bound=0.02).log()
    density = (pl.col("total_pressure_pa") / cold.sqrt()).log() - 7.7  # near its cruise value: keeps the products apart
    usable = (hot > out + 5.0) & (out > cold + 5.0)
    return [
        pl.when(usable).then(((hot - out) / (out - cold)).log()).alias("y"),
        flow.alias("pack_flow"),
        door.alias("door"),
        density.alias("ram_density"),
        pl.col("mach").clip(lower_bound=0.2).log().alias("mach"),
        (door**2).alias("door_door"),
        (door * density).alias("door_density"),
        (flow * door).alias("flow_door"),
    ]


def _slopes(usable: pl.DataFrame) -> Array:
    """Regress y on the terms by Huber's method, with offsets of pack and block removed as medians."""
    block = [*LEG[:2], "pack", pl.col("flight_number") // BLOCK_FLIGHTS]
    within = usable.select((pl.col(c) - pl.col(c).median().over(block)).alias(c) for c in ("y", *TERMS))
    ridge = 1e-6 * within.height * np.eye(len(TERMS))
    return huber_slopes(within.select(TERMS).to_numpy(), within["y"].to_numpy(), ridge, HUBER_STEPS)


def leg_conductance(samples: pl.DataFrame, manifold: Manifold | None) -> pl.DataFrame:
    """Return level and unrest of the index, leg by leg.

    Parameters
    ----------
    samples : DataFrame
        As for `add_conductance_index`, sorted by `LEG` and time.

    Returns
    -------
    DataFrame
        `LEG`, `index_level` (median), `index_n`, and `index_unrest`: the largest departure of the mean of a few
        samples in a row from the leg's median, in standard errors; transient ice raises it, wear does not. Of a
        recorder with a coarse flow only what exceeds `index_step` counts, the change by one step of the flow.
    """
    indices = add_conductance_index(samples, manifold).select(*LEG, "conductance_index").drop_nulls("conductance_index")
    steps = flow_steps(samples).select(
        *FLIGHT, (pl.col("pack_flow_step_ln") * _per_ln_flow(manifold)).alias("index_step")
    )
    indices = indices.join(steps, on=FLIGHT, how="left", maintain_order="left", validate="m:1")
    off = pl.col("conductance_index") - pl.col("conductance_index").median().over(LEG)
    runs = [
        (exceeding(pl.col("_off").rolling_mean(m).over(LEG), "index_step").abs() * m**0.5).alias(f"_run{m}")
        for m in SCAN_LENGTHS
    ]
    noise = manifold.noise if manifold else np.nan  # without a law no sample has an index
    return (
        indices.with_columns(off.alias("_off"))
        .with_columns(runs)
        .group_by(LEG)
        .agg(
            pl.col("conductance_index").median().alias("index_level"),
            pl.len().cast(pl.Int64).alias("index_n"),
            (pl.max_horizontal(pl.col(f"_run{m}").max() for m in SCAN_LENGTHS) / noise).alias("index_unrest"),
            pl.col("index_step").first(),
        )
    )


def _per_ln_flow(manifold: Manifold | None) -> float:
    """Return the change of the index by ln of pack flow at the law's centre. [-]"""
    if manifold is None:
        return 0.0
    slope = dict(zip(TERMS, manifold.slopes, strict=True))
    door = dict(zip(TERMS, manifold.centre, strict=True))["door"]
    return abs(slope["pack_flow"] + slope["flow_door"] * door)


def exceeding(off: pl.Expr, step: str, share: float = 1.0) -> pl.Expr:
    """Return what of a deviation exceeds a share of a recorder's step, with its sign; all of it without a step."""
    return off.sign() * (off.abs() - share * pl.col(step).fill_null(0.0)).clip(0.0)


UNIT = [*PACK, "unit"]
WORN_INDEX = 0.09  # drop of the conductance index, about the fraction of conductance lost
CLEAN_QUANTILE = 0.9  # of a unit's smoothed level: its clean state, robust to noise and a few strays
UNIT_SD = 0.05  # of clean units about each other: conductance as made, and constant sensor errors
UNREST = 6.5  # standard errors that a few samples in a row may leave the leg's own level
STRAY_INDEX, STRAY_SD = 0.07, 4.5  # of one leg against its neighbours


@dataclass(frozen=True, slots=True)
class IndexLevel:
    """Statistics of the index over a fleet.

    Attributes
    ----------
    clean : float, optional
        Clean level of the median unit; None in a fleet without levels.
    stray : float, optional
        Median deviation of a leg from its neighbours.
    """

    clean: float | None = None
    stray: float | None = None


def learn_level(levels: pl.DataFrame, maintenance: pl.DataFrame) -> IndexLevel:
    """Learn the statistics from levels as of `judge_conductance`."""
    smooth = _smooth(levels, maintenance)
    # medians of floats, None without any
    return IndexLevel(_clean(smooth)["clean"].median(), smooth["index_off"].abs().median())  # type: ignore[arg-type]


def judge_conductance(levels: pl.DataFrame, maintenance: pl.DataFrame, fleet: IndexLevel) -> pl.DataFrame:
    """Flag wear, unrest and strays by the index.

    Parameters
    ----------
    levels : DataFrame
        `LEG`, `flight_number`, `departed_at`, `index_level`, `index_unrest`, `index_n`, `index_step`; all flights of
        each tail.
    maintenance : DataFrame
        Replaced exchangers (`component` HX) begin a new unit.
    fleet : IndexLevel
        Of `learn_level`.

    Returns
    -------
    DataFrame
        `LEG`, `worn`, `unrest`, `stray` (bool), `index_off`, the leg's deviation from the running
        median of its neighbours, and `index_n`, its number of samples.

    Notes
    -----
    A unit's clean level is the upper decile of its smoothed level, but no lower than the clean fleet less two
    standard deviations between units: an exchanger fitted worn never shows its clean level.
    """
    smooth = _smooth(levels, maintenance)
    floor = pl.lit(None if fleet.clean is None else fleet.clean - 2.0 * UNIT_SD, pl.Float64)
    away = smooth.join(_clean(smooth), on=UNIT, how="left", validate="m:1").with_columns(
        (pl.max_horizontal("clean", floor) - pl.col("smooth")).alias("drop")
    )
    flags = {
        "worn": pl.col("drop") > WORN_INDEX,
        "unrest": pl.col("index_unrest") > UNREST,
        "stray": pl.col("index_off").abs() > max(STRAY_INDEX, STRAY_SD * MAD_TO_SD * (fleet.stray or 0.0)),
    }
    return away.select(
        *LEG, "index_n", "index_off", *(flag.fill_null(False).alias(name) for name, flag in flags.items())
    )


def _smooth(levels: pl.DataFrame, maintenance: pl.DataFrame) -> pl.DataFrame:
    """Add the running median of each unit, and each leg's deviation from it."""
    units = number_units(levels, maintenance).sort(*PACK, "flight_number")
    running = pl.col("index_level").rolling_median(SMOOTHED_FLIGHTS, center=True, min_samples=2)
    smooth = units.with_columns(running.over(UNIT).alias("smooth"))
    off = pl.col("index_level") - pl.col("smooth")
    # rounding moves a reading by half a step
    return smooth.with_columns(exceeding(off, "index_step", 0.5).alias("index_off"))


def _clean(smooth: pl.DataFrame) -> pl.DataFrame:
    return smooth.group_by(UNIT).agg(pl.col("smooth").quantile(CLEAN_QUANTILE).alias("clean"))
