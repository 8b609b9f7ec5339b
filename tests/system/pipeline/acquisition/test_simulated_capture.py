"""The rig of `colorphase capture --rig simulated`: its frames, and the process that renders what it sees."""

import subprocess
from functools import partial

import numpy as np
import pytest
import reference
from support.portrait_figures import WALL_FROM_MM, portrait_figures

from pipeline import Decoder
from pipeline.acquisition import simulated_capture
from pipeline.acquisition.simulated_camera import WEBCAM_NAME
from pipeline.acquisition.simulated_capture import (
    SETTINGS,
    Scene,
    SceneCamera,
    SceneTask,
    place_at,
    render_elsewhere,
    render_scene,
    simulate_place,
    simulated_instruments,
    turn_deg,
)
from pipeline.errors import RenderError
from pipeline.simulation import own_calibration, simulated_truth
from tikernels.errors import DeviceNotReady

SMALL = SceneTask("cpu", 2, "portrait")
PERIOD_S = SETTINGS.timing.period_s


@pytest.fixture
def rendered_here(monkeypatch):
    """Let there be two places, rendered in this process, and the same noise each time."""
    drawn = np.random.default_rng
    monkeypatch.setattr(np.random, "default_rng", lambda seed=0: drawn(seed))
    monkeypatch.setattr(simulated_capture, "_PLACES", 2)
    monkeypatch.setattr(simulated_capture, "render_elsewhere", render_scene)


@pytest.mark.usefixtures("cpu", "rendered_here")
@pytest.mark.filterwarnings("ignore:.* of the pixels show too little of the code")
def test_a_head_that_turns_before_alternating_pictures():
    """The second picture has 0.85 of the light, and decodes to the same phase."""
    told = []
    open_instruments, calibration = simulated_instruments(SETTINGS, "cpu", told.append)
    assert told[-2:] == ["simulating place 1 of 2", "simulating place 2 of 2"]
    trigger, camera = open_instruments()
    assert trigger.limits.counts_strobes and camera.limits.size_px == (640, 480)
    bright, again, turned = (camera._expose(time_s) for time_s in (0.0, 2 * PERIOD_S, PERIOD_S))
    trigger.projector(0.0)
    dim = camera._expose(0.0)
    lit = (bright.mean(axis=-1) > 60) & (bright.max(axis=-1) < 255)
    assert np.median(dim[lit] / bright[lit]) == pytest.approx(0.85, abs=0.02)
    assert np.abs(turned.astype(int) - bright)[lit].mean() > 5
    # Fresh noise of 1.5 levels in each of two frames, rounded.
    assert (again.astype(float) - bright)[lit].std() == pytest.approx(np.sqrt(2 * (1.5**2 + 1 / 12)), rel=0.05)
    decoder = Decoder(calibration=calibration, arch="cpu")
    phases = [decoder.decode(image).wrapped_phase for image in (bright, dim)]
    assert np.nanmedian(np.abs(np.angle(np.exp(1j * (phases[0] - phases[1]))))) < 0.05


def test_the_head_turns_by_a_place_per_frame():
    """To and fro, in bursts that begin whenever they like, also where times are rounded."""
    assert [place_at(number * 1.0, 1.0, 4) for number in range(8)] == [0, 1, 2, 3, 2, 1, 0, 1]
    times_s = 1234.5678 + PERIOD_S * np.arange(500) + 0.001
    places = [place_at(time_s, PERIOD_S, 21) for time_s in times_s]
    assert set(np.abs(np.diff(places))) == {1}
    assert turn_deg(0, 21) == -turn_deg(20, 21) == -2.0 and turn_deg(10, 21) == pytest.approx(0)


@pytest.mark.usefixtures("cpu")
def test_the_brightest_skin_reaches_nine_tenths():
    """Half a per cent of the head may be brighter."""
    frame = simulate_place(1, 3)
    head = frame.mask & (frame.points[..., 2] < WALL_FROM_MM)
    brightest = np.quantile(frame.image[head].max(axis=-1), 0.995) / frame.white_level
    assert brightest == pytest.approx(0.9, abs=0.02)


@pytest.mark.usefixtures("cpu", "rendered_here")
@pytest.mark.filterwarnings("ignore:.* of the pixels show too little of the code")
def test_depth_by_its_own_calibration():
    """Within 0.5 mm RMS and 0.3 mm of bias away from silhouettes, of 850 mm; nothing of the truth is known.

    Some orders are wrong, nearly none of them marked as absolute.
    """
    place, n_places = 1, 3
    truth = simulate_place(place, n_places)
    scene = Scene(((truth.image, truth.image),) * n_places)
    frame = SceneCamera(scene, PERIOD_S, webcam=False).expose(0, 0.0)
    figures = portrait_figures(Decoder(calibration=own_calibration(), arch="cpu").decode(frame), truth)
    assert figures.coverage > 0.85 and figures.coverage_inside > 0.93
    assert figures.right_orders > 0.99 and figures.wrong_and_sure < 0.001
    assert figures.rms_inside_mm < 0.5 and abs(figures.bias_inside_mm) < 0.3


@pytest.mark.usefixtures("cpu", "rendered_here")
def test_the_calibration_is_its_own_or_the_files(tmp_path):
    _, calibration = simulated_instruments(SETTINGS, "cpu", lambda step: None)
    assert calibration.digest() == own_calibration().digest()
    simulated_truth().write(tmp_path / "other.json")
    named = SETTINGS.model_copy(update={"calibration": str(tmp_path / "other.json")})
    _, calibration = simulated_instruments(named, "cpu", lambda step: None)
    assert calibration.digest() == simulated_truth().digest()
    missing = SETTINGS.model_copy(update={"calibration": str(tmp_path / "missing.json")})
    _, calibration = simulated_instruments(missing, "cpu", lambda step: None)
    assert calibration.digest() == own_calibration().digest()


@pytest.mark.parametrize("code", ["contrast", "contrast2"])
@pytest.mark.usefixtures("cpu")
def test_it_shows_the_code_of_its_calibration(monkeypatch, tmp_path, code):
    tasks = []
    dark = np.zeros((4, 4, 3), np.uint16)
    monkeypatch.setattr(
        simulated_capture, "render_elsewhere", lambda task, step: tasks.append(task) or Scene(((dark, dark),) * 2)
    )
    simulated_truth(code).write(tmp_path / "rig.json")
    named = SETTINGS.model_copy(update={"calibration": str(tmp_path / "rig.json")})
    simulated_instruments(named, "cpu", lambda step: None)
    assert tasks[0].code == code
    assert simulate_place(0, 2, tasks[0].scene, tasks[0].code).rig.digest() == simulated_truth(code).digest()


@pytest.mark.usefixtures("cpu", "rendered_here")
def test_a_webcam_encodes_light_and_its_calibration_says_so():
    """Linear light comes back to 3 %, two levels and what JPEG leaves; to 10 % where it was sharpened."""
    webcam = SETTINGS.model_copy(update={"camera": SETTINGS.camera.model_copy(update={"serial": WEBCAM_NAME})})
    open_instruments, calibration = simulated_instruments(webcam, "cpu", lambda step: None)
    assert calibration.capture.transfer == "srgb"
    frame = open_instruments()[1]._expose(0.0)
    truth = simulate_place(0, 2)
    lit = reference.eroded(truth.mask, 4) & (truth.image.min(axis=-1) > 0.1 * truth.white_level)
    light = np.where(frame <= 10.31, frame / 255 / 12.92, ((frame / 255 + 0.055) / 1.055) ** 2.4)
    off = light[lit] / (truth.image[lit] / truth.white_level) - 1
    assert abs(np.median(off)) < 0.03 and np.abs(off).mean() < 0.1


def test_a_webcam_exposes_by_its_own_clock():
    """Told to at any time, it shows what is there at its next frame, 30 a second."""
    places = tuple((np.full((4, 4, 3), 3000 * place, np.uint16),) * 2 for place in range(1, 22))
    camera = SceneCamera(Scene(places), 0.01, webcam=True)
    for told_s, shown_s in ((0.0, 0.0), (0.001, 1 / 30), (0.033, 1 / 30), (0.04, 2 / 30)):
        light = 3000 * (1 + place_at(shown_s, 0.01, 21)) / 65535
        level = 255 * (1.055 * light ** (1 / 2.4) - 0.055)
        assert camera.expose(0, told_s).mean() == pytest.approx(level, abs=3)


@pytest.fixture
def started(monkeypatch):
    """Return the processes that are started."""
    processes, popen = [], subprocess.Popen

    def start(*arguments, **options):
        processes.append(popen(*arguments, **options))
        return processes[-1]

    monkeypatch.setattr(subprocess, "Popen", start)
    return processes


@pytest.mark.usefixtures("cpu")
def test_it_renders_what_this_process_would():
    told = []
    elsewhere, here = render_elsewhere(SMALL, told.append), render_scene(SMALL, lambda step: None)
    assert told[0] == "starting the simulation" and told[-1] == "simulating place 2 of 2"
    for there, expected in zip(elsewhere.places, here.places, strict=True):
        assert np.array_equal(there, expected)


def test_an_error_in_it_is_the_same_here():
    with pytest.raises(DeviceNotReady, match="warp-drive"):
        render_elsewhere(SceneTask("warp-drive", 2, "ball"), lambda step: None)


@pytest.mark.parametrize("death", ["by itself", "interrupted"])
def test_it_ends_whatever_happens(started, death):
    def stop(step):
        if step.startswith("starting the device"):
            if death == "interrupted":
                raise KeyboardInterrupt
            started[0].kill()

    with pytest.raises(KeyboardInterrupt if death == "interrupted" else RenderError):
        render_elsewhere(SMALL, stop)
    assert started[0].returncode is not None


def test_an_interrupt_before_it_is_told_anything_leaves_no_process(started):
    with pytest.raises(KeyboardInterrupt):
        render_elsewhere(SMALL, partial(_stop_at, "starting the simulation"))
    assert not started


def _stop_at(where, step):
    if step == where:
        raise KeyboardInterrupt
