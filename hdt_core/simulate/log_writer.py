"""Write the fleet list, messages, the maintenance log, and the truth of lives and faults."""

from datetime import date, datetime, timedelta
from typing import Any

import numpy as np
import polars as pl

from hdt_core.robust import Array
from hdt_core.simulate.design import Operator
from hdt_core.simulate.signals import Plan
from hdt_core.simulate.unit_histories import PackHistory

ONSET_LOSS = 0.05
_TEXTS = {"21-52-HXTEMP": "PACK TEMPERATURE HIGH", "21-51-CCFLOW": "CAC FLOW LOW", "21-61-TRIM": "TRIM AIR VALVE"}

MESSAGES: dict[str, Any] = {
    "message_time": pl.Datetime("us", "UTC"), "flight_id": pl.String, "pack": pl.Int32, "code": pl.String,
    "text": pl.String,
}  # fmt: skip
MAINTENANCE: dict[str, Any] = {
    "done_on": pl.Date, "pack": pl.Int32, "component": pl.String, "action": pl.String, "finding": pl.String,
    "reference": pl.String,
}  # fmt: skip
EVENTS: dict[str, Any] = {
    "operator": pl.String, "tail": pl.String, "pack": pl.Int64, "component": pl.String, "kind": pl.String,
    "finding": pl.String, "removal_kind": pl.String, "censored": pl.Boolean, "installed_index": pl.Int64,
    "onset_index": pl.Int64, "onset_flight_id": pl.String, "message_index": pl.Int64, "message_flight_id": pl.String,
    "removal_index": pl.Int64, "removal_flight_id": pl.String,
}  # fmt: skip


def flight_ids(tail: str, start: datetime, departed_s: Array) -> Array:
    """Return flight ids: tail, date of departure, leg of that day."""
    days = [(start + timedelta(seconds=float(s))).strftime("%Y%m%d") for s in departed_s]
    legs = pl.DataFrame({"day": days}).select(pl.int_range(1, pl.len() + 1).over("day")).to_series()
    return np.array([f"{tail}_{day}_{leg:02d}" for day, leg in zip(days, legs, strict=True)])


def fleet_row(rng: np.random.Generator, operator: Operator, tail: str) -> pl.DataFrame:
    """Draw the row of fleet.csv."""
    delivered_on = date(int(rng.integers(2012, 2023)), 6, 1)
    serial_number = int(rng.integers(30000, 60000))
    row = {"operator": operator.name, "tail": tail, "msn": serial_number, "delivered_on": delivered_on, "packs": 2}
    return pl.DataFrame(row)


class LogWriter:
    """Messages, log entries and events of one aircraft, pack by pack."""

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._messages: list[dict[str, Any]] = []
        self._maintenance: list[dict[str, Any]] = []
        self._events: list[dict[str, Any]] = []

    def write(self, rng: np.random.Generator, history: PackHistory, pack: int, health: pl.DataFrame) -> None:
        """Add one pack's history."""
        loss = 1.0 - np.minimum(health["ua_ratio"].to_numpy(), health["apparent_ua_ratio"].to_numpy())
        for message in history.messages:
            after_s = rng.uniform(2400.0, 3600.0)
            moment = self._departure(message["index"]) + timedelta(seconds=float(np.round(after_s)))
            row = {"message_time": moment, "flight_id": self._id(message["index"]), "pack": pack}
            self._messages.append(row | {"code": message["code"], "text": _TEXTS[message["code"]]})
        for entry in history.maintenance:
            row = {"done_on": self._departure(entry["index"]).date(), "pack": pack} | entry
            self._maintenance.append(row | {"reference": f"WO{rng.integers(10**6, 10**7)}"})
        for event in history.events:
            self._events.append(self._event_row(event, pack, {"HX": loss, "CC": history.cc_loss}))

    def message_frame(self) -> pl.DataFrame:
        """Return rows of messages.csv in order of time, without repeats."""
        return (
            _table(self._messages, MESSAGES)
            .unique(["flight_id", "pack", "code"], keep="first", maintain_order=True)
            .sort("message_time", "pack")
        )

    def maintenance_frame(self) -> pl.DataFrame:
        """Return rows of maintenance.csv in order of date."""
        return _table(self._maintenance, MAINTENANCE).sort("done_on", "pack", "reference")

    def event_frame(self) -> pl.DataFrame:
        """Return the truth: one row a life or fault."""
        return _table(self._events, EVENTS)

    def _event_row(self, event: dict[str, Any], pack: int, loss: dict[str, Array]) -> dict[str, Any]:
        row: dict[str, Any] = {"operator": self._plan.operator.name, "tail": self._plan.tail, "pack": pack} | event
        if event["component"] in loss:
            first, last = event["installed_index"], event["removal_index"] or self._plan.ids.size
            onsets = np.nonzero(loss[event["component"]][first:last] > ONSET_LOSS)[0]
            row["onset_index"] = first + int(onsets[0]) if onsets.size else None
        for name in ("onset", "message", "removal"):
            index = row.get(f"{name}_index")
            row[f"{name}_flight_id"] = None if index is None else self._id(index)
        return row

    def _id(self, index: int) -> str:
        return str(self._plan.ids[index])

    def _departure(self, index: int) -> datetime:
        return self._plan.start + timedelta(seconds=float(self._plan.schedule.departed_s[index]))


def _table(rows: list[dict[str, Any]], schema: dict[str, Any]) -> pl.DataFrame:
    return pl.DataFrame([{name: row.get(name) for name in schema} for row in rows], schema=schema, orient="row")
