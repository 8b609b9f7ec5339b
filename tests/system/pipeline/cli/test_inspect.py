"""`colorphase inspect` as its user meets it; what it finds has tests of its own."""

import json


def test_a_table_ends_with_a_verdict(folder, command):
    code, said, complained = command("inspect", str(folder / "frame.png"), "--arch", "cpu")
    assert (code, complained) == (0, "")
    lines = said.strip().splitlines()
    assert "saturation" in said and "costs, rad" in said
    assert lines[-1].startswith("fine")


def test_json_is_for_programs_and_what_spoils_has_its_own_code(folder, command):
    code, said, complained = command("inspect", str(folder / "black.png"), "--json", "--arch", "cpu")
    assert (code, complained) == (3, "")
    found = json.loads(said)
    assert found["grade"] == "spoils"
    code, table, _ = command("inspect", str(folder / "black.png"), "--arch", "cpu")
    assert code == 3
    spoilt = ", ".join(finding["topic"] for finding in found["findings"] if finding["grade"] == "spoils")
    assert table.strip().endswith(f"do not use it as it is ({spoilt})")


def test_footage_that_is_not_there_is_one_line(command):
    code, said, complained = command("inspect", "none.mkv")
    assert (code, said) == (1, "")
    assert "no such file" in complained and complained.count("\n") == 1
