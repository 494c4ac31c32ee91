"""Files that an operator writes: what stands in them is judged as they are read, at the night's start, in one line."""

import os
import re
import stat
from collections.abc import Callable
from pathlib import Path

import pytest
from command import hdt
from strangers import NAME, Newton, forget_methods, install_method

from hdt_core.alerts.cases import Limits
from hdt_core.components.pack import CC
from pipelines.digest.declaration import NotifyError, receivers_of
from pipelines.intake.findings import CostError, read_costs
from pipelines.intake.scan import scan
from pipelines.orchestration.runs import open_instance
from pipelines.report.tasks import read_tasks
from pipelines.storage.files import make_private, narrow_umask
from pipelines.storage.ledger import Ledger
from pipelines.storage.objects import StoreError
from pipelines.storage.settings import (
    HOME_SETTINGS,
    Methods,
    Retention,
    accept_terms,
    accepted_terms,
    alert_limits,
    by_home,
    changed_limits,
    chosen_methods,
    retention,
    terms_file,
)
from pipelines.versions import baseline_inputs
from pipelines.web.sign_in import read_people

DEEP = f"x = {'[' * 20_000}{']' * 20_000}"
ABSURD = ("99999999999", "9" * 5_000, "-1", "0", "nan", "inf", "1e400", "1.5", "true", "'x'", "[]", "{}", "2024-03-01")
MAIL = "[[receiver]]\nname = 'm'\nkind = 'mail'\nhost = 'h'\nfrom = 'a@b'\nto = ['c@d']\n"


RECEIVERS = (
    "receiver = [1]", "receiver = 'x'", MAIL.replace("'m'", '"m\\n"'), MAIL.replace("'mail'", "['mail']"),
    MAIL.replace("'h'", '"h\\u0000"'), "[[receiver]]\nname = 'w'\nkind = 'webhook'\nurl = 'https://[x'",
)  # fmt: skip
LIMITS = (
    ("fouling = 1.0", "between 0 and 1"), ("fouling = 0", "between 0 and 1"), ("clog = true", "between 0 and 1"),
    ("peg_k = nan", "between 0 and 1000"), ("fuling = 0.1", "has no setting 'fuling'"), ("fouling = '0.1'", "between"),
    ("wear_persistence = [5, 4, 15]", "n of at most `of`"), ("wear_persistence = [3, 4]", "flights"),
)  # fmt: skip
METHODS = (
    "HX = 'magic'", "PUMP = 'ekf'", "HX = 1", "HX = []", "HX = {}", "HX = { design = 'ekf', wear = 'nls' }",
    "HX = { health = 'magic' }", "HX = { health = ['ekf'] }", "hx = 'ekf'", "[HX.health]\nname = 'ekf'",
)  # fmt: skip
NIGHTS = ("'2024-03-01'", "[1]", "['']", "['yesterday']", "[['2024-03-01']]", "{}", "nan")
PORTS = ("-1", "0", "65536", "99999999999", "nan", "true", "'x'")
COSTS = ("-1", "1" + "0" * 400, "1e300", "nan", "inf", "true", "'x'", "[]")
WRONG = [
    *((retention, "retention.toml", f"keep_days = {value}", r"retention\.toml") for value in ABSURD),
    *((retention, "retention.toml", f"dagster_history_days = {value}", r"retention\.toml") for value in ABSURD),
    *((retention, "retention.toml", f"hold = {value}", r"retention\.toml: hold") for value in NIGHTS),
    *((receivers_of, "notify.toml", f"{MAIL}port = {value}", "port") for value in PORTS),
    *((receivers_of, "notify.toml", text, r"notify\.toml") for text in RECEIVERS),
    *((read_costs, "costs.toml", f"[HX]\nwash = {value}", r"HX\.wash") for value in COSTS),
    *((alert_limits, "alerts.toml", text, r"alerts\.toml.*" + re.escape(fault)) for text, fault in LIMITS),
    *((chosen_methods, "estimators.toml", text, r"estimators\.toml.*methods are nls, pso, ekf") for text in METHODS),
    *((accepted_terms, "terms.txt", text, r"terms\.txt") for text in ("no_such_term\n", "\udcff\udcfe")),
]


@pytest.mark.parametrize(("read", "name", "text", "message"), WRONG)
def test_wrong_value_names_its_file(tmp_path, read, name, text, message):
    (tmp_path / name).write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises({receivers_of: NotifyError, read_costs: CostError}.get(read, StoreError), match=message):
        read(tmp_path)


def test_retention_lasts_thirty_days(tmp_path):
    assert retention(tmp_path) == Retention(30, ())


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            'keep_days = 400\nhold = ["2024-03-01", "2024-05-01"]',
            Retention(400, ("2024-03-01", "2024-05-01")),
        ),
        ("dagster_history_days = 400", Retention(dagster_history_days=400)),
        ("hold = [2024-03-01, '2024-03-02T04:00']", Retention(30, ("2024-03-01", "2024-03-02T04:00"))),
    ],
    ids=["days", "days of history", "date of TOML"],
)
def test_home_sets_retention(tmp_path, text, expected):
    (tmp_path / "retention.toml").write_text(text)
    assert retention(tmp_path) == expected


SET = [
    (retention, "retention.toml", "keep_days = 400"),
    (receivers_of, "notify.toml", f"{MAIL}port = 25"),
    (read_costs, "costs.toml", "[HX]\nwash = 700"),
    (alert_limits, "alerts.toml", "soon_flights = 70"),
    (chosen_methods, "estimators.toml", "HX = 'ekf'"),
    (accepted_terms, "terms.txt", "flow_leak\n"),
]


@pytest.mark.parametrize(("read", "name", "text"), SET, ids=[name for _, name, _ in SET])
def test_byte_order_mark_changes_no_setting(tmp_path, read, name, text):
    plain, marked = tmp_path / "plain", tmp_path / "marked"
    for home, encoding in ((plain, "utf-8"), (marked, "utf-8-sig")):
        home.mkdir()
        (home / name).write_text(text, encoding=encoding)

    assert repr(read(marked)) == repr(read(plain))


@pytest.mark.parametrize("text", [DEEP, "x = \ud800", "=", "x = 1", f"x = {'9' * 5_000}"])
@pytest.mark.parametrize(
    ("name", "read", "error"),
    [
        ("retention.toml", retention, StoreError),
        ("notify.toml", receivers_of, NotifyError),
        ("costs.toml", read_costs, CostError),
    ],
)
def test_bad_toml_is_refused(tmp_path, name, read, error, text):
    (tmp_path / name).write_bytes(text.encode("utf-8", "surrogatepass"))
    with pytest.raises(error, match=r"\.toml"):
        read(tmp_path)


@pytest.mark.parametrize(("name", "text"), [
    ("retention.toml", "keep_days = 99999999999"), ("retention.toml", "dagster_history_days = 0"),
    ("estimators.toml", "HX = 'magic'"), ("notify.toml", "receiver = 1"), ("terms.txt", "none"),
])  # fmt: skip
def test_wrong_setting_stops_the_night(sample_landing, tmp_path, name, text):
    """Before it does anything."""
    (tmp_path / name).write_text(text)
    night = hdt("nightly", "--landing", sample_landing, "--home", tmp_path)
    assert (night.returncode, len(night.stderr.strip().splitlines())) == (2, 1), night.stderr
    assert re.match(rf"hdt: .*{re.escape(name)}", night.stderr.strip())
    assert not (tmp_path / "tables").exists()


def test_absurd_days_are_refused(sample_home):
    assert hdt("tidy", "--home", sample_home, "--keep-days", "99999999999").returncode == 2


def test_home_is_closed_to_others(sample_home):
    """To all but its owner and group."""
    modes = {f: stat.S_IMODE(f.stat().st_mode) for f in (sample_home, *sample_home.rglob("*"))}
    assert [f for f, mode in modes.items() if mode & 0o007] == []
    ledger = {f: mode for f, mode in modes.items() if f.name.startswith("ledger.") and "sealed" not in f.name}
    assert set(ledger.values()) == {0o600}
    if not modes[sample_home] & 0o040:
        pytest.skip("this account's own mask keeps out its group, too")
    assert {modes[f] & 0o040 for f in (sample_home / "catalog.duckdb", *sample_home.rglob("*.parquet"))} == {0o040}


@pytest.mark.parametrize("name", ["cases.sqlite", "new"])
def test_open_file_becomes_private(tmp_path, name):
    (tmp_path / "cases.sqlite").touch(0o666)
    assert stat.S_IMODE(make_private(tmp_path / name).stat().st_mode) == 0o600


@pytest.mark.parametrize(("before", "after"), [(0o000, 0o027), (0o022, 0o027), (0o077, 0o077)])
def test_narrower_mask_stays(before, after):
    mask = os.umask(before)
    try:
        assert narrow_umask() == before
        assert os.umask(before) == after
    finally:
        os.umask(mask)


def test_alert_limits_have_defaults(tmp_path):
    assert (alert_limits(tmp_path), changed_limits(tmp_path)) == (Limits(), ())


def test_home_sets_alert_limits(tmp_path):
    """And the rest stays."""
    (tmp_path / "alerts.toml").write_text("fouling = 0.12\nwear_persistence = [2, 3, 15]\nclog = 0.1\n")
    limits = alert_limits(tmp_path)
    assert (limits.fouling, limits.wear_persistence, limits.compressor) == (0.12, (2, 3, 15), Limits().compressor)
    assert changed_limits(tmp_path) == ("fouling = 0.12", "wear_persistence = (2, 3, 15)")


def test_home_names_methods_of_components(tmp_path):
    (tmp_path / "estimators.toml").write_text('HX = "ekf"\nCC = { health = "ukf" }\n')

    assert chosen_methods(tmp_path) == {"HX": Methods("ekf", "ekf"), "CC": Methods("nls", "ukf")}


def test_component_takes_method_by_use(tmp_path):
    (tmp_path / "estimators.toml").write_text('CC = { design = "pso", health = "ukf" }\n')

    assert [by_home(CC, tmp_path, use).estimator for use in ("design", "health")] == ["pso", "ukf"]


def test_component_without_a_line_stays(tmp_path):
    (tmp_path / "estimators.toml").write_text('HX = "ekf"\n')

    assert by_home(CC, tmp_path, "health") is CC


def test_method_of_another_package_is_known(tmp_path, monkeypatch):
    install_method(monkeypatch, Newton())
    (tmp_path / "estimators.toml").write_text(f'HX = "{NAME}"\n')

    chosen = chosen_methods(tmp_path)
    forget_methods()

    assert chosen == {"HX": Methods(NAME, NAME)}


def test_refusal_names_key_value_methods(tmp_path):
    (tmp_path / "estimators.toml").write_text("HX = 'magic'")

    with pytest.raises(StoreError) as refusal:
        chosen_methods(tmp_path)

    assert re.search(r"estimators\.toml: 'HX' = 'magic': .*methods are nls, pso, ekf, ukf, pinn", str(refusal.value))


@pytest.mark.parametrize("text", ["", 'HX = "nls"\n'])
def test_declared_method_changes_nothing(tmp_path, text):
    (tmp_path / "estimators.toml").write_text(text)

    assert [name for name, read in HOME_SETTINGS.items() if read(tmp_path)] == []


def test_accepted_terms_renew_the_model(tmp_path):
    before = baseline_inputs(Ledger(tmp_path))
    accept_terms(tmp_path, ["water_spray", "flow_leak", "water_spray"])
    assert accepted_terms(tmp_path) == ("flow_leak", "water_spray")
    assert baseline_inputs(Ledger(tmp_path)) == [*before, "term flow_leak", "term water_spray"]
    accept_terms(tmp_path, [])
    assert baseline_inputs(Ledger(tmp_path)) == before


def test_unknown_term_changes_nothing(tmp_path):
    before = baseline_inputs(Ledger(tmp_path))
    with pytest.raises(KeyError):
        accept_terms(tmp_path, ["unheard_of"])
    assert baseline_inputs(Ledger(tmp_path)) == before


def test_terms_are_written_by_hand(tmp_path):
    terms_file(tmp_path).write_text("# by hand\n\n inlet_gain \n")
    assert accepted_terms(tmp_path) == ("inlet_gain",)


@pytest.fixture
def old_home(tmp_path) -> Path:
    """A home that has seen a night."""
    (tmp_path / "catalog.duckdb").touch()
    return tmp_path


def test_command_changes_accepted_terms(old_home):
    for option, terms in (("--accept", ("water_spray",)), ("--drop", ())):
        assert hdt("terms", "--home", old_home, option, "water_spray").returncode == 0
        assert accepted_terms(old_home) == terms


def test_command_refuses_unknown_term(old_home):
    assert hdt("terms", "--home", old_home, "--accept", "unheard_of").returncode != 0


def _many_dots(file: Path) -> None:
    file.write_text(f"{'.'.join('a' * 50_000)} = 1")


def _without_end(file: Path) -> None:
    with file.open("wb") as sink:
        sink.truncate(100_000_000_000)


def _link(target: str) -> Callable[[Path], None]:
    return lambda file: file.symlink_to(target)


def _text(text: str) -> Callable[[Path], None]:
    return lambda file: file.write_text(text) and None


ENDLESS: dict[str, Callable[[Path], None]] = {
    "pipe": os.mkfifo, "folder": os.mkdir, "huge": _without_end, "dots": _many_dots, "device": _link("/dev/zero"),
    "loop": _link("../home/loop"), "nowhere": _link("nowhere"),
}  # fmt: skip
UNPRINTABLE: dict[str, Callable[[Path], None]] = {
    "long number": _text(f"keep_days = 0x{'f' * 5_000}\nHX.wash = 0x{'f' * 5_000}\n"),
    "deep key": _text(f"keep_days{'.a' * 900} = 1\n"),
    "key of two lines": _text('"a\\nb" = 1\n'),
}
READERS = {
    "retention.toml": retention, "notify.toml": receivers_of, "costs.toml": read_costs, "alerts.toml": alert_limits,
    "terms.txt": accepted_terms, "estimators.toml": chosen_methods, "roles.toml": read_people, "tasks.toml": read_tasks,
    "dagster/dagster.yaml": open_instance,
}  # fmt: skip


@pytest.mark.parametrize("make", ENDLESS.values(), ids=ENDLESS)
def test_endless_costs_block_no_scan(tmp_path, make):
    landing = tmp_path / "landing"
    home = tmp_path / "home"
    landing.mkdir()
    home.mkdir()
    make(home / "costs.toml")

    scan(landing, Ledger(home))

    assert Ledger(home).file_records().keys() == {"costs.toml"}


@pytest.mark.parametrize("make", ENDLESS.values(), ids=ENDLESS)
@pytest.mark.parametrize(("name", "read"), READERS.items())
def test_endless_file_is_refused(tmp_path, name, read, make):
    file = tmp_path / "home" / name
    file.parent.mkdir(parents=True)
    make(file)

    with pytest.raises((CostError, NotifyError, StoreError)) as fault:
        read(tmp_path / "home")

    assert str(fault.value).isprintable()


@pytest.mark.parametrize("make", UNPRINTABLE.values(), ids=UNPRINTABLE)
@pytest.mark.parametrize(("name", "read"), [item for item in READERS.items() if item[0].endswith(".toml")])
def test_fault_is_shown_in_one_line(tmp_path, name, read, make):
    make(tmp_path / name)

    with pytest.raises((CostError, NotifyError, StoreError)) as fault:
        read(tmp_path)

    assert str(fault.value).isprintable()
    assert len(str(fault.value)) < 500


@pytest.mark.parametrize("text", ["run_launcher: [\n", "- 1\n", "no_such_setting: 1\n"])
def test_wrong_settings_of_dagster_are_named(tmp_path, text):
    file = tmp_path / "dagster/dagster.yaml"
    file.parent.mkdir()
    file.write_text(text)

    with pytest.raises(StoreError, match=re.escape(str(file))) as fault:
        open_instance(tmp_path)

    assert str(fault.value).isprintable()


def test_dagster_settings_are_read_first(sample_landing, tmp_path):
    (tmp_path / "dagster").mkdir()
    os.mkfifo(tmp_path / "dagster/dagster.yaml")

    night = hdt("nightly", "--landing", sample_landing, "--home", tmp_path)

    assert night.returncode == 2
    assert len(night.stderr.strip().splitlines()) == 1
