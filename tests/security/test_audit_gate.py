"""The gate on the audit of dependencies does not take silence for an answer."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

GATE = Path(__file__).parents[2] / ".ci" / "audited"
SOUND = {"name": "numpy", "version": "2.4.6", "vulns": []}
SKIPPED = {"name": "polars", "skip_reason": "Dependency not found on PyPI and could not be audited"}
SICK = {"name": "urllib3", "version": "1.0", "vulns": [{"id": "PYSEC-2020-148", "fix_versions": ["1.25.9"]}]}


@pytest.mark.parametrize(
    ("packages", "code", "said"),
    [
        ([SOUND], 0, "1 packages audited"),
        ([], 1, "0 of 0 packages audited"),
        ([SKIPPED], 1, "0 of 1 packages audited; not: polars"),
        ([SOUND, SKIPPED], 1, "1 of 2 packages audited; not: polars"),
        ([SOUND, SICK], 1, "urllib3: PYSEC-2020-148"),
    ],
)
def test_only_a_whole_and_clean_audit_passes(packages, code, said):
    report = json.dumps({"dependencies": packages, "fixes": []})
    done = subprocess.run([sys.executable, GATE], input=report, capture_output=True, text=True, check=False)
    assert done.returncode == code
    assert said in done.stdout + done.stderr
