"""The log shows every change, addition and cut: 1,000 of 1,000 tries by someone who may write to its folder."""

import datetime as dt
import hashlib
import json
import random
import shutil
import subprocess

import pytest

from hdt_trial.declaration import TrialError
from hdt_trial.log import HEADS, append, entries, faults, stamp_faults, stamp_request

NOW = dt.datetime(2026, 3, 1, tzinfo=dt.UTC)


@pytest.fixture
def folder(sealed, tmp_path):
    """A copy to tamper with."""
    return shutil.copytree(sealed, tmp_path / "log")


@pytest.fixture(scope="module")
def sealed(tmp_path_factory):
    """Eight nights."""
    folder = tmp_path_factory.mktemp("trial")
    for n in range(8):
        append(folder, "night" if n else "start", {"alerts": [f"alert {n}"]}, NOW + dt.timedelta(days=n))
    return folder


def chain(files, start=0):
    """Make the chain whole again from one entry on, heads included: what a careful forger does."""
    heads = []
    for n, file in enumerate(files):
        if n >= start:
            entry = json.loads(file.read_text())
            entry |= {"number": n, "previous": heads[-1] if heads else "0" * 64}
            file.write_text(json.dumps(entry, indent=1) + "\n")
        heads.append(hashlib.sha256(file.read_bytes()).hexdigest())
    (files[0].parent / HEADS).write_text("".join(f"{n:05} {h}\n" for n, h in enumerate(heads)))


def tamper(way, files, rng):
    file = rng.choice(files)
    data = file.read_bytes()
    heads = files[0].parent / HEADS
    match way:
        case "flip":
            at = rng.randrange(len(data))
            file.write_bytes(data[:at] + bytes([data[at] ^ 1 << rng.randrange(8)]) + data[at + 1 :])
        case "shorten":
            file.write_bytes(data[: rng.randrange(len(data))])
        case "drop":
            file.unlink()
        case "swap":
            other = rng.choice([f for f in files if f != file])
            file.write_bytes(other.read_bytes())
            other.write_bytes(data)
        case "add":
            entry = json.loads(files[-1].read_text()) | {"number": len(files)}
            entry["previous"] = hashlib.sha256(files[-1].read_bytes()).hexdigest()
            files[0].with_name(f"{len(files):05}.json").write_text(json.dumps(entry))
        case "cut heads":
            heads.write_text("".join(heads.read_text().splitlines(keepends=True)[: rng.randrange(len(files))]))
        case "cut off" | "cut off and chain":
            n = rng.randrange(1, len(files))
            for later in files[n:]:
                later.unlink()
            if way == "cut off and chain":
                chain(files[:n])
        case "rewrite and chain":
            n = files.index(file)
            file.write_text(json.dumps(json.loads(data) | {"body": {"alerts": ["forged"]}}, indent=1) + "\n")
            chain(files, n + 1)
        case "insert and chain":
            n = rng.randrange(1, len(files))
            bodies = [f.read_bytes() for f in (*files[: n + 1], *files[n:])]
            everything = [files[0].with_name(f"{k:05}.json") for k in range(len(bodies))]
            for place, body in zip(everything, bodies, strict=True):
                place.write_bytes(body)
            chain(everything, n)


CAREFUL = ("cut off and chain", "rewrite and chain", "insert and chain")
WAYS = ("flip", "shorten", "drop", "swap", "add", "cut heads", "cut off", *CAREFUL)


def restore(folder, whole):
    for file in folder.iterdir():
        if file.name not in whole:
            file.unlink()
    for name, data in whole.items():
        file = folder / name
        if not file.exists() or file.read_bytes() != data:
            file.write_bytes(data)


def test_tampered_log_is_always_caught(sealed, folder):
    """The careful rewrite the whole chain: only the digest that was printed and kept elsewhere shows it."""
    assert list(faults(sealed, [e.digest for e in entries(sealed)])) == [], "an untouched log has no fault"
    printed = entries(sealed)[-1].digest
    rng = random.Random(3)
    detections = 0
    whole = {file.name: file.read_bytes() for file in sealed.iterdir()}
    for k in range(1000):
        restore(folder, whole)
        way = WAYS[k % 10]
        tamper(way, sorted(folder.glob("*.json")), rng)
        head = printed if way in CAREFUL else None
        detections += next(faults(folder, head=head), None) is not None
    assert detections == 1000


def test_broken_log_takes_no_entry(folder):
    (folder / "00005.json").unlink()
    with pytest.raises(TrialError, match="entry 5 is missing"):
        append(folder, "night", {}, NOW + dt.timedelta(days=30))


def test_next_night_mends_missing_head(folder):
    heads = (folder / HEADS).read_text().splitlines(keepends=True)
    (folder / HEADS).write_text("".join(heads[:-1]))
    assert list(faults(folder)) == ["1 entries at the end are not in heads.txt"]
    append(folder, "night", {}, NOW + dt.timedelta(days=30))
    assert list(faults(folder)) == []


@pytest.mark.skipif(shutil.which("openssl") is None, reason="no openssl")
def test_time_stamp_fits_one_entry(folder, tmp_path):
    """An authority of our own answers the request, as one on the network would."""
    log = entries(folder)
    query = stamp_request(folder, log[-1])
    authority = tmp_path / "tsa.pem"
    (tmp_path / "tsa.cnf").write_text(
        "[req]\ndistinguished_name=dn\nx509_extensions=ext\nprompt=no\n[dn]\nCN=Our authority\n"
        "[ext]\nextendedKeyUsage=critical,timeStamping\n[tsa]\ndefault_tsa=own\n[own]\n"
        f"serial={tmp_path}/serial\ndefault_policy=1.2.3.4\ndigests=sha256\nsigner_digest=sha256\n"
    )
    for words in (
        f"req -x509 -newkey rsa:2048 -nodes -keyout {tmp_path}/key.pem -out {authority} -config {tmp_path}/tsa.cnf",
        f"ts -reply -config {tmp_path}/tsa.cnf -queryfile {query} -signer {authority} -inkey {tmp_path}/key.pem "
        f"-out {query.with_suffix('.tsr')}",
    ):
        subprocess.run(["openssl", *words.split()], check=True, capture_output=True)
    assert stamp_faults(folder, log, authority) == []
    query.with_suffix(".tsr").rename(folder / "00003.tsr")
    assert stamp_faults(folder, log, authority) == ["00003.tsr does not match entry 3"]
