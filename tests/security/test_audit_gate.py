"""The gate on the audit of dependencies does not take silence for an answer."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

GATE = Path(__file__).parents[2] / ".ci" / "audited"
SOUND = {"name": "numpy", "version": "2.4.6", "vulns": []}
SKIPPED = {"name": "polars", "skip_reason": "Dependency not found on PyPI and could not be audited"}
SICK = {"name": "urllib3", "version": "1.0", "vulns": [{"id": "PYSEC-2020-148", "fix_versions": ["1.25.9"]}]}


def bill(lock: str) -> subprocess.CompletedProcess[str]:
    script = GATE.with_name("sbom")
    return subprocess.run([sys.executable, script], input=lock, capture_output=True, text=True, check=False)


LOCK = (GATE.parents[1] / "requirements.lock").read_text()


@pytest.fixture(scope="module")
def document():
    return json.loads(bill(LOCK).stdout)


def test_bill_is_the_same_again():
    assert bill(LOCK).stdout == bill(LOCK).stdout


def test_bill_is_cyclonedx(document):
    assert (document["bomFormat"], document["specVersion"]) == ("CycloneDX", "1.5")


def test_bill_names_every_pinned_package(document):
    pins = re.findall(r"^([a-z0-9-]+)(?:\[.*?\])?==(\S+)", LOCK, re.MULTILINE)
    assert [(c["name"], c["version"]) for c in document["components"]] == pins
    assert len({c["bom-ref"] for c in document["components"]}) == len(pins) > 100


def test_bill_has_every_hash(document):
    assert sum(len(c["hashes"]) for c in document["components"]) == LOCK.count("--hash=sha256:")


@pytest.mark.parametrize("lock", ["", "numpy==2.0\n"])
def test_empty_bill_is_refused(lock):
    done = bill(lock)
    assert done.returncode == 1
    assert "no package, or one without a hash" in done.stderr


@pytest.mark.parametrize(
    ("packages", "code", "message"),
    [
        ([SOUND], 0, "1 packages audited"),
        ([], 1, "0 of 0 packages audited"),
        ([SKIPPED], 1, "0 of 1 packages audited; not: polars"),
        ([SOUND, SKIPPED], 1, "1 of 2 packages audited; not: polars"),
        ([SOUND, SICK], 1, "urllib3: PYSEC-2020-148"),
    ],
)
def test_only_whole_audit_passes(packages, code, message):
    report = json.dumps({"dependencies": packages, "fixes": []})
    done = subprocess.run([sys.executable, GATE], input=report, capture_output=True, text=True, check=False)
    assert done.returncode == code
    assert message in done.stdout + done.stderr
