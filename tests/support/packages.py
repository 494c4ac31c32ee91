"""Packages that declare components."""

from pathlib import Path


def install(folder: Path, module: str, code: str, entry: str) -> None:
    """A package as pip leaves it: its module, and where its component is."""
    told = folder / f"{module}-1.0.dist-info"
    told.mkdir(parents=True)
    (folder / f"{module}.py").write_text(code)
    (told / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module}\nVersion: 1.0\n")
    (told / "entry_points.txt").write_text(f"[hdt.components]\n{entry}\n")
