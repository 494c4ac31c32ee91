"""The numbers in the docstrings are true."""

import doctest
import importlib
import pkgutil

import pytest

import hdt_core.physics

MODULES = [m.name for m in pkgutil.iter_modules(hdt_core.physics.__path__)]


@pytest.mark.parametrize("name", MODULES)
def test_worked_examples_hold(name):
    assert doctest.testmod(importlib.import_module(f"hdt_core.physics.{name}")).failed == 0
