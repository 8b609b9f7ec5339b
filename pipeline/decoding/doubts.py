"""What a frame gives reason to doubt, each in one line that says what to do."""

from pipeline.decoding.frame_reader import LinearFrame
from tikernels.phase.channel_model import ChannelModel
from tikernels.phase.frame_statistics import measure_frame
from tikernels.transposing import transpose

# Below this contrast, blur may have turned the fringe over; a sharp pattern in as much other light has a third.
_MIN_CONTRAST = 0.12
# A fringe that differs by more from what the crosstalk makes is more than the leaks of a good calibration are off by.
_MAX_MISMATCH = 0.12


def fringe_doubt(frame: LinearFrame, stripes: str) -> str:
    """Say why no fringe was found in a frame."""
    if measure_frame(transpose(frame.image), frame.white).period_px is not None:
        other = "vertical" if stripes == "horizontal" else "horizontal"
        return f"no {stripes} fringe stands out, but a {other} one does: set stripes to {other!r}"
    return "no fringe stands out of this frame: check that the pattern is projected, in focus and not over-exposed"


def light_doubts(model: ChannelModel, *, constant_known: bool) -> tuple[str, ...]:
    """Say where the light is not as decoding assumes.

    Parameters
    ----------
    model : ChannelModel
        Fitted to the frame.
    constant_known : bool
        Whether the crosstalk is known, so that a mismatch means that it has changed.
    """
    doubts = []
    if model.contrast < _MIN_CONTRAST:
        doubts.append(
            f"the fringe's contrast is only {model.contrast:.0%}: less motion blur, a sharper focus or less other "
            "light would make it certain"
        )
    if constant_known and model.mismatch > _MAX_MISMATCH:
        doubts.append(
            f"the colours' fringes differ by {model.mismatch:.0%} from what the crosstalk matrix makes of them: "
            "calibrate the light anew (colorphase calibrate check says what is wrong)"
        )
    return tuple(doubts)
