"""Files of every kind that other programs write: each gives the phase that its planes hold, or is refused by its cause.

All hold one simulated frame. What it should give is decoded from the planes that went into the file, or of a codec
with loss from those that PyAV takes out of it, by the float64 twins of the kernels. Layouts that hold no phase are
refused in one line that names them.
"""

from collections import Counter
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from support.picture_matrix import FILES, SIZE_PX, File, levels_of, pil, twin
from support.video_matrix import Film, films, taken_out, write

from pipeline import Decoder, DecodeSettings
from pipeline.errors import FootageError
from pipeline.footage.footage import StoredFrame
from pipeline.footage.opening import open_footage
from pipeline.output.report import measure_against_truth
from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig
from tikernels.raw.development import develop
from tikernels.runtime import to_host

pytestmark = [
    pytest.mark.usefixtures("cpu"),
    pytest.mark.filterwarnings("ignore::pipeline.errors.DecodeWarning"),  # of 4:1:1 and 4:1:0
]

# By how much more a frame of a file may be off than its planes are.
ALLOWED = 1.1


class Bench:
    """The simulated frame, and decoders that know its rig."""

    def __init__(self) -> None:
        rig = simulated_rig(SIZE_PX, period_px=2 * 768 / 44)
        settings = SimulationSettings(scene="waves", bits=16)
        self.truth = simulate_frame(rig, settings)
        self.picture = self.truth.image / 65535.0
        self.levels = levels_of(self.picture)
        self._rig = rig.model_copy(update={"crosstalk_matrix": settings.crosstalk_matrix})
        self._decoders: dict[str, Decoder] = {}
        self._known: dict[Any, float] = {}

    def phase_error(self, image: Any, transfer: str) -> float:
        """Return the phase error of a picture, rad; infinite where little is measured."""
        image = np.ascontiguousarray(to_host(image))
        key = (transfer, image.dtype, image.tobytes())  # many files hold the same
        if key not in self._known:
            if transfer not in self._decoders:
                self._decoders[transfer] = Decoder(DecodeSettings(transfer=transfer), self._rig, arch="cpu")
            measured = measure_against_truth(self._decoders[transfer].decode(image), self.truth)
            self._known[key] = measured["phase_rms_rad"] if measured["coverage"] > 0.9 else np.inf
        return self._known[key]


def outcome(path: Path, says: dict[str, Any], wanted: Any, bench: Bench, note: str | None, n_frames: int) -> str:
    """Return what becomes of a file, in a word, or what is wrong.

    It should hold a picture in 0..1, whose light is encoded in a way, or be refused for a reason.
    """
    try:
        source = open_footage(path, **says)
        frames = list(source.frames())
    except FootageError as error:
        named = isinstance(wanted, str) and wanted in str(error) and "\n" not in str(error)
        return "refused by its cause" if named and str(error).count(str(path)) == 1 else f"WRONG: {error}"
    if isinstance(wanted, str) or len(frames) != n_frames or not all(isinstance(each, StoredFrame) for each in frames):
        return f"WRONG: {frames}"
    if note is not None and (note not in source.notes[0] if note else source.notes != ()):
        return f"WRONG: {source.notes}"
    expected, transfer = wanted
    allowed = ALLOWED * bench.phase_error(expected.astype(np.float32), transfer)
    for frame in frames:
        found = bench.phase_error(develop(frame.planes, frame.format), source.transfer or "linear")
        if not found <= allowed < np.inf:
            return f"WRONG: {found:.4f} rad, and {allowed:.4f} are allowed"
    return "decoded"


def of_picture(name: str, case: File, folder: Path, bench: Bench) -> str:
    """Return what becomes of a picture's file; see `outcome`."""
    path = folder / name.replace(":", "")
    try:
        path.write_bytes(case.make(bench.levels))
    except ImportError as error:
        return f"not written ({error})"
    wanted = case.wanted
    if not isinstance(wanted, str):
        planes, format, transfer = wanted(bench.levels)
        wanted = taken_out(path, format) if case.lossy else twin(planes, format), transfer
    return outcome(path, case.says, wanted, bench, case.note or "", case.n_frames)


def of_film(film: Film, folder: Path, bench: Bench) -> str:
    """Return what becomes of a video's file; see `outcome`."""
    path = folder / f"film.{film.container}"
    try:
        expected = write(film, path, bench.picture)
    except (av.error.FFmpegError, ValueError) as error:  # this FFmpeg does not write such a file
        return f"not written ({error})"
    wanted = film.refused if expected is None else (expected, "linear")
    return outcome(path, {"bayer": film.bayer}, wanted, bench, None, 1)


def test_every_file_gives_the_phase_that_its_planes_hold_or_its_cause(tmp_path):
    """Of 271 files 218 are decoded, and 53 refused; an FFmpeg that writes fewer kinds leaves some out."""
    bench = Bench()
    pictures = {name: of_picture(name, case, tmp_path, bench) for name, case in FILES.items()}
    videos = {f"a video: {film}": of_film(film, tmp_path, bench) for film in films()}
    outcomes = pictures | videos
    counted = {
        kind: Counter(what.partition(" (")[0].partition(":")[0] for what in found.values())
        for kind, found in (("pictures", pictures), ("videos", videos), ("files", outcomes))
    }
    for kind, counts in counted.items():
        print(f"\n{counts.total()} {kind}: {dict(counts)}", end="")
    print(*(f"\n{name}: {what}" for name, what in outcomes.items() if what.startswith("not written")))
    assert {name: what for name, what in outcomes.items() if what.startswith("WRONG")} == {}
    assert counted["files"].total() == 271
    assert counted["files"]["decoded"] >= 200 and counted["files"]["refused by its cause"] >= 45


def test_planes_of_webp_are_better_than_its_rgb(tmp_path):
    """Its chroma has half the resolution; what OpenCV interpolates costs more."""
    bench = Bench()
    path = tmp_path / "lossy.webp"
    path.write_bytes(pil(bench.levels.srgb, "WEBP", quality=100))
    source = open_footage(path)
    (frame,) = source.frames()
    found = bench.phase_error(develop(frame.planes, frame.format), source.transfer)
    assert found < 0.9 * bench.phase_error(cv2.imread(str(path))[..., ::-1], source.transfer)
