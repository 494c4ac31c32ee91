"""Build the model's input arrays from frames: one row a flight and pack."""

from dataclasses import dataclass, fields, replace
from datetime import datetime

import numpy as np
import polars as pl

from hdt_core.components import Limit
from hdt_core.components.pack import CC
from hdt_core.health.features import DOUBT_SDS, DROP
from hdt_core.margin.exchanger_demand import CRITICAL, EXCESS_K, SHARES
from hdt_core.margin.first_passage import WINDOW_FLIGHTS, repeated_demand
from hdt_core.margin.margin import LN_RATIO_PER_K, PRIOR_RULE, MessageRule, at_excess
from hdt_core.prognosis.history import FEATURES, RECORD, Index, Panel, feature_rows, record_rows
from hdt_core.prognosis.recalibrate import learn_rules, rule_onsets
from hdt_core.prognosis.unit_lives import flight_rows, with_lives
from hdt_core.records.keys import PACK
from hdt_core.robust import Array

INPUTS = (*FEATURES, "rule_sd")
LOSSES = (
    "hx_fouling", "hx_fouling_sd", "hx_ln_ua_ratio", "cc_efficiency_loss", "cc_efficiency_loss_sd", "cc_diameter_loss",
)  # fmt: skip
"""Features that a prognosis is made of."""
MARGIN_FEATURES = ("overheat_p20_k", "overheat_p50_k", "full_open_share")
"""Features of the margin beside the critical ratios."""

MOST_IN_DOUBT = 3
"""Flights for which a fall of the loss may be in doubt, at most."""

FailureRule = Limit | dict[str, MessageRule]
"""Condition for the message: a limit of the loss, or the rule of each operator's monitor, `""` for any other."""
PRIOR_RULES: dict[str, FailureRule] = {"HX": {"": PRIOR_RULE}, "CC": CC.limit}
"""Prior before any message, by component."""


@dataclass(frozen=True, slots=True)
class FeatureRows:
    """Features and, for training, the outcome of each row.

    Attributes
    ----------
    features : ndarray, shape (n, p)
        Columns `INPUTS`; NaN where unknown.
    remaining : ndarray, shape (n,)
        Flights until the message, or until the life was cut short. [flight]
    failed : ndarray of bool, shape (n,)
        Whether the life ended in the message.
    life : ndarray of int, shape (n,)
        Which life the row belongs to, numbered over the whole frame.
    """

    features: Array
    remaining: Array
    failed: Array
    life: Array


@dataclass(frozen=True, slots=True)
class Tracks:
    """Health tracks of one component, one row a life, flights of unknown health left out.

    Attributes
    ----------
    panel : Panel
        Lives and their flights.
    at : ndarray of int, shape (n, 2)
        For each row of `keys`: its life and its column, the column -1 before the first known value.
    record : ndarray, shape (n, q)
        Features of the record at each row of `keys`, columns `history.RECORD`.
    curves : ndarray, shape (packs, flights, shares, excesses)
        Critical ln ratio of every flight of every pack; no shares for a component whose message has a limit of its own.
    curve_index : ndarray of int, shape (n, 2)
        For each row of `keys`: its pack and flight in `curves`.
    keys : DataFrame
        operator, tail, flight_id, pack, departed_at, one row a flight, sorted by pack and departure.
    remaining, failed : ndarray, shape (n,)
        As in `FeatureRows`.
    mute : ndarray of bool, shape (n,)
        Rows not used in training: of an operator without any messages, whose failures go unrecorded, or of flights
        after the moment up to which the lives are given (`tracks_as_of`).
    operator : ndarray of str, shape (packs,)
        Operator of each pack of `curves`.
    onset : ndarray of int, shape (lives, rules)
        First flight of each life on which each rule of a message is met, from `rule_onsets`.
    """

    panel: Panel
    at: Array
    record: Array
    curves: Array
    curve_index: Array
    keys: pl.DataFrame
    remaining: Array
    failed: Array
    mute: Array
    operator: Array
    onset: Array


def tracks(features: pl.DataFrame, lives: pl.DataFrame, component: str, units: pl.DataFrame | None = None) -> Tracks:
    """Cut health tracks into lives.

    A flight's features follow from the unit that the record of that time held to fly. Where work is logged late, or was
    not done, its flights before and after that was known are of two rows of the panel, which share earlier flights.

    Parameters
    ----------
    features : DataFrame
        operator, tail, flight_id, pack, departed_at, the component's loss and sd (see `_loss`) and what each flight
        demand, `CRITICAL` and `MARGIN_FEATURES` of `exchanger_demand`, any row order. Missing columns count as null.
    lives : DataFrame
        From `unit_lives.episodes`.
    component : str
        "HX" or "CC".
    units : DataFrame, optional
        From `unit_lives.units_on_record`; by default each life is known from its first flight.
    """
    names = (*CRITICAL, *MARGIN_FEATURES)
    margin = [_column(features if component == "HX" else features.clear(), c).alias(c) for c in names]
    flights = features.with_columns(*_loss(features, component), *margin)
    rows = with_lives(flight_rows(flights, "value", "sd", "ratio", *names), lives, component)
    units = lives.with_columns(known_row="first_row") if units is None else units
    flown = _flown_by(rows, units.filter(pl.col("component") == component))
    panel = _panel(flown.filter(pl.col("value").is_not_null()), int(flown["life_id"].max() or 0) + 1)  # type: ignore[arg-type]
    known_rows = flown.filter("is_known").select(*PACK, "row", "life_id", "column")
    rows = rows.drop("life_id").join(known_rows, on=[*PACK, "row"], maintain_order="left", validate="1:1")
    rows = rows.with_columns(pack_id=(pl.struct(*PACK).rank("dense").cast(pl.Int64) - 1))
    at = rows.select("life_id", "column").to_numpy()
    return Tracks(
        panel=panel,
        at=at,
        record=record_rows(panel, (at[:, 0], np.maximum(at[:, 1], 0))),
        curves=_curves(rows, component),
        curve_index=rows.select("pack_id", "row").to_numpy(),
        keys=rows.select(*PACK, "flight_id", "departed_at", "life_id"),
        remaining=rows["remaining"].to_numpy(),
        failed=rows["failed"].to_numpy(),
        mute=rows["mute"].to_numpy(),
        operator=rows.unique("pack_id").sort("pack_id")["operator"].to_numpy(),
        onset=rule_onsets((panel.overheat_k, panel.overheat_half_k)),
    )


def _flown_by(rows: pl.DataFrame, units: pl.DataFrame) -> pl.DataFrame:
    """Return the flights of each unit as known from `known_row` on, up to the last flight on which it was held to fly.

    With `life_id`, `column` (among its flights of known health, from 0, -1 before) and `is_known` (held to fly).
    """
    place = units.sort(*PACK, "known_row").select(*PACK, "known_row", "first_row")
    place = place.with_columns(end_row=pl.col("known_row").shift(-1).over(PACK), life_id=pl.int_range(pl.len()))
    pairs = rows.drop("life_id", "first_row", "end_row").join(place, on=PACK, validate="m:m")
    is_before_end = (pl.col("row") < pl.col("end_row")).fill_null(True)
    flown = pairs.filter(pl.col("row") >= pl.col("first_row"), is_before_end).sort("life_id", "row")
    return flown.with_columns(
        column=pl.col("value").is_not_null().cum_sum().over("life_id").cast(pl.Int64) - 1,
        is_known=pl.col("row") >= pl.col("known_row"),
        age_known=pl.col("first_row") > 0,
    )


def tracks_as_of(track: Tracks, moment: datetime, lives: pl.DataFrame, component: str) -> Tracks:
    """Restrict `track` to a moment: later flights are not used, and lives end as was on record by then.

    Features of a flight follow from that flight and those before it, so they are those of the whole record.

    Parameters
    ----------
    track : Tracks
        Of the whole record.
    lives : DataFrame
        From `unit_lives.episodes` of the record before the moment.
    """
    is_past = (track.keys["departed_at"] < moment).to_numpy()
    rows = track.keys.select(PACK).with_columns(row=pl.Series(track.curve_index[:, 1])).filter(is_past)
    ends = with_lives(rows, lives, component)
    n = is_past.size
    remaining = np.full(n, np.nan)
    failed = np.zeros(n, bool)
    mute = np.ones(n, bool)
    for values, name in ((remaining, "remaining"), (failed, "failed"), (mute, "mute")):
        values[is_past] = ends[name].to_numpy()
    return replace(track, remaining=remaining, failed=failed, mute=mute)


def last_rows(track: Tracks) -> Index:
    """Return the row of each pack's last flight of known health."""
    known_rows = np.flatnonzero(track.at[:, 1] >= 0)
    pack = track.curve_index[known_rows, 0]
    return np.asarray(known_rows[np.diff(pack, append=-1) != 0])


def level_of(track: Tracks) -> Array:
    """Return the loss after each row's flight. (n,)"""
    return track.record[:, RECORD.index("level")]


def with_loss(track: Tracks, rows: Index, loss: Array) -> Tracks:
    """Return some rows as if the unit had another loss, at the same pace and demand."""
    record = track.record[rows]
    gain = np.log1p(-loss) - np.log1p(-level_of(track)[rows])
    record[:, RECORD.index("ratio")] += gain
    record[:, RECORD.index("level")] = loss
    by_row = {name: getattr(track, name)[rows] for name in ("at", "curve_index", "remaining", "failed", "mute")}
    return replace(track, record=record, keys=track.keys[rows], **by_row)


def _panel(rows: pl.DataFrame, lives: int) -> Panel:
    """Lay out rows of known health by life and column."""
    shape = (lives, int(rows["column"].max() or 0) + 1)  # type: ignore[arg-type]
    place = (rows["life_id"].to_numpy(), rows["column"].to_numpy())
    age = pl.when("age_known").then(pl.col("row") - pl.col("first_row")).cast(pl.Float64)
    day = pl.col("departed_at").dt.ordinal_day().cast(pl.Float64)
    columns = rows.select("value", "sd", age.alias("age"), "ratio", *MARGIN_FEATURES, day.alias("day"))
    values = np.full((len(fields(Panel)), *shape), np.nan)
    values[:, *place] = columns.to_numpy().astype(float).T
    panel = Panel(*values)
    settled = _settled_flights(panel.level, panel.sd)
    level, sd, ratio = (np.take_along_axis(v, settled, axis=1) for v in (panel.level, panel.sd, panel.ratio))
    return replace(panel, level=level, sd=sd, ratio=ratio)


def _settled_flights(level: Array, sd: Array) -> Index:
    """Return for each flight the one whose loss stands after it: its own, or an earlier one's while a fall is in doubt.

    One flight with a faulty reading lowers a loss with a large standard deviation, and the next flight restores it: a
    forecast from that fall would be of a wash that nobody made.
    """
    settled = np.tile(np.arange(level.shape[1]), (level.shape[0], 1))
    unit = np.arange(level.shape[0])
    for flight in range(1, level.shape[1]):
        standing = settled[:, flight - 1]
        fall = level[unit, standing] - level[:, flight]
        in_doubt = (fall > DROP) & (fall < DOUBT_SDS * sd[:, flight]) & (flight - standing <= MOST_IN_DOUBT)
        settled[:, flight] = np.where(in_doubt, standing, flight)
    return settled


def _curves(rows: pl.DataFrame, component: str) -> Array:
    """Lay out the critical ratios of `exchanger_demand` by pack and flight."""
    shares = SHARES if component == "HX" else ()
    shape = (int(rows["pack_id"].max() or 0) + 1, int(rows["row"].max() or 0) + 1)  # type: ignore[arg-type]
    out = np.full((*shape, len(shares), len(EXCESS_K)), np.nan)
    if shares:
        values = rows.select(CRITICAL).to_numpy().astype(float).reshape(-1, len(shares), len(EXCESS_K))
        out[rows["pack_id"].to_numpy(), rows["row"].to_numpy()] = values
    return out


def fleet_rows(track: Tracks, rule: FailureRule, is_selected: Array | None = None) -> FeatureRows:
    """Compute features of the tracks' flights, NaN where health is unknown.

    Parameters
    ----------
    track : Tracks
        From `tracks`.
    rule : FailureRule
        Condition for the message, as far as known.
    is_selected : array of bool, shape (n,), optional
        Which rows; all by default.
    """
    rows = slice(None) if is_selected is None else is_selected
    life, column = track.at[rows].T
    critical, rule_sd, place = _critical(track, rule, track.curve_index[rows])
    values = np.column_stack([feature_rows(track.record[rows], critical, place), rule_sd])
    features = np.where((column < 0)[:, None], np.nan, values)
    return FeatureRows(features, track.remaining[rows], track.failed[rows], life)


def _critical(track: Tracks, rule: FailureRule, place: Array) -> tuple[Array, Array, tuple[Array, Array]]:
    """Compute the demand of two hot flights on the packs of `place`, up to the last flight: (packs, flights); the sd
    of the message's rule in ln of conductance, (n,); and the index of each row in the first."""
    packs, pack = np.unique(place[:, 0], return_inverse=True)
    index = (pack, place[:, 1])
    critical = np.full((packs.size, int(place[:, 1].max(initial=-1)) + 1), np.nan)
    if isinstance(rule, Limit):
        critical[:] = np.log1p(-rule.mean)
        return critical, np.full(len(place), rule.sd / (1.0 - rule.mean)), index
    rule_sd = np.zeros(critical.shape)
    for name in np.unique(track.operator[packs]):
        rows = track.operator[packs] == name
        setting = rule.get(name, rule[""])
        curve = track.curves[packs[rows], : critical.shape[1], SHARES.index(setting.share)]
        critical[rows] = repeated_demand(at_excess(curve, setting.excess_k), setting.of)
        per_k = np.abs(at_excess(curve, setting.excess_k + 1.0) - at_excess(curve, setting.excess_k - 1.0)) / 2.0
        rule_sd[rows] = setting.excess_sd_k * _trailing_median(per_k)
    return critical, rule_sd[index], index


def _trailing_median(per_k: Array) -> Array:
    """Compute the trailing median over each pack's last flights; no later flight enters."""
    frame = pl.DataFrame(per_k.T).fill_nan(None)
    median = pl.all().rolling_median(WINDOW_FLIGHTS, min_samples=1).forward_fill().fill_null(LN_RATIO_PER_K)
    return frame.select(median).to_numpy().T


def learn_rule(track: Tracks, component: str, use: Array) -> FailureRule:
    """Estimate the message's rule from the rows in `use`; return the declared limit where it comes at a loss.

    A limit estimated from messages would be that of the units that failed first, too low for the others.
    """
    if component != "HX":
        return PRIOR_RULES[component]
    life, column = track.at.T
    lives, message, last_flight = np.unique(life[use]), *(np.full(len(track.panel.level), -1) for _ in range(2))
    is_message = use & track.failed & (track.remaining == 0) & (column >= 0)
    message[life[is_message]] = column[is_message]
    np.maximum.at(last_flight, life[use], column[use])
    # flights after the message still flew with the unit: they are no evidence that the rule was met without one
    end = np.where(message >= 0, message, last_flight)[lives, None]
    onset = np.where(track.onset[lives] > end, -1, track.onset[lives])
    operator = np.empty(message.size, dtype=object)
    operator[life] = track.operator[track.curve_index[:, 0]]
    return learn_rules(onset, message[lives], operator[lives].astype(str))


def _loss(features: pl.DataFrame, component: str) -> list[pl.Expr]:
    """Build value and sd of the component's loss and ln of the remaining ratio, null where columns are missing."""
    if component == "HX":
        names = {"hx_fouling": "value", "hx_fouling_sd": "sd", "hx_ln_ua_ratio": "ratio"}
        return [_column(features, name).alias(alias) for name, alias in names.items()]
    # head is proportional to efficiency and to the square of the effective diameter (equation 5)
    deficit = _column(features, "cc_diameter_loss")
    value = pl.coalesce(_column(features, "cc_efficiency_loss"), 1.0 - (1.0 - deficit) ** 2)
    value_sd = _column(features, "cc_efficiency_loss_sd").alias("sd")
    return [value.alias("value"), value_sd, (1.0 - value).clip(0.05).log().alias("ratio")]


def _column(features: pl.DataFrame, name: str) -> pl.Expr:
    column = pl.col(name) if name in features.columns else pl.lit(None)
    return column.cast(pl.Float64).fill_nan(None)
