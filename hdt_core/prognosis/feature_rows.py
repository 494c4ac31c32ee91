"""From frames to the learner's arrays: one row a flight and pack."""

from dataclasses import dataclass, fields, replace
from datetime import datetime

import numpy as np
import polars as pl
from numpy.typing import NDArray

from hdt_core.components import Limit
from hdt_core.margin.conditions import WINDOW_FLIGHTS, repeated_demand
from hdt_core.margin.exchanger_demand import CRITICAL, EXCESS_K, SHARES
from hdt_core.margin.margin import PRIOR_RULE, MessageRule, at_excess
from hdt_core.prognosis.component_limits import PRIORS
from hdt_core.prognosis.history import FEATURES, Panel, feature_rows, record_rows
from hdt_core.prognosis.message_rule import first_met, learn_rules
from hdt_core.prognosis.unit_lives import flight_rows, with_lives
from hdt_core.records.keys import PACK
from hdt_core.simulate.episodes import Episodes
from hdt_core.simulate.training import LEAD, LN_RATIO_PER_K, draw_fleets

Array = NDArray[np.float64]

INPUTS = (*FEATURES, "rule_sd")
LOSSES = (
    "hx_fouling", "hx_fouling_sd", "hx_ln_ua_ratio", "cc_efficiency_loss", "cc_efficiency_loss_sd", "cc_diameter_loss",
)  # fmt: skip
"""Features that a prognosis is made of."""
ASKS = ("overheat_p20_k", "overheat_p50_k", "full_open_share")
"""And what the flights showed of the margin, beside their critical ratios."""

FailureRule = Limit | dict[str, MessageRule]
"""By which the message comes: a limit of the loss, or the rule of each operator's monitor, `""` for any other."""
PRIOR_RULES: dict[str, FailureRule] = {"HX": {"": PRIOR_RULE}, "CC": PRIORS["CC"]}
"""What is believed before any message, by component."""


@dataclass(frozen=True, slots=True)
class FeatureRows:
    """Features and, for training, what became of each row.

    Attributes
    ----------
    features : ndarray, shape (n, p)
        Columns `INPUTS`; NaN where unknown.
    left : ndarray, shape (n,)
        Flights until the message, or until the life was cut short. [flight]
    failed : ndarray of bool, shape (n,)
        Whether the life ended in the message.
    life : ndarray of int, shape (n,)
        Which life the row belongs to, numbered over the whole frame.
    """

    features: Array
    left: Array
    failed: NDArray[np.bool_]
    life: NDArray[np.int_]

    def take(self, keep: NDArray[np.bool_]) -> "FeatureRows":
        """The rows where `keep` holds."""
        return FeatureRows(self.features[keep], self.left[keep], self.failed[keep], self.life[keep])


def simulated_rows(
    seed: int, fleets: int = 50, aircraft: int = 20, flights: int = 600, stride: int = 20
) -> FeatureRows:
    """Rows of simulated lives; what flights ask is known no better than a fleet with few messages knows it."""
    rng = np.random.default_rng(seed + 1)
    parts = []
    for number, (lives, doubt) in enumerate(draw_fleets(seed, fleets, aircraft, flights)):
        left, failed = lives.left()
        offset = rng.integers(0, stride, (left.shape[0], 1))
        keep = (left >= 1) & ((np.arange(flights)[None, :] + offset) % stride == 0)
        unit, flight = np.nonzero(keep)
        record = record_rows(_panel_of(lives), (unit, flight))
        found = feature_rows(record, repeated_demand(lives.asked), (unit, LEAD + flight))
        table = np.column_stack([found, np.full(unit.size, doubt)])
        life = number * left.shape[0] + unit
        parts.append(FeatureRows(table, left[keep], failed[keep], life))
    return FeatureRows(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(FeatureRows)))


def _panel_of(lives: Episodes) -> Panel:
    age = np.where(lives.age_known[:, None], np.arange(lives.loss.shape[1], dtype=float), np.nan)
    return Panel(
        lives.measured, lives.sd, age, lives.ratio,
        lives.overheat_k, lives.overheat_half_k, lives.full_open, lives.day,
    )  # fmt: skip


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
        What the record says at each row of `keys`, columns `history.RECORD`.
    curves : ndarray, shape (packs, flights, shares, excesses)
        Critical ln ratio of every flight of every pack; no shares for a component whose message has a limit of its own.
    where : ndarray of int, shape (n, 2)
        For each row of `keys`: its pack and flight in `curves`.
    keys : DataFrame
        operator, tail, flight_id, pack, departed_at, one row a flight, sorted by pack and departure.
    left, failed : ndarray, shape (n,)
        As in `FeatureRows`.
    mute : ndarray of bool, shape (n,)
        Rows that teach nothing: of an operator that has given no message of any kind, whose lives end unheard, or of
        flights after the moment up to which the lives are given (`tracks_before`).
    operator : ndarray of str, shape (packs,)
        Whose pack it is, as `curves` counts them.
    met : ndarray of int, shape (lives, rules)
        First flight of each life on which each rule of a message is met, from `message_rule.first_met`.
    """

    panel: Panel
    at: NDArray[np.int_]
    record: Array
    curves: Array
    where: NDArray[np.int_]
    keys: pl.DataFrame
    left: Array
    failed: NDArray[np.bool_]
    mute: NDArray[np.bool_]
    operator: NDArray[np.object_]
    met: NDArray[np.int_]


def tracks(features: pl.DataFrame, lives: pl.DataFrame, component: str) -> Tracks:
    """Cut health tracks into lives.

    Parameters
    ----------
    features : DataFrame
        operator, tail, flight_id, pack, departed_at, the component's loss and sd (see `_loss`) and what each flight
        asked, `CRITICAL` and `ASKS` of `exchanger_demand`, any row order. What is missing is not known.
    lives : DataFrame
        From `unit_lives.episodes`.
    component : str
        "HX" or "CC".
    """
    margin = [_column(features if component == "HX" else features.clear(), c).alias(c) for c in (*CRITICAL, *ASKS)]
    known = features.with_columns(*_loss(features, component), *margin)
    rows = with_lives(flight_rows(known, "value", "sd", "ratio", *CRITICAL, *ASKS), lives, component).with_columns(
        column=pl.col("value").is_not_null().cum_sum().over(*PACK, "life").cast(pl.Int64) - 1,
        pack_id=(pl.struct(*PACK).rank("dense").cast(pl.Int64) - 1),
    )
    panel = _panel(rows.filter(pl.col("value").is_not_null()), int(rows["life_id"].max() or 0) + 1)  # type: ignore[arg-type]
    at = rows.select("life_id", "column").to_numpy()
    return Tracks(
        panel=panel,
        at=at,
        record=record_rows(panel, (at[:, 0], np.maximum(at[:, 1], 0))),
        curves=_curves(rows, component),
        where=rows.select("pack_id", "row").to_numpy(),
        keys=rows.select(*PACK, "flight_id", "departed_at", "life_id"),
        left=rows["left"].to_numpy(),
        failed=rows["failed"].to_numpy(),
        mute=rows["mute"].to_numpy(),
        operator=rows.unique("pack_id").sort("pack_id")["operator"].to_numpy(),
        met=first_met((panel.overheat_k, panel.overheat_half_k)),
    )


def tracks_before(track: Tracks, moment: datetime, lives: pl.DataFrame, component: str) -> Tracks:
    """`track` as it teaches at a moment: later flights teach nothing, and lives end as was on record by then.

    Features of a flight follow from that flight and those before it, so they are those of the whole record.

    Parameters
    ----------
    track : Tracks
        Of the whole record.
    lives : DataFrame
        From `unit_lives.episodes` of the record before the moment.
    """
    flown = (track.keys["departed_at"] < moment).to_numpy()
    rows = track.keys.select(PACK).with_columns(row=pl.Series(track.where[:, 1])).filter(flown)
    ends = with_lives(rows, lives, component)
    left, failed, mute = np.full(flown.size, np.nan), np.zeros(flown.size, bool), np.ones(flown.size, bool)
    for values, name in ((left, "left"), (failed, "failed"), (mute, "mute")):
        values[flown] = ends[name].to_numpy()
    return replace(track, left=left, failed=failed, mute=mute)


def _panel(seen: pl.DataFrame, lives: int) -> Panel:
    shape = (lives, int(seen["column"].max() or 0) + 1)  # type: ignore[arg-type]
    place = (seen["life_id"].to_numpy(), seen["column"].to_numpy())
    age = pl.when("age_known").then(pl.col("row") - pl.col("first_row")).cast(pl.Float64)
    day = pl.col("departed_at").dt.ordinal_day().cast(pl.Float64)
    columns = seen.select("value", "sd", age.alias("age"), "ratio", *ASKS, day.alias("day")).to_numpy().astype(float)
    return Panel(*(_spread(shape, place, values) for values in columns.T))


def _curves(rows: pl.DataFrame, component: str) -> Array:
    shares = SHARES if component == "HX" else ()
    shape = (int(rows["pack_id"].max() or 0) + 1, int(rows["row"].max() or 0) + 1)  # type: ignore[arg-type]
    out = np.full((*shape, len(shares), len(EXCESS_K)), np.nan)
    if shares:
        values = rows.select(CRITICAL).to_numpy().astype(float).reshape(-1, len(shares), len(EXCESS_K))
        out[rows["pack_id"].to_numpy(), rows["row"].to_numpy()] = values
    return out


def fleet_rows(track: Tracks, rule: FailureRule, asked: NDArray[np.bool_] | None = None) -> FeatureRows:
    """Features of flights of the tracks; unknown health gives NaN, not an error.

    Parameters
    ----------
    track : Tracks
        From `tracks`.
    rule : FailureRule
        By which the message comes, as far as known.
    asked : array of bool, shape (n,), optional
        Which rows; all by default.
    """
    asked = np.ones(len(track.at), bool) if asked is None else asked
    life, column = track.at[asked].T
    critical, doubt, where = _critical(track, rule, track.where[asked])
    found = np.column_stack([feature_rows(track.record[asked], critical, where), doubt])
    features = np.where((column < 0)[:, None], np.nan, found)
    return FeatureRows(features, track.left[asked], track.failed[asked], life)


def _critical(
    track: Tracks, rule: FailureRule, where: NDArray[np.int_]
) -> tuple[Array, Array, tuple[NDArray[np.int_], NDArray[np.int_]]]:
    """What two hot flights asked of the packs in `where`, up to the last flight in it: (packs, flights); the doubt
    about the message in ln of conductance, (n,); and which of these packs and flights each row of `where` is."""
    packs, pack = np.unique(where[:, 0], return_inverse=True)
    at = (pack, where[:, 1])
    critical = np.full((packs.size, int(where[:, 1].max(initial=-1)) + 1), np.nan)
    if isinstance(rule, Limit):
        critical[:] = np.log1p(-rule.mean)
        return critical, np.full(len(where), rule.sd / (1.0 - rule.mean)), at
    doubt = np.zeros(critical.shape)
    for name in np.unique(track.operator[packs]):
        some, own = track.operator[packs] == name, rule.get(name, rule[""])
        curve = track.curves[packs[some], : critical.shape[1], SHARES.index(own.share)]
        critical[some] = repeated_demand(at_excess(curve, own.excess_k), own.of)
        per_k = np.abs(at_excess(curve, own.excess_k + 1.0) - at_excess(curve, own.excess_k - 1.0)) / 2.0
        doubt[some] = own.excess_sd_k * _usual(per_k)
    return critical, doubt[at], at


def _usual(per_k: Array) -> Array:
    """Median over each pack's last flights, up to each of them: no later flight has a part in what one says."""
    known = pl.DataFrame(per_k.T).fill_nan(None)
    median = pl.all().rolling_median(WINDOW_FLIGHTS, min_samples=1).forward_fill().fill_null(LN_RATIO_PER_K)
    return known.select(median).to_numpy().T


def learn_rule(track: Tracks, component: str, use: NDArray[np.bool_]) -> FailureRule:
    """By which rule the message comes, from the rows in `use`; the declared limit where it comes at a loss.

    A limit learned from messages would be that of the units that failed first, which is too low for the others.
    """
    if component != "HX":
        return PRIOR_RULES[component]
    life, column = track.at.T
    lives, message, flown = np.unique(life[use]), *(np.full(len(track.panel.level), -1) for _ in range(2))
    ended = use & track.failed & (track.left == 0) & (column >= 0)
    message[life[ended]] = column[ended]
    np.maximum.at(flown, life[use], column[use])
    # flights after the message still flew with the unit: they are no evidence that the rule was met without one
    end = np.where(message >= 0, message, flown)[lives, None]
    met = np.where(track.met[lives] > end, -1, track.met[lives])
    operator = np.empty(message.size, dtype=object)
    operator[life] = track.operator[track.where[:, 0]]
    return learn_rules(met, message[lives], operator[lives].astype(str))


def _spread(shape: tuple[int, int], place: tuple[NDArray[np.int_], NDArray[np.int_]], values: Array) -> Array:
    out = np.full(shape, np.nan)
    out[place] = values
    return out


def _loss(features: pl.DataFrame, component: str) -> list[pl.Expr]:
    """Value and sd of the component's loss and ln of what is left, null where columns are missing."""
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
