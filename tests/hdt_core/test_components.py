"""What a package may declare and how a bad declaration is refused; robust statistics whose answers are known."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from packages import install

from hdt_core.components import Channel, Record, components
from hdt_core.components.pack import CC, HX
from hdt_core.physics.model import Signal
from hdt_core.robust import huber_weights, median_error, spread, spread_expr

ROOT = Path(__file__).parents[2]


def test_components_have_their_messages():
    codes = {"HX": "21-52-HXTEMP", "CC": "21-51-CCFLOW", "HXT": None, "CAC": None}
    assert {c: k.message_code for c, k in components().items()} == codes


def test_equal_declaration_has_equal_version():
    assert replace(CC).version == CC.version


@pytest.mark.parametrize(
    "change",
    [
        {"warn_loss": 0.06},
        {"model": replace(CC.model, outputs=(*CC.model.outputs[:2], Signal("cc_out_k", "K", sigma=0.8)))},
    ],
    ids=["limit", "model"],
)
def test_changed_declaration_has_another_version(change):
    assert replace(CC, **change).version != CC.version


def test_version_is_that_of_any_process():
    script = "from hdt_core.components import components; print(components()['HX'].version)"
    other = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True)
    assert other.stdout.strip() == HX.version


@pytest.mark.parametrize(
    ("module", "code", "message"),
    [
        ("broken", "raise RuntimeError('no licence')", "can't be loaded: RuntimeError: no licence"),
        ("other", "X = 1", "is no Component"),
        ("twice", "from hdt_core.components.pack import HX as X", "there is a component HX already"),
        ("absent", "", "can't be loaded: AttributeError"),
    ],
)
def test_broken_package_is_named(tmp_path, module, code, message):
    install(tmp_path, module, code, f"mine = {module}:X")
    env = os.environ | {"PYTHONPATH": f"{ROOT}:{tmp_path}"}
    command = [str(Path(sys.executable).parent / "hdt"), "nightly", "--landing", str(ROOT / "data_samples")]
    command += ["--home", str(tmp_path / "h")]
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert message in done.stderr.replace("\n", " ")
    assert f"mine ({module}:X, of the package {module})" in done.stderr.replace("\n", " ")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"code": "hx"}, "two to eight capital letters"),
        ({"loss": "hx_ua_reference_w_k"}, "no health parameter of installed_exchanger"),
        ({"code": "QQ"}, "begin with qq_, not hx_fouling"),
        ({"new_share": 1.0}, "new_share is a chance between 0 and 1, not 1.0"),
        ({"ended_by": ("POLISHED",)}, "ended_by takes REPLACED, CLEANED"),
        ({"record": Record((Channel("a", "hx_in_k", "K", "a"),))}, "no channel and no derivation gives altitude_m"),
    ],
)
def test_contradictory_declaration_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        replace(HX, **change)


NORMAL = np.random.default_rng(5).normal(0.0, 2.0, 200_000)
GROUPS = NORMAL.reshape(-1, 50)


def test_spread_equals_normal_deviation():
    assert spread(NORMAL) == pytest.approx(2.0, rel=0.01)


def test_spread_resists_strays():
    strays = np.where(np.arange(NORMAL.size) % 20 == 0, 1e6, NORMAL)
    assert spread(strays) == pytest.approx(2.0, rel=0.1)


def test_spread_expression_equals_spread():
    assert pl.DataFrame({"x": NORMAL}).select(spread_expr(pl.col("x"))).item() == pytest.approx(spread(NORMAL))


def test_spread_ignores_missing_value():
    assert spread(np.append(NORMAL, np.nan)) == spread(NORMAL)


def test_median_error_is_that_of_medians():
    assert 2.0 * median_error(50.0) == pytest.approx(np.median(GROUPS, axis=1).std(), rel=0.05)


def test_huber_location_is_nearly_efficient():
    place = np.median(GROUPS, axis=1)
    for _ in range(20):
        weight = huber_weights(np.abs(GROUPS - place[:, None]), 2.0)
        place = (weight * GROUPS).sum(axis=1) / weight.sum(axis=1)
    assert GROUPS.mean(axis=1).var() / place.var() == pytest.approx(0.95, abs=0.015)


def test_huber_weights_need_no_scale():
    assert huber_weights(np.array([0.0, 1.0]), 0.0) == pytest.approx([1.0, 1.345e-9])
