"""Alerts on fleets whose truth is known: lead, false alarms, and whether the diagnosis named the cause."""

import numpy as np
import polars as pl

from benchmarks.detection import GROUP
from benchmarks.fleets import Frames
from benchmarks.harness import markdown

PACK = ["tail", "pack"]
SOON = 300
"""Flights within which an alert of low margin foretells the message."""


def causes(truth: pl.DataFrame) -> pl.DataFrame:
    """What was wrong on or near each flight: one flag a cause, by flight and pack."""

    def near(flag: pl.Expr, before: int, after: int) -> pl.Expr:
        seen = flag.cast(pl.Int8).rolling_max(before + after + 1, min_samples=1).shift(-after)
        return seen.fill_null(strategy="forward").over(*PACK) > 0

    loss = 1.0 - pl.min_horizontal("ua_ratio", "apparent_ua_ratio")
    jump = (pl.col("blockage") - pl.col("blockage").shift(3).over(*PACK)).fill_null(0.0) > 0.08
    rows = truth.sort(*PACK, "index").with_columns(loss=loss, jump=jump)
    return rows.select(
        *PACK,
        "flight_id",
        "index",
        "loss",
        HX=pl.col("loss") >= 0.05,
        CC=pl.col("cc_eff_loss") >= 0.05,
        RAM_DOOR=near(pl.col("door_fault"), 8, 2),
        SENSOR=near(pl.col("sensor_fault") != "", 8, 2),
        ice=near(pl.col("icing"), 3, 0),
        clog=near(pl.col("jump"), 40, 0),
    )


def tally(fleet: Frames) -> pl.DataFrame:
    """Everything the alerts are judged by, long: tail, what, value."""
    about = causes(fleet["truth"])
    alerts = (
        fleet["alerts"]
        .join(about, left_on=[*PACK, "raised_flight_id"], right_on=[*PACK, "flight_id"])
        .with_columns(pl.col("diagnosis").replace_strict(GROUP).alias("group"))
    )
    alerts = alerts.with_columns(low_margin=low_margin_rightly(alerts, fleet["events"]))
    own = pl.any_horizontal([(pl.col("group") == g) & pl.col(g) for g in ("HX", "CC", "RAM_DOOR", "SENSOR")])
    own |= pl.col("low_margin")
    fault = pl.any_horizontal("HX", "CC", "RAM_DOOR", "SENSOR", "ice", "low_margin")
    hx = pl.col("group") == "HX"
    told = alerts.select(
        "tail",
        false=(~fault).cast(pl.Float64),
        false_hx=(~fault & hx).cast(pl.Float64),
        early=(hx & (pl.col("loss") < 0.15) & ~pl.col("low_margin")).cast(pl.Float64),
        not_own=(~own).cast(pl.Float64),
        right=pl.when(fault).then(own.cast(pl.Float64)),
    )
    flights = fleet["truth"].filter("arrived").select("tail", "flight_id").unique().group_by("tail").len("flights")
    parts = [
        told.unpivot(index="tail", variable_name="what").drop_nulls(),
        flights.unpivot(index="tail", variable_name="what").cast({"value": pl.Float64}),
        _found(fleet["events"], alerts),
    ]
    return pl.concat(parts)


def low_margin_rightly(alerts: pl.DataFrame, events: pl.DataFrame) -> pl.Series:
    """Whether a message followed an alert of low margin within `SOON` flights: it speaks of reserve, not of wear."""
    ended = events.filter((pl.col("component") == "HX") & pl.col("message_index").is_not_null())
    ends = {key: own["message_index"].to_numpy() for key, own in ended.group_by(*PACK)}
    said = alerts.select(*PACK, "index", "diagnosis").iter_rows()
    right = [d == "HX_LOW_MARGIN" and any(0 < e - at <= SOON for e in ends.get((t, p), ())) for t, p, at, d in said]
    return pl.Series(right, dtype=pl.Boolean)


def _found(events: pl.DataFrame, alerts: pl.DataFrame) -> pl.DataFrame:
    """Lead of each failure [flight, 0 when missed] and whether each fault was found."""
    rows = []
    for e in events.iter_rows(named=True):
        component, wear = e["component"], e["component"] in ("HX", "CC")
        if e["message_index" if wear else "onset_index"] is None:
            continue
        low = max(e["onset_index"] or 0, e["installed_index"] or 0)
        high = e["message_index"] if wear else (e["removal_index"] or 10**9) + 3
        # little margin may be seen before wear has set in
        since = pl.when(pl.col("diagnosis") == "HX_LOW_MARGIN").then(e["installed_index"] or 0).otherwise(low)
        at = alerts.filter(
            pl.col("tail") == e["tail"], pl.col("pack") == e["pack"], pl.col("group") == component,
            pl.col("index") >= since, pl.col("index") < high,
        )["index"].min()  # fmt: skip
        rows.append((e["tail"], f"found_{component}", float(at is not None)))
        if wear:
            rows.append((e["tail"], f"lead_{component}", 0.0 if at is None else float(high - at)))
    return pl.DataFrame(rows, schema={"tail": pl.String, "what": pl.String, "value": pl.Float64}, orient="row")


ALERT_GOALS = {
    "exchanger failures alerted before the message": "1.00",
    "lead, median [flights]": "180",
    "lead, 10th percentile [flights]": "50",
    "alerts below 15 % loss in 1,000 flights": "2",
    "false alarms in 1,000 flights": "1",
    "false exchanger alarms in 1,000 flights": "0.3",
    "alerts without their own cause in 1,000 flights": "2",
    "compressor failures alerted": "0.95",
    "door faults alerted": "0.80",
    "sensor faults alerted": "0.90",
    "diagnosis right": "0.90",
}


def alert_figures(counted: pl.DataFrame) -> list[float]:
    """Figures in the order of `ALERT_GOALS` over a tally."""
    of = {str(k): v.to_numpy() for (k,), v in ((k, f["value"]) for k, f in counted.group_by("what"))}
    none = np.empty(0)

    def rate(what: str) -> float:
        return 1000.0 * float(of.get(what, none).sum() / of["flights"].sum())

    def mean(what: str) -> float:
        return float(of[what].mean()) if what in of else np.nan

    lead = of.get("lead_HX", np.array([np.nan]))
    rates = [rate(w) for w in ("early", "false", "false_hx", "not_own")]
    shares = [mean(w) for w in ("found_CC", "found_RAM_DOOR", "found_SENSOR", "right")]
    return [mean("found_HX"), float(np.median(lead)), float(np.quantile(lead, 0.1)), *rates, *shares]


def confusion(fleets: list[Frames]) -> str:
    """What was said against what was there, alerts counted."""
    rows = []
    for fleet in fleets:
        about = causes(fleet["truth"])
        alerts = fleet["alerts"].join(about, left_on=[*PACK, "raised_flight_id"], right_on=[*PACK, "flight_id"])
        there = (
            pl.when(pl.col("RAM_DOOR")).then(pl.lit("door"))
            .when(pl.col("SENSOR")).then(pl.lit("sensor"))
            .when(pl.col("clog")).then(pl.lit("clog"))
            .when(pl.col("HX") & (pl.col("diagnosis") != "CC_DEGRADED")).then(pl.lit("fouling"))
            .when(pl.col("CC")).then(pl.lit("compressor"))
            .when(pl.col("HX")).then(pl.lit("fouling"))
            .otherwise(pl.lit("nothing"))
        )  # fmt: skip
        rows.append(alerts.select("diagnosis", there=there))
    counted = pl.concat(rows).group_by("diagnosis", "there").len()
    columns = ("fouling", "clog", "compressor", "door", "sensor", "nothing")
    lines = [["said \\ there", *columns]]
    for said in GROUP:
        own = dict(counted.filter(pl.col("diagnosis") == said).select("there", "len").iter_rows())
        lines.append([said, *(str(own.get(c, 0)) for c in columns)])
    return markdown(lines)
