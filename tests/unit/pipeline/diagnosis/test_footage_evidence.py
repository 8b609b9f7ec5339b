"""Which frames of footage are looked at."""

import numpy as np
import pytest
from support.numbered_frames import record

from pipeline.diagnosis.footage_evidence import _runs, bits_of, gather_evidence
from pipeline.footage.footage import StoredAs
from pipeline.footage.opening import open_footage
from pipeline.recording.recorder import Recorder
from pipeline.settings import DecodeSettings
from tikernels.raw.pixel_format import PixelFormat


@pytest.mark.parametrize("n_frames", [1, 2, 3, 11, 20, 150, 100_000])
def test_neighbours_all_over_and_a_run_in_the_middle(n_frames):
    runs = _runs(n_frames)
    numbers = [number for run in runs for number in run]
    assert numbers == sorted(set(numbers)) and numbers[0] >= 0 and numbers[-1] < n_frames
    assert len(numbers) <= 20
    longest = max(runs, key=len)
    assert len(longest) == min(12, n_frames)
    if n_frames > 40:
        assert numbers[0] == 0 and numbers[-1] == n_frames - 1
        assert abs(np.mean(longest) - n_frames / 2) < 7


@pytest.mark.usefixtures("cpu")
def test_noise_has_no_fringes_and_repeated_frames_are_counted(tmp_path):
    image = np.random.default_rng(0).integers(0, 256, (48, 64, 3), np.uint8)
    with Recorder(tmp_path / "a.zarr", PixelFormat("rgb")) as recorder:
        for _ in range(3):
            recorder.add(image)
    told = []
    seen = gather_evidence(open_footage(tmp_path / "a.zarr"), StoredAs(), DecodeSettings(), "cpu", told.append)
    assert (seen.n_frames, seen.n_pairs, seen.repeats) == (3, 2, [1, 2])
    assert {number: why.key for number, why in seen.no_fringes.items()} == dict.fromkeys(range(3), "no fringe")
    assert told[-1] == "frame 2 (3 of 3)"
    assert seen.kept == [] and seen.diagnosis is None


def test_floats_are_as_fine_as_their_mantissa(tmp_path):
    record(tmp_path / "a.zarr", PixelFormat("rgb", 12))
    assert bits_of(open_footage(tmp_path / "a.zarr")) == 12
    with Recorder(tmp_path / "b.zarr", PixelFormat("rgb", 32)) as recorder:
        recorder.add(np.zeros((16, 16, 3), np.float32))
    assert bits_of(open_footage(tmp_path / "b.zarr")) == 24
