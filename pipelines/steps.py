"""The chain, step by step: a run has one kind of partition, so it takes seven."""

from typing import NamedTuple


class Step(NamedTuple):
    """What is made in one run, node by node, over the partitions of a grain.

    A run may take `folded` times as many flights as one that reads files: the fewer runs, the less is bookkeeping.
    """

    label: str
    grain: str
    nodes: list[tuple[str, ...]]
    folded: int = 1


STEPS = [
    Step("fleet list and refused files", "fleet", [("raw_fleet", "raw_files_deliveries", "raw_files_quarantine")]),
    Step(
        "messages and maintenance",
        "aircraft",
        [("raw_messages", "raw_maintenance", "raw_records_deliveries", "raw_records_quarantine")],
        folded=20,
    ),
    Step(
        "flights and legs",
        "flight",
        [
            ("raw_snapshots", "raw_logs", "raw_deliveries", "raw_quarantine", "raw_flights"),
            ("legs_samples", "legs_verdicts"),
        ],
    ),
    Step("digital system model", "fleet", [("calibration_dsm", "calibration_design", "calibration_laws")]),
    Step(
        "operational twins",
        "flight",
        [("twin_flights",), ("residuals",), ("legs_signs", "features_witnesses"), ("features_margin",)],
        folded=4,
    ),
    Step(
        "health, features, alerts",
        "aircraft",
        [("twin_health", "twin_chapters"), ("legs_admitted",), ("features",), ("features_alerts",)],
        folded=20,
    ),
    Step("prognosis", "fleet", [("prognosis_base",), ("prognoses", "prognosis_model")]),
]
