"""A run of pulses that was fired, how far its frames were taken, and which of them came twice."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from hardware.pairing import is_same_image
from hardware.protocols import CameraFrame, Strobe, TriggerStatus
from hardware.pulses import PulseTrain
from hardware.run_start import Start, start_of

#: How far the trigger source's clock may be off the computer's: a resonator, as on an Arduino Uno, by half of it.
CLOCK = 1e-2


@dataclass
class Run:
    """Pulses that were fired, and how far their frames were taken."""

    train: PulseTrain
    armed: TriggerStatus  # before the first
    fired_at_s: tuple[float, float]  # time.monotonic() before and after the command, as far as clocks keep pace
    counted: Start | None  # the start of the burst before; None: it does not matter
    next_pulse: int = 0
    strobes: list[Strobe] = field(default_factory=list)  # that were reported, of pulses that are to be taken
    n_strobes: int = 0  # that were reported in all
    previous: CameraFrame | None = None  # the frame of the pulse before
    ahead: list[CameraFrame] = field(default_factory=list)  # frames that came while those before them were uncertain

    def take(self, frames: Sequence[CameraFrame]) -> None:
        """Continue after frames that were whole, by a start that keeps pace with this machine's clock."""
        if self.counted is not None:
            most_s = CLOCK * len(frames) * self.train.period_s
            arrival_s = start_of(frames, self.next_pulse, self.train.period_s, self.fired_at_s).arrival_s
            drift_s = min(max(arrival_s - self.counted.arrival_s, -most_s), most_s)
            self.fired_at_s = self.fired_at_s[0] + drift_s, self.fired_at_s[1] + drift_s
        self.next_pulse += len(frames)
        self.previous = frames[-1]


def repeats(frame: CameraFrame, before: CameraFrame | None) -> bool:
    """Return whether a frame was delivered twice: its number, its time and its image are those of the one before."""
    if before is None or frame.frame_id is None:
        return False
    if (frame.frame_id, frame.device_time_s) != (before.frame_id, before.device_time_s):
        return False
    return frame.image is None or before.image is None or is_same_image(frame.image, before.image)


def is_left_over(frame: CameraFrame, last: CameraFrame | None) -> bool:
    """Return whether a frame is from the run before; numbers may begin anew with every run, times do not recur."""
    if last is None or (frame.frame_id, frame.device_time_s) != (last.frame_id, last.device_time_s):
        return False
    return is_same_image(frame.image, last.image)
