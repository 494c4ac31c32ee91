"""Reading a file of the landing zone whole, within a limit, without raising."""

from pipelines.intake.landing import LandingFile
from pipelines.intake.ledger import Fault

MAX_TEXT_BYTES = 64 << 20
MAX_PARQUET_BYTES = 256 << 20
"""A flight's report is kilobytes, a month of them or a 1 Hz log a few megabytes; more is refused before it is read."""


def read_bytes(file: LandingFile) -> tuple[bytes | None, list[Fault]]:
    """Content of a file, or None and the fault that kept it out."""
    limit = MAX_TEXT_BYTES if file.is_text else MAX_PARQUET_BYTES
    try:
        with open(file.full_path, "rb") as source:
            content = source.read(limit + 1)  # the size listed is that of another moment
    except OSError as error:
        return None, [Fault("cannot_open", detail=error.strerror or type(error).__name__)]
    if len(content) > limit:
        return None, [Fault("too_large", detail=f"It has more than {limit >> 20} MiB.")]
    return content, []
