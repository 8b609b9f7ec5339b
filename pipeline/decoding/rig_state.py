"""State of a rig that is estimated from its frames, where neither settings nor calibration specify it."""

from dataclasses import dataclass, field
from typing import Literal

from pipeline.decoding.front_side import RimVotes
from pipeline.decoding.self_calibration import LightEstimate
from pipeline.models import CodeName

#: What a frame may be asked for.
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
    """Crosstalk and response by the first frame with fringes, where nothing else tells the crosstalk; decoders use it
    if it is `reliable`. None: it has told nothing."""
    code: CodeName | None = None
    """The pattern's code: by settings, calibration or a frame; None: there is none, or none yet."""
    rims: RimVotes = field(default_factory=RimVotes)
    """What the first frame that shows it clearly, or the last one, tells of which side is in front."""
    asks: frozenset[Asked] = frozenset({"light", "code", "rims"})
    """What frames to come are asked for; what is not in it is settled."""
