"""Alerts at other limits, judged by the catalog's own views."""

from hdt_core.alerts.alerts import VALUES
from pipelines.report.thresholds import thresholds
from pipelines.storage.catalog import connect


def test_at_the_limits_in_service_the_alerts_are_those_of_the_catalog(sample_home):
    by_diagnosis = {row["diagnosis"]: row for row in thresholds(sample_home) if row["in_service"]}
    assert set(by_diagnosis) == set(VALUES)
    with connect(sample_home) as con:
        rates = {row["diagnosis"]: row for row in con.sql("select * from alert_hit_rates").pl().to_dicts()}
    assert rates
    for diagnosis, row in by_diagnosis.items():
        rate = rates.get(diagnosis, {"n_alerts": 0, "n_right": 0, "n_judged": 0, "n_open": 0})
        assert (row["alerts"], row["confirmed"], row["open"]) == (rate["n_alerts"], rate["n_right"], rate["n_open"])
        assert row["false"] == rate["n_judged"] - rate["n_right"]
