"""Accept or propose physical terms of the model by name; `terms.txt` of a home holds those accepted."""

from pathlib import Path

import polars as pl

from hdt_core.calibration.calibrate import baseline_samples
from hdt_core.calibration.dsm import Dsm
from hdt_core.calibration.flight_estimates import estimate_flights
from hdt_core.calibration.missing_physics import propose
from hdt_core.physics.terms import TERMS
from pipelines.baseline import baseline_cells
from pipelines.storage.files import replacing
from pipelines.storage.ledger import Ledger
from pipelines.storage.settings import terms_file
from pipelines.storage.store import Store


def accept(home: Path, names: list[str]) -> None:
    """Write the terms of the model from the next night on to `terms.txt`.

    Raises
    ------
    KeyError
        A name that the library does not have.
    """
    for name in names:
        TERMS[name]
    with replacing(terms_file(home)) as temporary:
        temporary.write_text("".join(f"{name}\n" for name in sorted(set(names))), encoding="utf-8")


def proposals(home: Path, dsm: Dsm) -> pl.DataFrame:
    """Return the evidence for each term that the model in service lacks, from the flights of its baseline."""
    flights = baseline_cells(Ledger(home))["flight_id"]
    samples = Store(home).scan("legs_samples").filter(pl.col("flight_id").is_in(flights.implode())).collect()
    return propose(estimate_flights(baseline_samples(samples), dsm), dsm)
