"""`colorphase devices` as its user meets it."""

from tikernels import runtime


def test_devices_names_archs_and_the_kernel_language(command):
    code, said, _ = command("devices")
    assert code == 0
    assert "cpu" in said
    assert runtime.kernel_language() in said


def test_devices_lists_displays(command, monkeypatch):
    code, said, _ = command("devices")
    assert code == 0
    assert "1024x768" in said
    monkeypatch.setenv("SDL_VIDEODRIVER", "none such")
    code, said, complained = command("devices")
    assert (code, complained) == (0, "")
    assert "display" not in said
