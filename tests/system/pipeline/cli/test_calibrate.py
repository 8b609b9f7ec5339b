"""`colorphase calibrate`: which commands it has."""


def test_its_commands_are_named_with_what_they_do(folder, command):
    done = command("calibrate", "--help")
    assert done.returncode == 0
    for name in ("simulate", "radiometry", "wavelengths", "geometry", "check"):
        assert f"│ {name} " in done.stdout, name
