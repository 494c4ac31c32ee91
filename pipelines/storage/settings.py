"""What an engineer sets for one fleet: small text files in its home."""

from pathlib import Path


def terms_file(home: Path) -> Path:
    """Where the accepted physical terms stand, a name a line."""
    return home / "terms.txt"


def accepted_terms(home: Path) -> tuple[str, ...]:
    """Names of the accepted physical terms, sorted; none where there is no file."""
    file = terms_file(home)
    lines = file.read_text(encoding="utf-8").splitlines() if file.exists() else []
    return tuple(sorted({line.strip() for line in lines if line.strip() and not line.startswith("#")}))


def notify_file(home: Path) -> Path:
    """Where it is declared who is told of what a night changed; none need be there."""
    return home / "notify.toml"
