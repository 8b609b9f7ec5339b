"""One set of buffers serves all frames of a size and period."""

from pipeline.decoding.workspace import Workspace


def test_it_fits_its_own_size_and_period(cpu):
    work = Workspace(96, 128, 12.0, 3)
    assert work.fits((96, 128), 12.0)
    assert not work.fits((128, 96), 12.0)
    assert not work.fits((96, 128), 13.0)
    assert work.raw_phase.shape == (96, 128)
