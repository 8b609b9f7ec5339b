"""Frames that another renderer made, and the calibration that radiometry found on its ramps."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline import Decoder, DecodeSettings
from pipeline.calibration import Calibration

DATA = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "rendered"
pytestmark = [
    pytest.mark.usefixtures("cpu"),
    pytest.mark.skipif(not DATA.is_dir(), reason="the rendered frames are not in this checkout"),
    pytest.mark.filterwarnings("ignore:.*of the pixels show too little"),
]
FACE, WALL = 0, 1


def judged(name: str, *, code: str | None = None, known: bool = True, **settings) -> dict[int, tuple[float, float]]:
    """Return the RMS and the constant of the phase error of each surface, 4 px inside and lit, rad."""
    calibration = Calibration.read(DATA / "calibration.json")
    pattern = calibration.pattern.model_copy(update={"code": code, "compensated": False if known else None})
    update = {"pattern": pattern, "capture": None}
    if not known:
        update |= {"crosstalk_matrix": None, "response": None, "uncertainty": None}
    image = np.ascontiguousarray(cv2.imread(str(DATA / f"{name}.png"), cv2.IMREAD_UNCHANGED)[..., ::-1])
    frame = Decoder(DecodeSettings(**settings), calibration.model_copy(update=update), arch="cpu").decode(image)
    truth = np.load(DATA / f"{name.split('_')[0]}_truth.npz")
    error = frame.unwrapped_phase - 2 * np.pi / pattern.period_px * truth["projector_row"]
    bright = image.mean(axis=-1) > 20 / 255 * np.iinfo(image.dtype).max
    inside = np.ones((9, 9), np.uint8)
    result = {}
    for surface in np.unique(truth["surface"][truth["lit"]]):
        own = cv2.erode((truth["lit"] & (truth["surface"] == surface)).astype(np.uint8), inside) > 0
        turns = np.exp(1j * error[own & bright & np.isfinite(error)])
        constant = float(np.angle(turns.mean()))
        result[int(surface)] = (float(np.std(np.angle(turns * np.exp(-1j * constant)))), constant)
    return result


@pytest.mark.filterwarnings("ignore:no matrix explains the colours of [1-4]%")  # the eyes' whites: few places tell
@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize(("frame", "most"), [("face_plain_clean16", 0.058), ("face_plain", 0.052)])
def test_skin_before_a_wall(frame, most, known):
    """Skin is its own surface: 0.067 to 0.069 rad and a constant of -0.046 where one crosstalk serves all."""
    found = judged(frame, known=known)
    assert found[FACE][0] < most
    assert abs(found[FACE][1]) < 0.012
    assert found[WALL][0] < 0.016


def test_a_code_is_not_taken_for_surfaces():
    found, before = (
        judged("face_coded", code="contrast"),
        judged("face_coded", code="contrast", reflectance_bands="broad"),
    )
    assert found[FACE][0] < 0.75 * before[FACE][0]
    assert abs(found[FACE][1]) < 0.5 * abs(before[FACE][1])


@pytest.mark.parametrize("known", [True, False])
def test_a_white_plane_stays_white(known):
    """Noise-free, with a calibration as without."""
    ((rms, constant),) = judged("plane_plain_clean16", known=known).values()
    assert rms < 0.005
    assert abs(constant) < 0.006
