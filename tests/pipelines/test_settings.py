"""Files that an operator writes: what stands in them is judged as they are read, at the night's start, in one line."""

import re
import stat

import pytest
from typer.testing import CliRunner

from hdt_core.alerts.cases import Limits
from pipelines.cli import app, main
from pipelines.digest.declaration import NotifyError, receivers_of
from pipelines.intake.costs import CostError, read_costs
from pipelines.storage.files import make_private, narrow_umask
from pipelines.storage.objects import StoreError
from pipelines.storage.settings import Retention, accepted_terms, alert_limits, changed_limits, retention

DEEP = f"x = {'[' * 20_000}{']' * 20_000}"
ABSURD = ("99999999999", "9" * 5_000, "-1", "0", "nan", "inf", "1e400", "1.5", "true", "'x'", "[]", "{}", "2024-03-01")
MAIL = "[[receiver]]\nname = 'm'\nkind = 'mail'\nhost = 'h'\nfrom = 'a@b'\nto = ['c@d']\n"


@pytest.mark.parametrize("value", ABSURD)
def test_days_to_keep_are_a_number_of_days(tmp_path, value):
    (tmp_path / "retention.toml").write_text(f"keep_days = {value}")
    with pytest.raises(StoreError, match=r"retention\.toml"):
        retention(tmp_path)


@pytest.mark.parametrize("value", ["'2024-03-01'", "[1]", "['']", "['yesterday']", "[['2024-03-01']]", "{}", "nan"])
def test_nights_to_hold_are_nights(tmp_path, value):
    (tmp_path / "retention.toml").write_text(f"hold = {value}")
    with pytest.raises(StoreError, match=r"retention\.toml: hold"):
        retention(tmp_path)


def test_a_night_may_be_a_date_of_toml(tmp_path):
    (tmp_path / "retention.toml").write_text("hold = [2024-03-01, '2024-03-02T04:00']")
    assert retention(tmp_path) == Retention(30, ("2024-03-01", "2024-03-02T04:00"))


@pytest.mark.parametrize("text", [DEEP, "x = \ud800", "=", "x = 1", f"x = {'9' * 5_000}"])
def test_what_is_no_toml_is_one_line_of_whoever_reads_it(tmp_path, text):
    for name in ("retention.toml", "notify.toml", "costs.toml"):
        (tmp_path / name).write_bytes(text.encode("utf-8", "surrogatepass"))
    for read, error in ((retention, StoreError), (receivers_of, NotifyError), (read_costs, CostError)):
        with pytest.raises(error, match=r"\.toml"):
            read(tmp_path)


@pytest.mark.parametrize("value", ["-1", "0", "65536", "99999999999", "nan", "true", "'x'"])
def test_a_port_is_a_port(tmp_path, value):
    (tmp_path / "notify.toml").write_text(f"{MAIL}port = {value}")
    with pytest.raises(NotifyError, match="port"):
        receivers_of(tmp_path)


@pytest.mark.parametrize("text", [
    "receiver = [1]", "receiver = 'x'", MAIL.replace("'m'", "'m\\n'"), MAIL.replace("'mail'", "['mail']"),
    MAIL.replace("'h'", "'h\\u0000'"), "[[receiver]]\nname = 'w'\nkind = 'webhook'\nurl = 'https://[x'",
])  # fmt: skip
def test_a_receiver_that_is_none_is_told(tmp_path, text):
    (tmp_path / "notify.toml").write_text(text.replace("'h\\u0000'", '"h\\u0000"').replace("'m\\n'", '"m\\n"'))
    with pytest.raises(NotifyError, match=r"notify\.toml"):
        receivers_of(tmp_path)


@pytest.mark.parametrize("value", ["-1", "1" + "0" * 400, "1e300", "nan", "inf", "true", "'x'", "[]"])
def test_a_cost_is_an_amount_of_money(tmp_path, value):
    (tmp_path / "costs.toml").write_text(f"[HX]\nwash = {value}")
    with pytest.raises(CostError, match=r"HX\.wash"):
        read_costs(tmp_path)


@pytest.mark.parametrize("content", [b"no_such_term\n", b"\xff\xfe"])
def test_a_term_that_is_none_is_told(tmp_path, content):
    (tmp_path / "terms.txt").write_bytes(content)
    with pytest.raises(StoreError, match=r"terms\.txt"):
        accepted_terms(tmp_path)


@pytest.mark.parametrize(("name", "text"), [
    ("retention.toml", "keep_days = 99999999999"), ("notify.toml", "receiver = 1"), ("terms.txt", "none"),
])  # fmt: skip
def test_a_night_says_so_before_it_does_anything(sample_landing, tmp_path, monkeypatch, capsys, name, text):
    (tmp_path / name).write_text(text)
    monkeypatch.setattr("sys.argv", ["hdt", "nightly", "--landing", str(sample_landing), "--home", str(tmp_path)])
    with pytest.raises(SystemExit) as ended:
        main()
    lines = capsys.readouterr().err.strip().splitlines()
    assert (ended.value.code, len(lines)) == (2, 1), lines
    assert re.match(rf"hdt: .*{re.escape(name)}", lines[0])
    assert not (tmp_path / "tables").exists()


def test_days_of_a_command_are_days_too(sample_home):
    answer = CliRunner().invoke(app, ["tidy", "--home", str(sample_home), "--keep-days", "99999999999"])
    assert answer.exit_code == 2


def test_nobody_but_owner_and_group_reads_a_home_and_its_owner_alone_who_did_what(sample_home):
    modes = {f: stat.S_IMODE(f.stat().st_mode) for f in (sample_home, *sample_home.rglob("*"))}
    assert [f for f, mode in modes.items() if mode & 0o007] == []
    ledger = {f: mode for f, mode in modes.items() if f.name.startswith("ledger.") and "sealed" not in f.name}
    assert set(ledger.values()) == {0o600}
    if not modes[sample_home] & 0o040:
        pytest.skip("this account's own mask keeps out its group, too")
    assert {modes[f] & 0o040 for f in (sample_home / "catalog.duckdb", *sample_home.rglob("*.parquet"))} == {0o040}


def test_a_private_file_is_closed_though_it_was_open(tmp_path):
    (tmp_path / "cases.sqlite").touch(0o666)
    for name in ("cases.sqlite", "new"):
        assert stat.S_IMODE(make_private(tmp_path / name).stat().st_mode) == 0o600


@pytest.mark.parametrize(("before", "after"), [(0o000, 0o027), (0o022, 0o027), (0o077, 0o077)])
def test_a_narrower_mask_stays(before, after):
    import os

    mask = os.umask(before)
    try:
        assert narrow_umask() == before
        assert os.umask(before) == after
    finally:
        os.umask(mask)


@pytest.mark.parametrize(("text", "fault"), [
    ("fouling = 1.0", "between 0 and 1"), ("fouling = 0", "between 0 and 1"), ("clog = true", "between 0 and 1"),
    ("peg_k = nan", "between 0 and 1000"), ("fuling = 0.1", "has no setting 'fuling'"), ("fouling = '0.1'", "between"),
    ("wear_persistence = [5, 4, 15]", "n of at most `of`"), ("wear_persistence = [3, 4]", "flights"),
])  # fmt: skip
def test_an_alert_limit_that_is_none_is_refused(tmp_path, text, fault):
    (tmp_path / "alerts.toml").write_text(text)
    with pytest.raises(StoreError, match=r"alerts\.toml.*" + re.escape(fault)):
        alert_limits(tmp_path)


def test_a_home_sets_alert_limits_and_the_rest_stays(tmp_path):
    assert alert_limits(tmp_path) == Limits()
    assert changed_limits(tmp_path) == ()
    (tmp_path / "alerts.toml").write_text("fouling = 0.12\nwear_persistence = [2, 3, 15]\nclog = 0.1\n")
    limits = alert_limits(tmp_path)
    assert (limits.fouling, limits.wear_persistence, limits.compressor) == (0.12, (2, 3, 15), Limits().compressor)
    assert changed_limits(tmp_path) == ("fouling = 0.12", "wear_persistence = (2, 3, 15)")
