"""Packages that hang on an entry point."""

from pathlib import Path


def install(folder: Path, module: str, code: str, entry: str, group: str = "hdt.components") -> None:
    """A package as pip leaves it: its module, and what it brings."""
    info = folder / f"{module}-1.0.dist-info"
    info.mkdir(parents=True)
    (folder / f"{module}.py").write_text(code)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[{group}]\n{entry}\n")
