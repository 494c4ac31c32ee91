"""The benchmark's own arithmetic, on cases whose answer is known."""

from datetime import UTC, datetime, timedelta

import numpy as np
import polars as pl
import pytest

from benchmarks.alerts import figures_of, overall, tally
from benchmarks.fleets import RESERVE_CLASSES, loss_at_message, reserve_class
from benchmarks.held_out import lead_at_budget
from hdt_core.simulate.design import draw_design


def life(number: int, flights: int, risk: np.ndarray, loss: np.ndarray, failed: bool = True) -> pl.DataFrame:
    k = np.arange(flights)
    return pl.DataFrame(
        {"tail": f"T{number}", "pack": 1, "life": number, "index": k, "risk": risk, "loss": loss, "failed": failed}
    ).with_columns(
        remaining=pl.Series((flights - k).astype(float)), flight_id=pl.format("T{}_{}", pl.lit(number), "index")
    )


LOSS = np.linspace(0.0, 0.4, 401)
INFORMED = pl.concat([life(n, 401, LOSS, LOSS) for n in range(4)])


def test_informed_risk_alerts_where_budget_ends():
    median, tenth, early = lead_at_budget(INFORMED, early_per_1000=0.0)
    assert early == 0.0
    # with no early alert allowed the best threshold is 15 % itself, 251 flights before the end
    assert median == tenth == pytest.approx(250, abs=8)


def test_uninformed_risk_leads_less():
    noise = np.random.default_rng(0).random((4, 401))
    uninformed = pl.concat([life(n, 401, noise[n], LOSS) for n in range(4)])
    assert lead_at_budget(uninformed)[0] < 0.7 * lead_at_budget(INFORMED)[0]


@pytest.mark.parametrize("seed", range(9000, 9003))
def test_heat_takes_reserve(seed):
    design = draw_design(np.random.default_rng(seed))

    assert loss_at_message(design, 20.0) <= loss_at_message(design, 0.0)


def test_every_reserve_class_is_drawn():
    classes = {reserve_class(seed) for seed in range(9000, 9012)}

    assert classes == set(RESERVE_CLASSES)


FLIGHTS = 600
START = datetime(2024, 1, 1, tzinfo=UTC)


def fleet(alerts: list[tuple], events: list[dict], **truth: pl.Expr) -> dict[str, pl.DataFrame]:
    """One pack with two flights a day; `alerts` are diagnosis, flight raised, flight closed."""
    at = pl.int_range(FLIGHTS, eager=True)
    sound = {"ua_ratio": 1.0, "apparent_ua_ratio": 1.0, "cc_eff_loss": 0.0, "blockage": 0.0, "sensor_fault": ""}
    flags = dict.fromkeys(("door_fault", "icing"), False) | {"arrived": True}
    key = {"tail": "T", "pack": pl.Series([1] * FLIGHTS, dtype=pl.Int32), "index": at}
    when = {"departed_at": [START + timedelta(hours=12 * k) for k in range(FLIGHTS)]}
    rows = pl.DataFrame(key | {"flight_id": [f"T_{k}" for k in range(FLIGHTS)]} | when)
    rows = rows.with_columns(**{n: pl.lit(v) for n, v in (sound | flags).items()}).with_columns(**truth)
    time = dict(zip(at, rows["departed_at"], strict=True)) | {None: None}
    raised = [("T", 1, d, f"T_{first}", time[last]) for d, first, last in alerts]
    columns = {"tail": pl.String, "pack": pl.Int32, "diagnosis": pl.String, "raised_flight_id": pl.String}
    columns |= {"closed_at": rows.schema["departed_at"]}
    index = dict.fromkeys(("installed_index", "onset_index", "message_index", "removal_index"), pl.Int64)
    schema = {"tail": pl.String, "pack": pl.Int32, "component": pl.String} | index
    log_schema = {"tail": pl.String, "pack": pl.Int32, "component": pl.String, "done_on": pl.Date, "finding": pl.String}
    return {
        "truth": rows,
        "alerts": pl.DataFrame(raised, schema=columns, orient="row"),
        "events": pl.DataFrame([{"tail": "T", "pack": 1} | e for e in events], schema=schema),
        "maintenance": pl.DataFrame(schema=log_schema),
    }


MESSAGE = {"component": "HX", "installed_index": 0, "message_index": 500}


@pytest.mark.parametrize(
    ("alert", "alerted", "right"),
    [
        (("HX_FOULING", 300, None), 1.0, 1.0),  # 200 flights before the message: the last that is right
        (("HX_FOULING", 299, None), 1.0, 0.0),
        (("HX_FOULING", 100, 201), 1.0, 0.0),  # still open 299 flights before
        (("HX_FOULING", 100, 200), 0.0, 0.0),  # closed 300 flights before
        (("HX_FOULING", 500, None), 0.0, 1.0),  # with the message, not before it
        (("CC_DEGRADED", 400, None), 0.0, np.nan),  # names the wrong component
    ],
)
def test_failure_is_alerted_within_300_flights(alert, alerted, right):
    figures = figures_of(tally(fleet([alert], [MESSAGE])), "HX")
    assert figures["alerted"] == alerted
    np.testing.assert_equal(figures["right within 200"], right)


def test_only_true_fault_makes_alert_right():
    worn = (pl.col("index") >= 300).cast(pl.Float64) * 0.16
    raised = [("HX_FOULING", 100, None), ("HX_FOULING", 99, None), ("SENSOR_FAULT", 350, None)]
    alerts = tally(fleet(raised, [], apparent_ua_ratio=1.0 - worn)).alerts
    assert alerts.select("right", "own", "any_cause", "early").rows() == [
        (False, False, False, True),
        (True, False, False, True),
        (False, False, True, False),
    ]


def test_rates_count_flights_once():
    alerts = [("HX_FOULING", 450, None), ("HX_LOW_MARGIN", 201, None), ("CC_DEGRADED", 400, None)]
    figures = overall(tally(fleet(alerts, [MESSAGE])))
    assert (figures["alerted"], figures["lead"]) == (1.0, 299.0)
    per_1000 = 1000.0 / FLIGHTS
    assert figures["false"] == pytest.approx(2 * per_1000)  # fouling on a sound core, and the compressor
    assert figures["early"] == pytest.approx(per_1000)  # not the alert of low margin, whose message came


@pytest.mark.parametrize(
    ("raised", "expected"),
    [
        (110, {"alerted": 1.0, "lead or delay, median": 10.0, "right within 200": 1.0}),
        (153, {"alerted": 0.0, "right within 200": 0.0}),
    ],
)
def test_door_fault_alerts_while_present(raised, expected):
    fault = {"component": "RAM_DOOR", "onset_index": 100, "removal_index": 150}
    faulty = pl.col("index").is_between(100, 149)
    figures = figures_of(tally(fleet([("RAM_DOOR_FAULT", raised, None)], [fault], door_fault=faulty)), "RAM_DOOR")
    assert {name: figures[name] for name in expected} == expected
