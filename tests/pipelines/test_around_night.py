"""What follows a published night: every hook is called, whatever became of the one before it."""

from importlib.metadata import EntryPoint

from pipelines.orchestration import around_night


def test_a_hook_that_fails_or_is_not_there_keeps_none_of_the_others(monkeypatch, tmp_path):
    values = {
        "c": "posixpath:exists_not",
        "b": "posixpath:islink",
        "a": "no_such_module:f",
        "d": f"{__name__}:name_of_home",
    }
    points = [EntryPoint(name, value, "hdt.after_night") for name, value in values.items()]
    monkeypatch.setattr(around_night, "entry_points", lambda group: points)
    monkeypatch.setattr(EntryPoint, "load", lambda p: name_of_home if p.name == "d" else _load(p))
    result, failed = around_night.call_hooks(tmp_path)
    assert result == {"home": tmp_path.name}
    assert [line[:2] for line in failed] == ["a:", "b:", "c:"]
    assert "no_such_module" in failed[0]


_load = EntryPoint.load


def name_of_home(home):
    return {"home": home.name}
