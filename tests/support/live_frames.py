"""Frames for live decoding, and how to wait for what becomes of them."""

import time

import pytest

from pipeline.simulation import SimulationSettings, simulate_frame, simulated_rig

SIZE_PX = (128, 96)
# Starting takes 3 to 12 s, by machine, most of it making machine code; next to other work several times as long.
PATIENCE_S = 180


@pytest.fixture(scope="module")
def rig():
    settings = SimulationSettings()
    return simulated_rig(SIZE_PX, period_px=2 * 768 / 44).model_copy(
        update={"crosstalk_matrix": settings.crosstalk_matrix}
    )


@pytest.fixture(scope="module")
def image(rig, cpu):
    return simulate_frame(rig, SimulationSettings()).image


def wait_for(so, patience_s=PATIENCE_S):
    end = time.monotonic() + patience_s
    while not so():
        assert time.monotonic() < end, "it does not come"
        time.sleep(0.002)


def decoded(decoder, frame, number):
    """Offer a frame until it is taken, and return what becomes of it."""
    wait_for(lambda: decoder.offer(frame, number, time.monotonic()) or decoder.ended)
    wait_for(lambda: decoder.ended or (decoder.latest() is not None and decoder.latest().number == number))
    return decoder.latest()
