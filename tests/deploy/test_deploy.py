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


@pytest.mark.parametrize("name", sorted(set(OURS) - {"worker"}))
def test_service_takes_its_command(name):
    program, *words = OURS[name]["entrypoint"]
    command = typer.main.get_command(app) if program == "hdt" else pkgutil.resolve_name(COMMANDS[program])()
    if hasattr(command, "commands") and words[0] in command.commands:
        command = command.commands[words.pop(0)]
    params = command.make_context(program, list(words)).params
    assert {k: params.get(k) for k in ARGUMENTS[name]} == ARGUMENTS[name]


def test_workers_run_dagster_tasks(monkeypatch):
    """The command as Celery reads it, and the service's own broker in the address that the settings name."""
    monkeypatch.setenv("HDT_BROKER_URL", "memory://")
    program, of, module, worker, flag, runs_at_once = OURS["worker"]["entrypoint"]
    commands = pkgutil.resolve_name("celery.bin.celery:celery").commands
    options = {o for p in commands[worker].params for o in p.opts}
    assert (program, of, flag in options, runs_at_once.isdigit()) == ("celery", "--app", True, True)
    tasks = importlib.import_module(module).app.tasks
    assert any(task.endswith("execute_job") for task in tasks), sorted(tasks)
    environment = OURS["worker"]["environment"]
    assert urlsplit(environment["HDT_BROKER_URL"]).hostname in OURS["worker"]["depends_on"]
    variables = set(re.findall(r"env: (\w+)", (ROOT / "deploy/celery.yaml").read_text()))
    assert variables <= set(environment)


def test_services_name_present_parts():
    assert {name for name, s in SERVICES.items() if "profiles" in s} == {"broker", "worker", "night"}
    mounted = [v.rsplit(":", 2 if v.endswith(":ro") else 1)[0] for s in SERVICES.values() for v in s["volumes"]]
    for source in mounted:
        assert source in COMPOSE["volumes"] or source.startswith("${") or (ROOT / source).is_file(), source
    assert all(waited in SERVICES for s in OURS.values() for waited in s["depends_on"])
    assert all(p.startswith("127.0.0.1:") for s in SERVICES.values() for p in s.get("ports", []))
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"][0]["hooks"]
    targets = dict(re.findall(r"\n(\w+):(.*(?:\n\t.*)*)", (ROOT / "Makefile").read_text()))
    checked = [tool for part in targets["check"].split() for tool in re.findall(r"\$\(BIN\)/(\S+)", targets[part])]
    assert len(checked) >= len(targets["check"].split())
    assert {h["entry"].split()[0].removeprefix(".venv/bin/") for h in hooks} == set(checked)
    assert all(shutil.which(tool, path=str(ROOT / ".venv/bin")) for tool in checked) or not (ROOT / ".venv").exists()


@pytest.mark.parametrize("name", ["dagster.yaml", "celery.yaml"])
def test_dagster_takes_deployed_settings(name, tmp_path, monkeypatch):
    text = (ROOT / "deploy" / name).read_text()
    (tmp_path / "dagster.yaml").write_text(text)
    variables = set(re.findall(r"env: (\w+)", text))
    assert name != "dagster.yaml" or all(variables <= set(s["environment"]) for s in OURS.values())
    for variable in variables:
        monkeypatch.setenv(variable, "postgresql://nobody@127.0.0.1:1/none")
    settings, _ = pkgutil.resolve_name("dagster._core.instance.config:dagster_instance_config")(str(tmp_path))
    assert settings["telemetry"] == {"enabled": False}
    named = [s for s in settings.values() if isinstance(s, dict) and "class" in s]
    assert len(named) >= 4
    assert all(hasattr(importlib.import_module(s["module"]), s["class"]) for s in named)
    kept_in = [s["module"] for key, s in settings.items() if key.endswith("_storage")]
    assert len(kept_in) == 3
    assert all("postgres" in module for module in kept_in)


def test_cluster_manifests_fit_together():
    """Names that one manifest makes and another uses; the settings in it are those of the other engines but for one."""
    documents = list(yaml.safe_load_all((ROOT / "deploy/kubernetes.yaml").read_text()))
    names = {(d["kind"], d["metadata"]["name"]) for d in documents}
    text = (ROOT / "deploy/kubernetes.yaml").read_text()
    for kind, key in (("ConfigMap", "configMap"), ("PersistentVolumeClaim", "claimName"), ("ServiceAccount", "")):
        pattern = {"configMap": r"(?:configMap|configMapRef): \{name: ([\w-]+)", "claimName": r"claimName: ([\w-]+)"}
        named = set(re.findall(pattern.get(key, r"service_?[aA]ccount_?[nN]ame: ([\w-]+)"), text))
        assert named
        assert {(kind, name) for name in named} <= names
    (inside,) = [d["data"]["dagster.yaml"] for d in documents if "dagster.yaml" in d.get("data", {})]
    ours = yaml.safe_load(inside)
    celery = yaml.safe_load((ROOT / "deploy/celery.yaml").read_text())
    alike = ("event_log_storage", "run_storage", "schedule_storage", "run_coordinator", "run_monitoring", "run_retries")
    assert {k: ours[k] for k in alike} == {k: celery[k] for k in alike}
    assert ours["run_launcher"]["class"] == "K8sRunLauncher"


def test_linked_folders_are_in_image():
    let_in = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    links = [f for package in PACKAGES for f in (ROOT / package).rglob("*") if f.is_symlink()]

    targets = {f.resolve().relative_to(ROOT).parts[0] for f in links}

    assert targets == {"docs"}
    assert targets <= let_in


def test_image_brings_needed_extras():
    lines = (ROOT / "Dockerfile").read_text().splitlines()
    copied = [w for line in lines if line.startswith("COPY") and "--from" not in line for w in line.split()[1:-1]]
    let_in = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    assert set(copied) == let_in
    assert all((ROOT / name).exists() for name in copied)
    assert [line for line in lines if line.startswith("USER")] == ["USER 10001"]
    # Every extra that a command or the storage asks for by name, and those of a fleet on several machines.
    files = [*(ROOT / "pipelines/cli").glob("*.py"), *(ROOT / "pipelines/storage").glob("*.py"),
             ROOT / "docs/storage.md"]  # fmt: skip
    named = re.findall(r"hybrid-digital-twin\[([\w,]+)\]", "".join(f.read_text() for f in files))
    (installed,) = re.findall(r"'\.\[([\w,]+)\]'", (ROOT / "Dockerfile").read_text())
    assert {"serve", "s3"} <= {extra for extras in named for extra in extras.split(",")} <= set(installed.split(","))
    locked = re.findall(r"--extra (\w+)", (ROOT / "Makefile").read_text())
    assert set(installed.split(",")) <= set(locked)


def test_night_shares_locked_versions():
    of_all, of_a_night = (
        set(re.findall(r"^\S+==\S+", (ROOT / name).read_text(), re.MULTILINE))
        for name in ("requirements.lock", "requirements-run.lock")
    )

    assert of_a_night < of_all
