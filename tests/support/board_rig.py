"""The captures of a simulated board, and what may be wrong with them."""

import numpy as np

from pipeline.calibration.simulated_board import BoardCaptures, CaptureLight


class SpoiltCaptures(BoardCaptures):
    """Captures of a board that is partly hidden, or of a camera whose pictures are mirrored."""

    def __init__(
        self, rig, board, turn, place_mm, names, codes, *, seed=0, samples=3, mirror=False, hide=None, **light
    ):  # fmt: skip
        self.mirror, self.hide = mirror, hide
        super().__init__(
            rig, board, turn, place_mm, names, codes, CaptureLight(**light), seed=seed, samples=samples
        )  # fmt: skip

    def drawing(self):
        """Return what is printed, the hidden part black."""
        drawing = super().drawing()
        if self.hide is not None:
            drawing[self.hide] = 0
        return drawing

    def _photograph(self, name):
        picture = super()._photograph(name)
        return np.ascontiguousarray(picture[:, ::-1]) if self.mirror else picture


class MovedCaptures(dict):
    """The captures of a board that stands elsewhere from one picture on."""

    def __init__(self, before, after, first):
        names = list(before)
        later = set(names[names.index(first) :])
        super().__init__({name: (after if name in later else before)[name] for name in names})
