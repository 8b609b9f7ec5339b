"""What footage costs in phase, at 12 px a cycle, against the arrays that it was made of."""

import cv2
import numpy as np
import pytest
import reference
from support.video_files import H264, MJPEG, film

from pipeline import Decoder, DecodeSettings
from pipeline.errors import DecodeWarning
from pipeline.footage.opening import open_footage
from pipeline.output.report import measure_against_truth
from pipeline.recording.recorder import Recorder
from pipeline.simulation import WHITE, SimulationSettings, simulate_frame, simulated_rig
from tikernels.raw.development import develop
from tikernels.raw.pixel_format import PixelFormat

pytestmark = pytest.mark.usefixtures("cpu")

EASY = SimulationSettings(scene="waves", gamma=1.0, reflectance=WHITE)
HARD = SimulationSettings(scene="waves")
CENTRE = PixelFormat("yuv", subsampling=(2, 2), siting="centre", matrix="bt601", full_range=True)
LEFT = PixelFormat("yuv", subsampling=(2, 2), siting="left", matrix="bt601")


class Study:
    """One simulated frame, and a decoder that knows its rig."""

    def __init__(self, settings, stripes):
        rig = simulated_rig(stripes=stripes)
        self.stripes = stripes
        self.truth = simulate_frame(rig, settings)
        calibration = rig.model_copy(update={"crosstalk_matrix": settings.crosstalk_matrix})
        self.decoder = Decoder(DecodeSettings(stripes=stripes), calibration, arch="cpu")
        self.of_arrays = self.phase_error(self.truth.image)

    def phase_error(self, image):
        """Return the phase error of a picture, rad."""
        measured = measure_against_truth(self.decoder.decode(image), self.truth)
        assert measured["coverage"] > 0.95
        return measured["phase_rms_rad"]

    def phase_error_of(self, path, number=0, **said):
        """Return the phase error of a frame of a file, rad."""
        (frame,) = open_footage(path, **said).frames(number, number + 1)
        return self.phase_error(develop(frame.planes, frame.format, stripes=self.stripes))


@pytest.fixture(scope="module", params=["horizontal", "vertical"])
def easy(request, cpu):
    return Study(EASY, request.param)


@pytest.fixture(scope="module", params=["horizontal", "vertical"])
def hard(request, cpu):
    return Study(HARD, request.param)


def test_what_is_lossless_costs_nothing(tmp_path, easy):
    (tmp_path / "a.png").write_bytes(cv2.imencode(".png", easy.truth.image[..., ::-1])[1].tobytes())
    with Recorder(tmp_path / "a.zarr", PixelFormat("rgb")) as recorder:
        recorder.add(easy.truth.image)
    for name in ("a.png", "a.zarr"):
        assert easy.phase_error_of(tmp_path / name) <= 1.02 * easy.of_arrays


@pytest.mark.parametrize("name, format, codec", [("m.avi", CENTRE, MJPEG), ("h.mp4", LEFT, H264)])
def test_subsampled_video_without_response_error(tmp_path, easy, name, format, codec):
    path = film(tmp_path / name, easy.truth.image, format, codec)
    assert easy.phase_error_of(path, 2) <= 0.04


@pytest.mark.parametrize("name, format, codec", [("m.avi", CENTRE, MJPEG), ("h.mp4", LEFT, H264)])
def test_subsampled_video_of_the_hard_frame(tmp_path, hard, name, format, codec):
    path = film(tmp_path / name, hard.truth.image, format, codec)
    assert hard.phase_error_of(path, 2) <= 0.06


def test_the_wrong_siting_shows_where_the_fringe_runs_across_it(tmp_path):
    """FFmpeg averages RGB's chroma about the middle and says nothing; the user can."""
    study = Study(EASY, "vertical")
    path = film(tmp_path / "h.mp4", study.truth.image, CENTRE, H264)
    said = {"siting": "centre", "full_range": True}
    assert study.phase_error_of(path, 2, **said) < 0.8 * study.phase_error_of(path, 2, **{**said, "siting": "left"})


def by_opencv(path):
    capture = cv2.VideoCapture(str(path))
    return np.ascontiguousarray([capture.read()[1] for _ in range(3)][-1][..., ::-1])


@pytest.mark.parametrize("name, format, codec", [("m.avi", CENTRE, MJPEG), ("h.mp4", LEFT, H264)])
@pytest.mark.filterwarnings("ignore:no matrix explains")
def test_colours_that_opencv_has_repeated_are_interpolated(tmp_path, hard, name, format, codec):
    """OpenCV does not say where they sit; where the fringe runs across the samples half a pixel matters."""
    path = film(tmp_path / name, hard.truth.image, format, codec)
    of_video = hard.phase_error_of(path, 2, siting="left")
    with pytest.warns(DecodeWarning, match="each colour of this frame is repeated for 2x2 pixels, as cv2.VideoCapture"):
        assert hard.phase_error(by_opencv(path)) <= 1.1 * of_video


@pytest.mark.parametrize("settings", [EASY, HARD], ids=["easy", "hard"])
def test_a_mosaic_is_near_its_limit(settings):
    """The limit: everything known but the phase, from the five pixels of a row that smoothing takes together."""
    study = Study(settings, "horizontal")
    truth = study.truth
    clean = simulate_frame(truth.rig, settings.model_copy(update={"noise_levels": 0.0, "bits": 16})).image / 65535 * 255
    slope = np.gradient(clean, axis=0) / np.gradient(truth.phase, axis=0)[..., None]
    slope *= (np.pi / 6) / np.sin(np.pi / 6)  # what a central difference loses of a period of 12 px
    told = reference.mosaic(slope**2 / (settings.noise_levels**2 + 1 / 12), "rggb")
    told = cv2.boxFilter(told, -1, (5, 1), normalize=False)
    lit = reference.eroded(truth.mask & (clean.mean(axis=-1) > 20), 4)
    limit = np.sqrt((1 / told[lit]).mean())
    mosaic = reference.mosaic(truth.image, "rggb")
    error = study.phase_error(develop((mosaic,), PixelFormat("bayer")))
    assert error <= 1.6 * limit
    assert error < 0.6 * study.phase_error(cv2.cvtColor(mosaic, cv2.COLOR_BAYER_RGGB2RGB))
