"""Arrays of other libraries, which have nothing but their protocols."""

import numpy as np
import pytest

from pipeline import Decoder, DecodeSettings
from pipeline.simulation import TYPICAL_CROSSTALK, SimulationSettings, simulate_frame, simulated_rig
from tikernels import ShapeError, runtime
from tikernels.checks import on_host


class Tensor:
    """What lies in the host's memory, as PyTorch or JAX hand it out."""

    def __init__(self, values: np.ndarray) -> None:
        self._values = values

    def __dlpack__(self, **asked):
        return self._values.__dlpack__(**asked)

    def __dlpack_device__(self):
        return self._values.__dlpack_device__()


class OnGpu:
    """What lies on a device of a kind of DLPack's."""

    def __init__(self, kind: int) -> None:
        self._kind = kind

    def __dlpack__(self, **asked):
        raise BufferError("not on the host")

    def __dlpack_device__(self):
        return self._kind, 0


class OfNumba:
    """What only says where it lies on a CUDA GPU."""

    @property
    def __cuda_array_interface__(self):
        return {"shape": (4, 4, 3), "typestr": "|u1", "data": (0, False), "version": 3}


def test_the_hosts_memory_is_looked_at(cpu):
    values = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
    found = on_host("image", Tensor(values))
    assert isinstance(found, np.ndarray) and np.shares_memory(found, values)
    np.testing.assert_array_equal(found, values)


def test_what_is_ours_stays_as_it_is(arch):
    values = np.zeros((2, 3), np.float32)
    buffer = runtime.to_device(values)
    assert on_host("image", values) is values and on_host("image", buffer) is buffer
    assert on_host("image", "a text") == "a text"


@pytest.mark.parametrize(
    ("array", "place"),
    [(OnGpu(2), "a CUDA GPU"), (OnGpu(8), "a Metal GPU"), (OnGpu(99), "a device"), (OfNumba(), "a CUDA GPU")],
)
def test_what_lies_on_a_device_is_refused_with_the_way_to_the_host(cpu, array, place):
    with pytest.raises(ShapeError, match=f"image lies on {place}, .*array.cpu.. of PyTorch"):
        on_host("image", array)


def test_elements_that_numpy_does_not_have_are_refused(cpu):
    with pytest.raises(ShapeError, match="image is a OnGpu that NumPy cannot look at: not on the host"):
        on_host("image", OnGpu(1))


def test_a_frame_of_another_library_is_decoded(cpu):
    """And its results are handed out by the same protocol."""
    image = simulate_frame(simulated_rig((320, 240)), SimulationSettings(scene="plane")).image
    decoder = Decoder(DecodeSettings(crosstalk_matrix=TYPICAL_CROSSTALK), arch="cpu")
    expected, frame = decoder.decode(image), decoder.decode(Tensor(image))
    np.testing.assert_array_equal(frame.unwrapped_phase, expected.unwrapped_phase)
    assert np.shares_memory(np.from_dlpack(frame.unwrapped_phase), frame.unwrapped_phase)
    with pytest.raises(ShapeError, match="image lies on a CUDA GPU"):
        decoder.decode(OnGpu(2))
