"""The file of roles: two forms of an entry, and whatever else stands in it is named."""

import pytest

from pipelines.storage.objects import StoreError
from pipelines.web.sign_in import FILE, Person, local_person, read_people


def test_a_role_or_a_table_of_role_and_operators(tmp_path):
    (tmp_path / FILE).write_text("""
local = "viewer"
[people]
"ada@example.org" = "engineer"
"Line 1" = { role = "viewer", operators = ["AQX", "BZR"] }
""")
    assert read_people(tmp_path) == {
        "ada@example.org": Person("ada@example.org", "engineer"),
        "Line 1": Person("Line 1", "viewer", ("AQX", "BZR")),
    }
    assert local_person(tmp_path).role == "viewer"


def test_without_a_file_the_token_is_an_engineers_and_nobody_has_a_name(tmp_path, monkeypatch):
    monkeypatch.setenv("USER", "ada")
    assert read_people(tmp_path) == {}
    assert local_person(tmp_path) == Person("ada", "engineer")
    monkeypatch.delenv("USER")
    assert local_person(tmp_path).name == "local"


def test_a_viewer_changes_nothing_and_operators_bound_what_is_seen():
    assert [Person("a", role).may_change for role in ("viewer", "engineer")] == [False, True]
    assert [Person("a", operators=of).may_read("AQX") for of in ((), ("AQX",), ("BZR",))] == [True, True, False]


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("people = 1", "people is a table"),
        ("[person]\nAda = 'viewer'", "no setting 'person'"),
        ("[people]\nAda = 'admin'", "'Ada': role is viewer or engineer, not 'admin'"),
        ("[people]\nAda = ['viewer']", "'Ada': role is viewer or engineer"),
        ("[people]\nAda = {role = 'viewer', operator = 'AQX'}", "'Ada': unknown key operator"),
        ("[people]\nAda = {role = 'viewer', operators = 'AQX'}", "'Ada': operators is a list"),
        ("[people]\nAda = {role = 'viewer', operators = []}", "'Ada': operators is empty"),
        ("[people]\n'' = 'viewer'", "a name has 1 to 80 printable characters"),
        ("[people]\n\"A\\nB\" = 'viewer'", "a name has 1 to 80 printable characters"),
        ("[people]\nAda = 'viewer'\nAda = 'engineer'", "no TOML"),
        ("[people", "no TOML"),
        ("a = " + "[" * 100_000, "no TOML"),
    ],
)
def test_what_is_wrong_is_named_in_one_line(tmp_path, text, named):
    (tmp_path / FILE).write_text(text)
    with pytest.raises(StoreError, match=FILE) as error:
        read_people(tmp_path)
    assert named in str(error.value)
    assert "\n" not in str(error.value)


def test_bytes_that_are_no_text_are_told(tmp_path):
    (tmp_path / FILE).write_bytes(b"\xff")
    with pytest.raises(StoreError, match="can't be read"):
        local_person(tmp_path)
