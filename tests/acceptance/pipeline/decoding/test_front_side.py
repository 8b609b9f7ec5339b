from support.piled_objects import piled_objects

from pipeline import Decoder


def test_a_clear_side_is_a_right_one_in_piles(cpu):
    """Balls and plates of another oracle; plates say little."""
    clear = 0
    for seed in range(4):
        truth, _ = piled_objects(seed, objects=10, cycles=(3.0, 6.0), gamma=2.0, code=None)
        decoder = Decoder(arch="cpu")
        decoder.decode(truth.image)
        clear += decoder.state.rims.clear
        assert not decoder.state.rims.clear or decoder.state.rims.falls > decoder.state.rims.grows
    assert clear >= 3
