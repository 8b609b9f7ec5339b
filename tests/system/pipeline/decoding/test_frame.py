"""A frame holds values: it may be kept, looked at late, and from anywhere."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from pipeline import Decoder, DecodeSettings
from pipeline.decoding.frame import FIELDS, RegionOrders, memory_of, read_back
from pipeline.errors import CalibrationError, SettingsError
from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig
from tikernels import ShapeError, runtime

SIZE = (128, 96)


def frames(arch, count, **options):
    """Return decoded frames of a bust that comes nearer, none of which anybody has looked at, and their images."""
    rig = simulated_rig(SIZE, period_px=2 * 768 / 44).model_copy(update={"crosstalk_matrix": np.eye(3)})
    decoder = Decoder(DecodeSettings(**options), rig, arch=arch)
    settings = [
        SimulationSettings(crosstalk_matrix=np.eye(3), object_motion_mm=(0, 0, -k), seed=k) for k in range(count)
    ]
    images = [simulate_frame(rig, setting).image for setting in settings]
    return decoder, images, [decoder.decode(image) for image in images]


def values(frame):
    return {name: np.array(getattr(frame, name)) for name in FIELDS}


def assert_same(one, other):
    for name in FIELDS:
        np.testing.assert_array_equal(one[name], other[name], err_msg=name)


def test_many_frames_that_nobody_has_looked_at(arch):
    """Each has its own values, though buffers of frames that are gone are used again."""
    different, count = (4, 25) if arch == "cpu" else (2, 5)  # where a frame takes two seconds
    decoder, images, some = frames(arch, different)
    kept = [decoder.decode(images[k % different]) for k in range(count)]
    expected = [values(frame) for frame in some]
    for k, frame in enumerate(kept):
        np.testing.assert_array_equal(frame.unwrapped_phase, expected[k % different]["unwrapped_phase"])
        np.testing.assert_array_equal(frame.points, expected[k % different]["points"])
    assert_same(values(kept[-1]), expected[(count - 1) % different])


def test_arrays_outlive_their_frame(cpu):
    decoder, images, (frame, other) = frames("cpu", 2)
    mask, depth = frame.mask, frame.points[..., 2]
    expected = mask.copy(), depth.copy()
    del frame, other
    for image in [*images, *images]:
        decoder.decode(image)
    np.testing.assert_array_equal(mask, expected[0])
    np.testing.assert_array_equal(depth, expected[1])


def test_another_thread_may_look_while_the_next_frame_is_decoded(arch):
    decoder, images, (first, *_) = frames(arch, 3)
    expected = values(decoder.decode(images[0]))
    with ThreadPoolExecutor(2) as pool:
        looked = pool.submit(values, first)
        for k in range(6 if arch == "cpu" else 3):
            decoder.decode(images[k % 3])
        found = looked.result(timeout=120)
    assert_same(found, expected)


def test_what_travels_to_the_next_frame(cpu):
    decoder, images, (frame, _) = frames("cpu", 2)
    memory = memory_of(frame)
    assert memory.checked((96, 128), "horizontal", 2.0).elapsed == 2.0
    with pytest.raises(ShapeError, match="frame is 64x48 but the one before is 128x96"):
        memory.checked((48, 64), "horizontal", 1.0)
    with pytest.raises(SettingsError, match="stripes are vertical"):
        memory.checked((96, 128), "vertical", 1.0)
    # It does not change with the frame that took it.
    before = runtime.to_host(memory.surface.unwrapped)
    decoder.decode(images[1], previous=frame)
    np.testing.assert_array_equal(runtime.to_host(memory.surface.unwrapped), before)


def test_a_frame_without_regions_knows_no_orders():
    nowhere = RegionOrders.of_no_region()
    assert nowhere.known.tolist() == [False]
    assert np.isnan(nowhere.error_probability).all()


def test_fetched_is_what_is_needed(cpu):
    _, _, (frame,) = frames("cpu", 1)
    read_back(frame, ["fringe_order"])
    assert {"mask", "unwrapped_phase"} <= set(vars(frame))
    assert "points" not in vars(frame)


class Failing:
    """An unwrapping that gives up."""

    def unwrap(self, phase, quality):
        """Fail."""
        raise ArithmeticError("no luck")


def test_what_could_not_be_written_again_holds_nothing(cpu):
    """Half of one frame and half of another would look like a result."""
    decoder, images, (frame, _) = frames("cpu", 2)
    assert frame.mask.any()
    failing = Decoder(decoder.settings, decoder.calibration, arch="cpu", unwrapper=Failing())
    with pytest.raises(ArithmeticError):
        failing.decode(images[1], out=frame)
    assert not frame.mask.any()
    assert np.isnan(frame.unwrapped_phase).all()
    assert not frame.modulation.any()
    # What is refused before anything is written leaves it as it was.
    whole = decoder.decode(images[0])
    expected = values(whole)
    with pytest.raises(CalibrationError):
        decoder.decode(images[0][:40], out=whole)
    assert_same(values(whole), expected)


def test_the_reference_stays_when_its_frame_is_written_again(cpu):
    rig = simulated_rig(SIZE, period_px=2 * 768 / 44)
    plane, bust = (simulate_frame(rig, SimulationSettings(scene=scene)).image for scene in ("plane", "bust"))
    settings = DecodeSettings(crosstalk_matrix=SimulationSettings().crosstalk_matrix)
    reference = Decoder(settings, arch="cpu").decode(plane)
    decoder = Decoder(settings, reference=reference, arch="cpu")
    expected = np.array(decoder.decode(bust).range_image)
    np.testing.assert_array_equal(decoder.decode(bust, out=reference).range_image, expected)


def test_out_takes_the_new_frame_and_forgets_the_old(cpu):
    decoder, images, (frame, other) = frames("cpu", 2)
    expected = values(other)
    values(frame)
    assert decoder.decode(images[1], out=frame) is frame
    assert_same(values(frame), expected)


@pytest.mark.parametrize("stripes", ["horizontal", "vertical"])
def test_the_texture_is_of_the_image_as_it_was(cpu, stripes):
    """A camera may write its next picture where the last one lay."""
    rig = simulated_rig(SIZE, period_px=2 * 768 / 44, stripes=stripes)
    decoder = Decoder(
        DecodeSettings(stripes=stripes, crosstalk_matrix=SimulationSettings().crosstalk_matrix), arch="cpu"
    )
    image = simulate_frame(rig).image
    expected = np.array(decoder.decode(image).texture)
    frame = decoder.decode(image)
    image[...] = 255 - image
    decoder.decode(255 - image)
    np.testing.assert_array_equal(frame.texture, expected)
    assert expected.shape == image.shape and expected[frame.mask].any(axis=-1).all()
