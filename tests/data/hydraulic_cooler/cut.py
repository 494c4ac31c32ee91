"""Cut the extract kept here from the published text files, plain or .gz, in FOLDER: `python cut.py FOLDER`."""

import sys
from pathlib import Path

import numpy as np
import polars as pl

CHANNELS = {"TS3": "ts3_degc", "TS4": "ts4_degc", "CE": "ce_pct", "CP": "cp_kw"}
LABELS = ("cooler_pct", "valve_pct", "pump_leakage", "accumulator_bar", "unstable")


def table(folder: Path, name: str) -> np.ndarray:
    """One published table: a row a cycle."""
    return np.loadtxt(next(folder.glob(f"{name}.txt*")))


def main(source: Path, target: Path) -> None:
    """Write `cycles.parquet` (a row a second) and `profile.csv` (a row a cycle)."""
    tables = {column: table(source, name) for name, column in CHANNELS.items()}
    cycles, seconds = tables["ts3_degc"].shape
    key = {
        "cycle": np.repeat(np.arange(cycles, dtype=np.int16), seconds),
        "second": np.tile(np.arange(seconds, dtype=np.int8), cycles),
    }
    # the files print three decimals: whole thousandths lose nothing and compress well
    thousandths = {f"{c}_1e3": np.rint(1000.0 * t).astype(np.int32).ravel() for c, t in tables.items()}
    pl.DataFrame(key | thousandths).write_parquet(target / "cycles.parquet", compression="zstd", compression_level=22)
    labels = table(source, "profile").astype(np.int16)
    pl.DataFrame(labels, schema=list(LABELS), orient="row").with_row_index("cycle").write_csv(target / "profile.csv")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(__file__).parent)
