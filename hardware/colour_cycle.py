"""Exposures that see red, green and blue for the same time, of a projector that shows them one after another.

A single-chip DLP projector makes red, green and blue in turn, and each of them by mirrors that flip many times. An
exposure of a whole number of such cycles sees all of it, wherever it starts. One that is longer or shorter by a part
of a cycle sees that part once too often or too rarely: one or two colours, and of these only the mirrors that are on
just then, which depends on the level. So balancing the colours does not undo it.

With a colour whose share of the cycle is w, a fringe of contrast v and an exposure that is off by the fraction d of
itself, a channel is off by at most d / w of its full scale, and the phase by at most

    (4 / 3) (d / w) / v

(from the derivative of the arctangent over three channels a third of a cycle apart, each a + v a cos(phi), full scale
2 a). Three equal colours and a full fringe give 4 d.
"""

import math

from hardware.errors import RigError

#: How far an exposure may be off a whole number of cycles, as a fraction of it: with three equal colours and a full
#: fringe 0.008 rad of phase at most. 59.94 and 60 Hz differ by half of it, and at 60 Hz it is 33 us, while cameras set
#: their exposure to 1 us, or to a row's time of about 10 us.
TOLERANCE = 0.002


def phase_error_limit(deviation: float, share: float = 1 / 3, contrast: float = 1.0) -> float:
    """Return how far the phase can be off, in rad.

    Parameters
    ----------
    deviation : float
        By which fraction of itself the exposure is off a whole number of cycles.
    share : float
        Part of the cycle that the shortest colour takes.
    contrast : float
        The fringe's.

    Examples
    --------
    >>> round(phase_error_limit(0.002), 4)
    0.008
    >>> round(phase_error_limit(0.1 / 2), 4)  # two cycles and a tenth of one
    0.2
    """
    return 4 / 3 * abs(deviation) / share / contrast


def check_exposure(exposure_s: float, colour_cycle_s: float) -> None:
    """Refuse an exposure that is not a whole number of colour cycles.

    Parameters
    ----------
    exposure_s : float
        The camera's.
    colour_cycle_s : float
        Time that the projector's red, green and blue take together.

    Raises
    ------
    RigError
        It is none; the message names the nearest that are.
    """
    cycles = exposure_s / colour_cycle_s
    whole = max(1, round(cycles))
    deviation = cycles / whole - 1
    if abs(deviation) <= TOLERANCE:
        return
    below = math.floor(cycles)
    near = [f"{n * colour_cycle_s:.6g} s" for n in (below, below + 1) if n > 0]
    error = phase_error_limit(deviation)
    harm = f"up to {error:.2g} rad" if error < math.pi else "everything"
    raise RigError(
        f"an exposure of {exposure_s:.6g} s is {cycles:.4g} colour cycles of {colour_cycle_s:.6g} s, and costs {harm}: "
        f"set exposure_s to {' or '.join(near)}"
    )
