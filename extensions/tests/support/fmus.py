"""FMUs of the tests, built from C."""

import shutil
import subprocess
import zipfile
from pathlib import Path

import pytest


def pack_fmu(folder: Path, name: str, description: str, binary: Path | None = None) -> Path:
    """Archive a model description and, for this platform, its binary."""
    import fmpy

    path = folder / f"{name}.fmu"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", description)
        if binary is not None:
            archive.write(binary, f"binaries/{fmpy.platform}/{name}{fmpy.sharedLibraryExtension}")
    return path


def build_fmu(folder: Path, name: str, source: Path, description: str, *options: str) -> Path:
    """Compile a source with some options and archive it; skip the test where that can't be done."""
    fmpy = pytest.importorskip("fmpy", reason="the extra `fmi` is not installed")
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        pytest.skip("no C compiler to build the FMUs of the tests with")
    binary = folder / f"{name}.so"
    headers = Path(fmpy.__file__).parent / "c-code"
    command = [compiler, "-shared", "-fPIC", "-O1", *options, f"-I{headers}", str(source), "-o", str(binary)]
    subprocess.run(command, check=True, capture_output=True)
    return pack_fmu(folder, name, description, binary)
