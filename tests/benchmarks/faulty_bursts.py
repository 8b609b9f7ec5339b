"""Is any frame mispaired? Bursts with faults, of every kind of rig that a rig.toml can name, in virtual time.

python tests/benchmarks/faulty_bursts.py [BURSTS [SEED]]

A row for each kind of rig: bursts that were kept; runs of pulses with a fault; bursts with a mispaired frame, in a way
that docs/rig.md says cannot be seen, and in another; runs without a fault that were thrown away; errors that are not
the rig's own. What lies behind a figure that should be 0 is printed below its row.
"""

import sys
import traceback
from collections import Counter
from dataclasses import dataclass, field, replace
from itertools import islice, product

import _tests_path  # noqa: F401  # puts tests/ on the path
import numpy as np
from support.virtual_rig import EXPOSURE_S, PERIOD_S, READOUT_S, Faults, Instruments, VirtualRig, random_faults

from hardware import rig as rig_module
from hardware.errors import BurstError, CameraError, TriggerError
from hardware.rig import Rejected, Rig

#: What the trigger sources and the cameras of docs/instruments.md and docs/cameras.md tell.
TRIGGERS = {
    "box": {"strobe": False},
    "box, strobe": {"strobe": True},
    "box, strobe, vsync": {"strobe": True, "vsync": True},
    "box, alternating": {"strobe": False, "alternating": True},
    "quantum-composers": {"strobe": False, "counts_pulses": False, "start_s": (8e-3, 4e-3)},
    "dg645": {"strobe": False, "counts_pulses": False, "start_s": (5e-4, 2e-3)},
}
CAMERAS = {
    "clock": {"clock": True},
    "clock and counter": {"clock": True, "counter": True},
    "clock from zero": {"clock": True, "starts_anew": True},
    "numbers": {"clock": False},
    "nothing": {"clock": False, "numbers": False},
}
BY_SOFTWARE = {"strobe": False, "by_software": True}
#: Period in s, frames a burst, and whether pulses run on.
TIMINGS = [(period_s, frames, endless) for period_s in (0.02, 0.005) for frames in (1, 6) for endless in (False, True)]
#: The virtual camera is busy for this part of a period.
BUSY = 1 - (EXPOSURE_S + READOUT_S) / PERIOD_S
#: Bursts of a session: pulses that run on begin anew in the next.
SESSION = 4


#: The columns of the table, which `Toll` says more of.
COUNTS = ("kept", "faulty", "named", "wrong", "lost", "errors")


@dataclass
class Toll:
    """What became of the bursts of one kind of rig."""

    kept: int = 0
    faulty: int = 0  # runs of pulses with a fault
    named: int = 0  # mispaired, as docs/rig.md says
    wrong: int = 0  # mispaired in another way
    lost: int = 0  # runs without a fault that were thrown away
    errors: int = 0  # tracebacks
    notes: Counter[str] = field(default_factory=Counter)


def rigs() -> list[tuple[str, Instruments, float, int, bool]]:
    """Return every kind of rig: its name, what is in it, its period, frames a burst, whether pulses run on."""
    kinds = [
        (f"{trigger}; {camera}", Instruments(**TRIGGERS[trigger], **CAMERAS[camera]), timing)
        for trigger, camera, timing in product(TRIGGERS, CAMERAS, TIMINGS)
    ]
    kinds += [
        (f"software; {camera}", Instruments(**BY_SOFTWARE, **CAMERAS[camera]), (0.1, frames, endless))
        for camera, frames, endless in product(("clock", "numbers", "nothing"), (1, 6), (False, True))
    ]
    return [
        (name, has, period_s, frames, endless)
        for name, has, (period_s, frames, endless) in kinds
        if not (has.alternating and frames == 1)
    ]


def is_named(has: Instruments, frames: int, endless: bool, fate: Faults) -> bool:
    """Whether what went wrong is among what docs/rig.md says cannot be seen."""
    # A trigger that comes late in a period keeps the camera from the next one.
    keeps_busy = any(periods > BUSY for _, periods in fate.noise)
    is_lost = bool(fate.lost_trigger or fate.lost_frame or fate.cable_out is not None or keeps_busy)
    is_late = bool(fate.slow_line or fate.late_s)
    if not has.strobe and not has.clock:
        if is_lost and (fate.noise or fate.stale_frame):
            return True
        if endless and fate.noise and (is_late or any(periods > 0.4 for _, periods in fate.noise)):
            return True
    if endless:
        return False
    if frames == 1:
        return ((is_lost or is_late) and fate.stale_frame) or (is_lost and bool(fate.noise) and not has.strobe)
    return not has.strobe and is_lost and any(periods > 0.9 for _, periods in fate.noise)


def suffer(has: Instruments, period_s: float, frames: int, endless: bool, n_bursts: int, seed: int, toll: Toll) -> None:
    """Take a number of bursts, most of them with faults."""
    random = np.random.default_rng(seed)
    fates: list[Faults] = []
    n_failed = 0

    def next_faults() -> Faults:
        # The third try is left alone: that three in a row fail is no matter of pairing.
        # Pulses that run on have a first one only once: it gets every third fault.
        n_pulses = frames * SESSION if endless and random.random() < 0.7 else frames
        fate = random_faults(random, n_pulses) if n_failed < 2 else Faults()
        # No cable is there that could pick up noise.
        fates.append(replace(fate, noise=()) if has.by_software else fate)
        toll.faulty += not harmless(has, fates[-1])
        return fates[-1]

    def notify(rejected: Rejected) -> None:
        nonlocal n_failed
        n_failed += 1
        if all(harmless(has, fate) for fate in fates):
            toll.lost += 1
            toll.notes[f"thrown away: {rejected.faults[0]} {fates}"] += 1
        fates.clear()

    virtual = VirtualRig(next_faults, instruments=has, period_s=period_s, frames=frames, trigger_ppm=200, seed=seed)
    rig_module.time = virtual
    with Rig(virtual.settings, virtual.open, notify) as rig:
        while toll.kept < n_bursts:
            try:
                for burst in islice(rig.bursts(endless=endless), SESSION):
                    n_failed = 0
                    toll.kept += 1
                    if virtual.mispaired(burst):
                        named = is_named(has, frames, endless, fates[-1])
                        toll.named += named
                        toll.wrong += not named
                        if not named:
                            toll.notes[f"mispaired: {fates}"] += 1
                    if not endless:
                        fates.clear()
            except (BurstError, TriggerError, CameraError):
                n_failed = 0
            except Exception:
                toll.kept += 1
                toll.errors += 1
                toll.notes[traceback.format_exc(limit=-2)] += 1
                n_failed = 0
            fates.clear()


def harmless(has: Instruments, fate: Faults) -> bool:
    """Whether a run is whole all the same, as far as this rig can see."""
    has_clock = has.clock and not has.starts_anew
    if fate.late_s and not has_clock and not (has.strobe and has.numbers):
        return False  # docs/rig.md: in doubt, and thrown away
    seen = replace(fate, lost_strobe=(), strobe_out=False) if not has.strobe else fate
    seen = replace(seen, lost_picture=()) if not (has.vsync or has.alternating) else seen
    return seen.harmless and (has.numbers or not seen.repeated_frame)


def main(n_bursts: int, seed: int) -> None:
    """Print the table."""
    kinds = rigs()
    sums = np.zeros(len(COUNTS), int)
    print(f"{'rig':34} {'period_s':>8} {'frames':>8} " + " ".join(f"{name:>8}" for name in COUNTS))
    for index, (name, has, period_s, frames, endless) in enumerate(kinds):
        toll = Toll()
        suffer(has, period_s, frames, endless, -(-n_bursts // len(kinds)), seed + index, toll)
        counts = [getattr(toll, count) for count in COUNTS]
        sums += counts
        pulses = f"{frames}, on" if endless else str(frames)
        print(f"{name:34} {period_s:8g} {pulses:>8} " + " ".join(f"{count:8}" for count in counts))
        for note, times in toll.notes.items():
            print(f"    {times} x {note}")
    print(f"{'in all':52} " + " ".join(f"{count:8}" for count in sums))


if __name__ == "__main__":
    main(*(int(argument) for argument in (*sys.argv[1:], *("5000", "0")[len(sys.argv) - 1 :])))
