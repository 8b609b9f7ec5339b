"""What a report states, and what it leaves out."""

import html
import re
import shutil
import sys

import numpy as np
import pytest
from support.command_in_process import command

import colorphase
from pipeline.acquisition.simulated_studio import LIGHT, BarView
from pipeline.calibration import Uncertainty
from pipeline.diagnosis.artefacts import BallBar, Volume
from pipeline.diagnosis.certificate import under_cells
from pipeline.errors import CalibrationError, FootageError, OutputError
from pipeline.output.stored_result import ResultFrame
from pipeline.pattern import make_pattern
from pipeline.simulation import own_calibration, simulated_truth
from pipeline.view.report import Artefacts, report_calibration, report_result

__all__ = ["command"]

FIELDS = "mask points phase_sigma point_sigma region absolute order_error_probability constant_sigma".split()


@pytest.fixture(scope="module")
def rig():
    rig = colorphase.simulated_rig((160, 120), period_px=64)
    return rig.replace(
        uncertainty=Uncertainty(depth_bias_mm=0.123, reprojection_px=(0.05, 0.08), translation_mm=[0.1, 0.2, 0.3]),
        depth_range_mm=(700, 1100),  # one order is in it
    )


@pytest.fixture(scope="module")
def film(rig, cpu, tmp_path_factory):
    """Return the folder of 60 frames of a plane, three different ones."""
    folder = tmp_path_factory.mktemp("film")
    settings = [colorphase.SimulationSettings(scene="plane", seed=seed) for seed in range(3)]
    images = [colorphase.simulate_frame(rig, each).image for each in settings]
    with colorphase.Recorder(folder / "film.zarr", colorphase.PixelFormat("rgb"), rate_hz=10) as recorder:
        for number in range(60):
            recorder.add(images[number % 3])
    options = {"calibration": rig, "arch": "cpu", "workers": 1}
    colorphase.decode_footage(folder / "film.zarr", folder / "whole", fields=FIELDS, **options)
    colorphase.decode_footage(folder / "film.zarr", folder / "places", fields=("points",), **options)
    rig.write(folder / "calibration.json")
    return folder


def rows(report):
    """Return the rows of all tables outside the viewer: cells by their first one."""
    text = re.sub(r'srcdoc="[^"]*"', "", report)
    found = (re.findall(r"<t[hd]>(.*?)</t[hd]>", row) for row in re.findall(r"<tr>(.*?)</tr>", text))
    return {html.unescape(first): [html.unescape(cell) for cell in cells] for first, *cells in found}


def value(cell, unit):
    """Return a figure of one frame, or the median of several."""
    return float(re.match(rf"(-?[\d.]+)%?(?: \(.*\))? ?{unit}", cell)[1])


def test_a_result(film, rig):
    store = film / "whole" / "result.zarr"
    report = report_result(str(store), rig, Artefacts(plane=True))
    told, result = rows(report), colorphase.StoredResult(store)
    assert told["frames"] == ["50 of 60 frames, evenly spaced"]
    assert told["taken"] == ["0.000 to 5.900 s after the first frame"]
    assert told["size"] == ["160 x 120 px"]
    frame = result[0]
    per_rad = np.nanmedian(frame.point_sigma / frame.phase_sigma)
    assert value(told["noise"][0], "mm") == pytest.approx(np.nanmedian(frame.point_sigma), rel=0.05)
    constant_mm = value(told["constant of all phases"][0], "mm")
    assert constant_mm == pytest.approx(frame.constant_sigma * per_rad, rel=0.1, abs=1e-4)
    assert told["calibration"][0] == "0.123 mm"
    cycle_mm = float(re.match(r"a cycle, ([\d.]+) mm; probability [\d.]+%", told["order"][0])[1])
    assert cycle_mm == pytest.approx(2 * np.pi * per_rad, rel=0.01)
    assert value(told["measured, of all pixels"][0], "%") == pytest.approx(100 * frame.mask.mean(), abs=0.5)
    assert told["regions"] == ["1"]
    largest, trueness, precision = map(float, told["flatness measurement error"])
    noise = float(told["noise of a point"][2])
    assert largest > precision > trueness and noise == precision
    assert noise == pytest.approx(np.nanmedian(frame.point_sigma), rel=0.5)
    assert told["calibration, SHA-256"] == [rig.digest()]
    assert told["smoothing_px"] == ["7"]
    assert "range_image" in told["not stored"][0] and "point_sigma" not in told["not stored"][0]
    assert "8 of 60 frames, evenly spaced. Drag" in report
    assert len(report) < 25e6


def test_what_is_not_stored_is_left_out_and_named(film):
    """Of places alone there is a depth, and no figure is made up."""
    told = rows(report_result(str(film / "places" / "result.zarr")))
    assert told["noise"][0] == "not known: phase_sigma is not stored"
    assert told["constant of all phases"][0] == "not known: constant_sigma is not stored"
    assert told["calibration"][0] == "not known: give --calibration"
    assert told["order"][0] == "a cycle; probability not known: order_error_probability is not stored"
    assert told["measured, of all pixels"][0].startswith("100.0%")
    assert told["absolute, of the measured pixels"] == ["not known: absolute is not stored"]
    assert "point_sigma" in told["not stored"][0] and "mask" in told["not stored"][0]
    with pytest.raises(FootageError, match="lacks phase_sigma or point_sigma: decode with both"):
        report_result(str(film / "places" / "result.zarr"), None, Artefacts(plane=True))


def test_a_result_in_rad_is_not_metric(rig, cpu, tmp_path):
    image = colorphase.simulate_frame(rig, colorphase.SimulationSettings(scene="plane")).image
    colorphase.Decoder(arch="cpu").decode(image).save(tmp_path / "result.zarr")
    told = rows(report_result(str(tmp_path / "result.zarr")))
    assert told["depth, 1 to 99 %"][0].endswith("rad, relative: not metric")
    assert value(told["noise"][0], "rad") < 0.1
    assert told["calibration"][0] == "none: the result is not metric"
    with pytest.raises(FootageError, match="is in rad, not in mm"):
        report_result(str(tmp_path / "result.zarr"), None, Artefacts(plane=True))
    with pytest.raises(CalibrationError, match="was decoded with another calibration"):
        report_result(str(tmp_path / "result.zarr"), rig)


def test_a_frame_without_fringes_has_no_figures(rig, cpu, tmp_path):
    with pytest.warns(colorphase.DecodeWarning):
        colorphase.Decoder(calibration=rig, arch="cpu").decode(np.zeros((120, 160, 3), np.uint8)).save(
            tmp_path / "result.zarr"
        )
    told = rows(report_result(str(tmp_path / "result.zarr"), rig))
    assert told["depth, 1 to 99 %"] == ["nothing is measured"]
    assert told["noise"][0] == "not known" and told["measured, of all pixels"] == ["0.0%"]


def test_texts_of_a_result_stay_texts(film, monkeypatch):
    hostile = "</title></style><script>alert(1)</script><img src=x onerror=alert(1)>\"'&\u202e\0"
    monkeypatch.setattr(ResultFrame, "warnings", (hostile,), raising=False)
    report = report_result(str(film / "whole" / "result.zarr"))
    assert html.escape(hostile[:-2], quote=False)[:80] in report
    assert "<script" not in re.sub(r'srcdoc="[^"]*"', "", report)
    assert "onerror=alert(1)>" not in report and "\u202e" not in report and "\0" not in report
    assert "(50 of 50 frames)" in report
    (rule,) = re.findall(r'Content-Security-Policy" content="([^"]*)"', re.sub(r'srcdoc="[^"]*"', "", report))
    assert rule.startswith("default-src &#39;none&#39;") and "unsafe-inline" not in rule


def test_a_long_result_of_large_frames_stays_small(rig, cpu, tmp_path):
    large = colorphase.simulated_rig((1280, 960), period_px=64)
    image = colorphase.simulate_frame(large, colorphase.SimulationSettings(scene="plane")).image
    with colorphase.Recorder(tmp_path / "film.zarr", colorphase.PixelFormat("rgb"), rate_hz=10) as recorder:
        for _ in range(3):
            recorder.add(image)
    fields = ("points", "mask", "point_sigma", "texture")
    colorphase.decode_footage(
        tmp_path / "film.zarr", tmp_path / "out", calibration=large, arch="cpu", workers=1, fields=fields
    )
    report = report_result(str(tmp_path / "out" / "result.zarr"))
    assert 1e6 < len(report) < 25e6
    assert "All 3 frames, one of 3 x 3 pixels" in report


def test_a_damaged_frame_is_named_and_left_out(film, tmp_path):
    shutil.copytree(film / "whole", tmp_path / "whole")
    store = tmp_path / "whole" / "result.zarr"
    (chunk,) = store.glob("points/c?0.0.0.0")
    chunk.write_bytes(chunk.read_bytes()[:-100])
    report = report_result(str(store))
    assert rows(report)["frames"] == ["49 of 60 frames, evenly spaced"]
    assert "frame 0: points is damaged" in report and "(1 of 50 frames)" in report


def test_a_ball_bar_by_its_stored_frame(cpu, tmp_path):
    known, truth = under_cells(own_calibration()), simulated_truth()
    geometry, rng = known.geometry(), np.random.default_rng(0)
    codes = np.rint(255 * make_pattern(geometry.projector.size_px, geometry.pattern, known.response)) / np.float32(255)
    bar = BallBar(60.0, 160.0)
    place = next(iter(bar.positions(Volume.before(geometry, None))))
    picture = BarView(truth, BallBar(60.0, 160.1), place.turn, place.place_mm, LIGHT, 1).photograph(codes, rng)
    colorphase.Decoder(calibration=known, arch="cpu").decode(picture).save(tmp_path / "result.zarr")
    store = str(tmp_path / "result.zarr")
    told = rows(report_result(store, known, Artefacts(ball_mm=60.0, spacing_mm=160.0)))
    assert float(told["sphere spacing error"][0]) == pytest.approx(0.1, abs=0.08)
    assert told["sphere spacing error"][2] == "n/a"  # one spacing has no scatter
    assert abs(float(told["probing error, size"][1])) < 0.2
    assert 0.1 < float(told["probing error, form"][0]) < 1
    with pytest.raises(CalibrationError, match=r"frame 0: a ball's diameter is 60.\d mm, not 56: give"):
        report_result(store, known, Artefacts(ball_mm=56.0))
    with pytest.raises(CalibrationError, match=r"frame 0: the balls are 160.\d mm apart, not 150: give"):
        report_result(store, known, Artefacts(ball_mm=60.0, spacing_mm=150.0))


def test_a_calibration(rig):
    told = rows(report_calibration(rig, "<b>rig</b>.json"))
    assert told["reprojection, RMS"] == ["camera 0.050 px, projector 0.080 px"]
    assert told["depth, sigma by the calibration"] == ["0.123 mm"]
    assert told["place of the projector, x y z, sigma"] == ["0.100, 0.200, 0.300 mm"]
    assert told["scale"] == ["by the side of the board's squares alone"]
    assert told["calibration, SHA-256"] == [rig.digest()]
    assert "<b>rig" not in report_calibration(rig, "<b>rig</b>.json")


def test_without_jinja2_it_says_what_to_install(rig, monkeypatch):
    monkeypatch.setitem(sys.modules, "jinja2", None)
    with pytest.raises(OutputError, match=r"pip install 'colorphase\[view\]'"):
        report_calibration(rig, "rig.json")


def test_the_command(command, film, tmp_path):
    done = command("report", film / "whole", "--calibration", film / "calibration.json", "--plane", "--out", "r.html")
    assert done.returncode == 0 and re.search(r"wrote r.html: \d\.\d MB", done.stdout), done.stderr
    assert command("report", film / "calibration.json", "--out", "c.html").returncode == 0
    assert "Calibration report" in (tmp_path / "c.html").read_text()
    for arguments, message in (
        (("whole", "--out", "r.html"), "r.html exists already"),
        (("nothing", "--out", "n.html"), "nothing is not a result.zarr that can be read"),
        ((film / "whole", "--spacing-mm", 100, "--out", "n.html"), "add --ball-mm"),
        ((film / "calibration.json", "--plane", "--out", "n.html"), "is a calibration: leave out"),
    ):
        done = command("report", *arguments)
        assert done.returncode == 1 and message in done.stderr and done.stderr.count("error: ") == 1, done.stderr
