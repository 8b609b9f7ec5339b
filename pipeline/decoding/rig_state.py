"""State of a rig that is estimated from its frames, where neither settings nor calibration specify it."""

from dataclasses import dataclass, field
from typing import Literal

from pipeline.decoding.front_side import RimVotes
from pipeline.decoding.self_calibration import LightEstimate
from pipeline.models import CodeName

#: Properties that a frame may be checked for.
Asked = Literal["light", "code", "rims"]


@dataclass(frozen=True)
class RigState:
    """Estimates of a rig from its frames, by which another decoder decodes alike, whichever frames come first.

    Examples
    --------
    >>> first = colorphase.Decoder(arch="cpu")
    >>> frame = first.decode(colorphase.simulate_frame(colorphase.simulated_rig(code="contrast")).image)
    >>> second = colorphase.Decoder(arch="cpu")
    >>> second.state = first.state
    >>> second.state.light, second.state.code
    (<LightEstimate: leaks up to 17.0%, ripple 0.2 rad, reliable>, 'contrast')
    """

    light: LightEstimate | None = None
    """Crosstalk and response by the first frame with fringes, where the crosstalk is otherwise unknown; decoders use it
    if it is `reliable`. None: no estimate."""
    code: CodeName | None = None
    """The pattern's code: by settings, calibration or a frame; None: there is none, or none yet."""
    rims: RimVotes = field(default_factory=RimVotes)
    """Votes for which side is in front, of the first frame that shows it clearly, or of the last one."""
    asks: frozenset[Asked] = frozenset({"light", "code", "rims"})
    """Properties for which further frames are checked; all others are settled."""
