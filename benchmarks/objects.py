"""A night on an object store against the same on local files: `python -m benchmarks.objects [--size S] [--write]`.

Fleets of benchmarks/scale.py; the store is SeaweedFS on this host, so what a request costs is its work and no distance:
the count of requests, by the server's own meter, is what carries over to another store. `--write` puts the table into
docs/storage.md.
"""

import os
import tempfile
import time
from pathlib import Path

from benchmarks import object_server
from benchmarks.harness import DOCS, Texts, machine, markdown, run
from benchmarks.scale import RANKING, SIZES, measured, query_ms
from pipelines.intake.simulated import write_fleet
from pipelines.report.page import write_report
from pipelines.storage.store import URL, Store

PAGE = DOCS / "storage.md"
KINDS = {"GET": "reads", "PUT": "writes", "LIST": "lists", "DELETE": "deletions"}


def measure_store(landing: Path, home: Path) -> dict[str, object]:
    """What a first night, an idle one, the report and the fleet's ranking cost, and what then lies in the store."""
    row: dict[str, object] = {}
    for what in ("night", "idle"):
        before = _requests()
        row[what] = measured(landing, home)["wall_s"]
        row[f"{what}_requests"] = _since(before)
    before = _requests()
    began = time.monotonic()
    write_report(home, home.with_suffix(".html"))
    row |= {
        "report": time.monotonic() - began, "report_requests": _since(before), "ranking_ms": query_ms(home, RANKING),
    }  # fmt: skip
    return row | _stored(Store(home))


def _stored(store: Store) -> dict[str, object]:
    if store.place.remote:
        sizes = store.place.sizes("").values()
    else:
        sizes = [f.stat().st_size for f in Path(store.place.url).rglob("*.parquet")]
    return {"objects": len(sizes), "megabytes": sum(sizes) / 1e6}


def _requests() -> dict[str, int]:
    return object_server.requests() if URL in os.environ else {}


def _since(before: dict[str, int]) -> str:
    """Requests by kind since `before`."""
    more = {kind: n - before.get(kind, 0) for kind, n in _requests().items()}
    return ", ".join(f"{n:,} {KINDS.get(kind, kind)}" for kind, n in sorted(more.items()) if n) or "none"


def table(rows: dict[str, dict[str, object]]) -> str:
    """Return the table as Markdown."""
    labels = (
        ("first night [s]", "night", ".0f"), ("its requests", "night_requests", ""), ("idle night [s]", "idle", ".1f"),
        ("its requests", "idle_requests", ""), ("report [s]", "report", ".1f"),
        ("its requests", "report_requests", ""), ("fleet's ranking [ms]", "ranking_ms", ".0f"),
        ("files or objects", "objects", ",.0f"), ("megabytes", "megabytes", ".1f"),
    )  # fmt: skip
    lines = [[label, *(format(row[key], form) for row in rows.values())] for label, key, form in labels]
    return f"{markdown([['', *rows], *lines])}\n\n{machine()}"


def main(size: str = "S") -> Texts:
    """A fleet of one of `SIZES`."""
    with tempfile.TemporaryDirectory() as scratch:
        root = Path(scratch)
        list(write_fleet(root, 11, SIZES[size]))
        rows = {"local files": measure_store(root / "landing", root / "local")}
        with object_server.serving(root / "s3") as variables:
            os.environ |= {**variables, URL: f"s3://{object_server.BUCKET}/fleet"}
            rows["objects"] = measure_store(root / "landing", root / "remote")
    yield "objects", table(rows)


if __name__ == "__main__":
    run(main, page=PAGE)
