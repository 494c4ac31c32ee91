"""A home names its estimators, and a night runs them."""

import pytest
from answers import query
from nights import run
from zones import drop_fleet, simulated

LINE = 'HX = "ekf"\nCC = { design = "pinn", health = "ukf" }\n'


@pytest.fixture(scope="module")
def homes(tmp_path_factory):
    """Landing zone and home of an aircraft whose second night has methods of its own, and what the nights ran."""
    top = tmp_path_factory.mktemp("estimators")
    landing = top / "landing"
    home = top / "home"
    landing.mkdir()
    home.mkdir()
    zone = simulated(21, 25, operator="QQX", tail="Z9")
    zone.drop_csv(landing)
    zone.drop_papers(landing)
    drop_fleet(landing, [zone])
    run(landing, home)
    before = made_by(home, "health_parameters")
    (home / "estimators.toml").write_text(LINE)
    second = run(landing, home)
    third = run(landing, home)
    return home, before, second, third


def made_by(home, view: str) -> dict[str, str]:
    """Estimator of each parameter."""
    return dict(query(home, f"select distinct parameter, estimator from {view}"))


def test_home_without_file_runs_default(homes):
    _, before, *_ = homes

    assert (before["hx_fouling"], before["hx_fouling_smoothed"]) == ("nls, filtered", "nls, smoothed")


def test_health_names_its_method(homes):
    health = made_by(homes[0], "health_parameters")

    assert (health["hx_fouling"], health["hx_fouling_smoothed"]) == ("ekf, filtered", "ekf, smoothed")
    assert (health["cc_efficiency_loss"], health["cc_effective_diameter_m"]) == ("ukf, filtered", "ukf")


def test_design_names_its_method(homes):
    design = made_by(homes[0], "design_parameters")

    assert (design["hx_exponent_hot"], design["cc_efficiency"]) == ("ekf", "pinn, pooled")


def test_changed_line_counts_at_once(homes):
    second = homes[2]

    assert (second.new_files, second.failed) == (0, {})
    assert second.cells > 0


def test_unchanged_line_leaves_night_idle(homes):
    assert homes[3].idle
