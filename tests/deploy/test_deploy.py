"""What can be checked of the container files without an engine: names, commands and settings that fit together."""

import importlib
import pkgutil
import re
import shutil
from pathlib import Path
from urllib.parse import urlsplit

import pytest
import typer
import yaml

from pipelines.cli import app

ROOT = Path(__file__).parents[2]
COMPOSE = yaml.safe_load((ROOT / "compose.yaml").read_text())
SERVICES = COMPOSE["services"]
OURS = {name: s for name, s in SERVICES.items() if "build" in s}
COMMANDS = {  # by name: to load them takes three seconds
    "dagster-webserver": "dagster_webserver.cli:create_dagster_webserver_cli",
    "dagster-daemon": "dagster._daemon.cli:create_dagster_daemon_cli",
    "dagster": "dagster._cli:create_dagster_cli",
}
PACKAGES = ("hdt_core", "pipelines", "dagster_batched", "sql", "extensions")
ARGUMENTS = {
    "webserver": {"listen": "0.0.0.0", "read_only": False},
    "daemon": {"module_name": ("pipelines.definitions",)},
    "night": {},
}


MANIFESTS = (ROOT / "deploy/kubernetes.yaml").read_text()
DOCUMENTS = list(yaml.safe_load_all(MANIFESTS))
DOCKERFILE = (ROOT / "Dockerfile").read_text()
LET_IN = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}


def settings_variables(name: str) -> set[str]:
    """Variables of the environment that settings in `deploy` read."""
    return set(re.findall(r"env: (\w+)", (ROOT / "deploy" / name).read_text()))


@pytest.mark.parametrize("name", sorted(set(OURS) - {"worker"}))
def test_service_takes_its_command(name):
    program, *words = OURS[name]["entrypoint"]
    command = typer.main.get_command(app) if program == "hdt" else pkgutil.resolve_name(COMMANDS[program])()
    if hasattr(command, "commands") and words[0] in command.commands:
        command = command.commands[words.pop(0)]
    params = command.make_context(program, list(words)).params
    assert {k: params.get(k) for k in ARGUMENTS[name]} == ARGUMENTS[name]


def test_celery_takes_worker_command():
    program, of, _, worker, flag, runs_at_once = OURS["worker"]["entrypoint"]
    commands = pkgutil.resolve_name("celery.bin.celery:celery").commands
    options = {o for p in commands[worker].params for o in p.opts}
    assert (program, of, flag in options, runs_at_once.isdigit()) == ("celery", "--app", True, True)


def test_workers_run_dagster_tasks(monkeypatch):
    monkeypatch.setenv("HDT_BROKER_URL", "memory://")
    tasks = importlib.import_module(OURS["worker"]["entrypoint"][2]).app.tasks
    assert any(task.endswith("execute_job") for task in tasks), sorted(tasks)


def test_workers_know_their_broker():
    environment = OURS["worker"]["environment"]
    assert urlsplit(environment["HDT_BROKER_URL"]).hostname in OURS["worker"]["depends_on"]
    assert settings_variables("celery.yaml") <= set(environment)


def test_some_services_wait_for_profile():
    assert {name for name, s in SERVICES.items() if "profiles" in s} == {"broker", "worker", "night"}


def test_mounted_sources_exist():
    mounted = [v.rsplit(":", 2 if v.endswith(":ro") else 1)[0] for s in SERVICES.values() for v in s["volumes"]]
    own_files = [m for m in mounted if m not in COMPOSE["volumes"] and not m.startswith("${")]
    assert [f for f in own_files if not (ROOT / f).is_file()] == []


def test_awaited_services_exist():
    assert all(waited in SERVICES for s in OURS.values() for waited in s["depends_on"])


def test_ports_are_open_to_machine_alone():
    assert all(p.startswith("127.0.0.1:") for s in SERVICES.values() for p in s.get("ports", []))


def test_hooks_run_checked_tools():
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"][0]["hooks"]
    targets = dict(re.findall(r"\n(\w+):(.*(?:\n\t.*)*)", (ROOT / "Makefile").read_text()))
    checked = [tool for part in targets["check"].split() for tool in re.findall(r"\$\(BIN\)/(\S+)", targets[part])]
    assert len(checked) >= len(targets["check"].split())
    assert {h["entry"].split()[0].removeprefix(".venv/bin/") for h in hooks} == set(checked)
    assert all(shutil.which(tool, path=str(ROOT / ".venv/bin")) for tool in checked) or not (ROOT / ".venv").exists()


@pytest.fixture(params=["dagster.yaml", "celery.yaml"])
def settings(request, tmp_path, monkeypatch):
    """Settings of an engine as Dagster reads them."""
    shutil.copy(ROOT / "deploy" / request.param, tmp_path / "dagster.yaml")
    for variable in settings_variables(request.param):
        monkeypatch.setenv(variable, "postgresql://nobody@127.0.0.1:1/none")
    return pkgutil.resolve_name("dagster._core.instance.config:dagster_instance_config")(str(tmp_path))[0]


def test_services_set_variables_of_settings():
    assert all(settings_variables("dagster.yaml") <= set(s["environment"]) for s in OURS.values())


def test_deployed_dagster_sends_no_telemetry(settings):
    assert settings["telemetry"] == {"enabled": False}


def test_deployed_classes_exist(settings):
    classes = [s for s in settings.values() if isinstance(s, dict) and "class" in s]
    assert len(classes) >= 4
    assert all(hasattr(importlib.import_module(s["module"]), s["class"]) for s in classes)


def test_deployed_storage_is_postgres(settings):
    modules = [s["module"] for key, s in settings.items() if key.endswith("_storage")]
    assert ["postgres" in module for module in modules] == [True] * 3


@pytest.mark.parametrize(
    ("kind", "pattern"),
    [
        ("ConfigMap", r"(?:configMap|configMapRef): \{name: ([\w-]+)"),
        ("PersistentVolumeClaim", r"claimName: ([\w-]+)"),
        ("ServiceAccount", r"service_?[aA]ccount_?[nN]ame: ([\w-]+)"),
    ],
)
def test_cluster_makes_what_it_uses(kind, pattern):
    names = {d["metadata"]["name"] for d in DOCUMENTS if d["kind"] == kind}
    assert set() < set(re.findall(pattern, MANIFESTS)) <= names


def test_cluster_shares_settings_of_engines():
    (inside,) = [d["data"]["dagster.yaml"] for d in DOCUMENTS if "dagster.yaml" in d.get("data", {})]
    ours = yaml.safe_load(inside)
    celery = yaml.safe_load((ROOT / "deploy/celery.yaml").read_text())
    alike = ("event_log_storage", "run_storage", "schedule_storage", "run_coordinator", "run_monitoring", "run_retries")
    assert {k: ours[k] for k in alike} == {k: celery[k] for k in alike}
    assert ours["run_launcher"]["class"] == "K8sRunLauncher"


def test_linked_folders_are_in_image():
    links = [f for package in PACKAGES for f in (ROOT / package).rglob("*") if f.is_symlink()]

    targets = {f.resolve().relative_to(ROOT).parts[0] for f in links}

    assert targets == {"docs"}
    assert targets <= LET_IN


def test_image_copies_what_is_let_in():
    lines = [line for line in DOCKERFILE.splitlines() if line.startswith("COPY") and "--from" not in line]
    copied = [w for line in lines for w in line.split()[1:-1]]
    assert set(copied) == LET_IN
    assert all((ROOT / name).exists() for name in copied)


def test_image_runs_without_privileges():
    assert [line for line in DOCKERFILE.splitlines() if line.startswith("USER")] == ["USER 10001"]


def test_image_brings_needed_extras():
    """Every extra that a command or the storage asks for by name, and those of a fleet on several machines."""
    files = [*(ROOT / "pipelines/cli").glob("*.py"), *(ROOT / "pipelines/storage").glob("*.py"),
             ROOT / "docs/storage.md"]  # fmt: skip
    named = re.findall(r"hybrid-digital-twin\[([\w,]+)\]", "".join(f.read_text() for f in files))
    (installed,) = re.findall(r"'\.\[([\w,]+)\]'", DOCKERFILE)
    locked = re.findall(r"--extra (\w+)", (ROOT / "Makefile").read_text())
    assert {"serve", "s3"} <= {extra for extras in named for extra in extras.split(",")} <= set(installed.split(","))
    assert set(installed.split(",")) <= set(locked)


def test_night_shares_locked_versions():
    of_all, of_a_night = (
        set(re.findall(r"^\S+==\S+", (ROOT / name).read_text(), re.MULTILINE))
        for name in ("requirements.lock", "requirements-run.lock")
    )

    assert of_a_night < of_all
