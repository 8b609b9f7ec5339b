"""Arm, fire, pair every frame with its pulse: a burst is kept whole, or thrown away and repeated."""

import logging
import time
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hardware.alternating_pictures import Alternation
from hardware.drivers import SOFTWARE
from hardware.errors import BurstError, CameraError, TriggerError
from hardware.pairing import Evidence, Fault, find_faults
from hardware.protocols import Camera, CameraFrame, Levels, Strobe, Trigger, TriggerStatus
from hardware.pulse_run import CLOCK, Run, is_left_over, repeats
from hardware.pulses import PulseTrain
from hardware.run_start import Lateness, Start, start_of
from hardware.settings import RigSettings
from hardware.timing import check_timing, train_of

_log = logging.getLogger("colorphase.rig")

#: How often a burst is tried before it is given up.
TRIES = 3
# How long a frame may take to us after its readout: USB and Ethernet repeat lost packets for a while.
_TRANSPORT_S = 0.5
# How often the trigger source is queried while pulses run; the box stops by itself after seconds without a query.
_POLL_S = 0.25
# How often it is queried for the end of a burst.
_SHORT_POLL_S = 0.01
# While pulses run on, their counts are read up to so often until those of all that is wired back agree, at a different
# place of the period each time: a picture is shown some time after its pulse.
_POLLS = 16
_POLL_PERIODS = 0.382
# Behind the camera by more than this, this machine is blamed for lost frames, and not a cable.
_BEHIND_S = 0.1
# How long an instrument may stay away: a board starts for three seconds, a cable is put back in somewhat more.
_REOPEN_S = 5.0
# Frames from which on two clocks are compared.
_LEAST_FOR_CLOCK = 5
# Frames by which the rig learns which of two pictures the projector shows, and how frames follow their pulses.
_SYNC_FRAMES = 4
# Where only arrival shows how long a frame takes to us, two bursts must agree to within this, in periods.
_AGREEMENT = 0.25
# Frames that are waited for, where those before them came late and may catch up.
_AHEAD = 4
# How often such a burst, or an uncertain start, is repeated.
_REPEATS = 5
# Start commands by which the time that they take at least is known; and that are remembered.
_LEAST_STARTS = 4
_STARTS = 100
# Pulses that run on are checked this many at a time at least: no other frame shows what exposed a single one.
_LEAST_RUNNING_ON = 2


@dataclass(frozen=True)
class PairedFrame:
    """A frame and the pulse that made it.

    Examples
    --------
    >>> timing = dict(period_s=0.02, frames=4, camera_delay_s=0.001)
    >>> parts = dict(trigger=dict(driver="simulated"), camera=dict(driver="simulated", exposure_s=0.008))
    >>> settings = colorphase.RigSettings(timing=timing, **parts)
    >>> with colorphase.Rig(settings, lambda: colorphase.open_instruments(settings)) as rig:
    ...     burst = next(rig.bursts())
    >>> [f"{1000 * frame.pulse_s:.0f} ms" for frame in burst.frames]
    ['1 ms', '21 ms', '41 ms', '61 ms']
    """

    pulse: int  # from 0, in its burst
    image: Levels
    frame: CameraFrame  # as it arrived
    pulse_s: float  # when its camera pulse began, from the burst's start, by the trigger source's clock
    strobe_s: float | None  # when the camera reported its exposure, by that clock; None: it does not
    exposed_at_s: float  # the same by this machine's time.monotonic(), to some milliseconds; of the middle colour


@dataclass(frozen=True)
class Burst:
    """A run of pulses with a frame to every one of them.

    Examples
    --------
    >>> timing = dict(period_s=0.02, frames=4, camera_delay_s=0.001)
    >>> parts = dict(trigger=dict(driver="simulated"), camera=dict(driver="simulated", exposure_s=0.008))
    >>> settings = colorphase.RigSettings(timing=timing, **parts)
    >>> with colorphase.Rig(settings, lambda: colorphase.open_instruments(settings)) as rig:
    ...     burst = next(rig.bursts())
    >>> [frame.pulse for frame in burst.frames]
    [0, 1, 2, 3]
    """

    number: int  # from 0; pulses that run on without a gap are of one burst
    frames: tuple[PairedFrame, ...]
    status: TriggerStatus
    n_repeated: int  # frames that were delivered twice, and are here once
    camera_ppm: float | None  # by how much the camera's clock is faster than the trigger source's; None: not known


@dataclass(frozen=True)
class Rejected:
    """A run of pulses that was thrown away, and why."""

    number: int
    attempt: int  # from 1
    faults: tuple[Fault, ...]


class _Refused(Exception):
    """A run is not whole."""

    def __init__(self, found: Sequence[Fault]) -> None:
        super().__init__(str(found[0]))
        self.faults = tuple(found)


class _InDoubt(Exception):
    """Nothing is known to be wrong with a run, but it does not show which frame was its first: it is fired again."""


class Rig:
    """A trigger source, a camera and a projector that work together.

    Parameters
    ----------
    settings : RigSettings
        The wiring of the rig, and its times.
    open_instruments : callable
        Open trigger source and camera; called again after one was lost.
    notify : callable, optional
        Called with every run that is thrown away.

    Attributes
    ----------
    trigger, camera : Trigger, Camera
        The instruments.
    train : PulseTrain
        A burst as it is made, rounded to what the trigger source can do.

    Raises
    ------
    TriggerError, CameraError
        An instrument cannot be reached, or is another one.
    RigError
        The request is impossible.

    Examples
    --------
    >>> timing = dict(period_s=0.02, frames=4, camera_delay_s=0.001)
    >>> parts = dict(trigger=dict(driver="simulated"), camera=dict(driver="simulated", exposure_s=0.008))
    >>> settings = colorphase.RigSettings(timing=timing, **parts)
    >>> with colorphase.Rig(settings, lambda: colorphase.open_instruments(settings)) as rig:
    ...     burst = next(rig.bursts())
    >>> len(burst.frames)
    4
    """

    trigger: Trigger
    camera: Camera

    def __init__(
        self,
        settings: RigSettings,
        open_instruments: Callable[[], tuple[Trigger, Camera]],
        notify: Callable[[Rejected], None] = lambda rejected: None,
    ) -> None:
        self.settings = settings
        self._open_instruments = open_instruments
        self._notify = notify
        self._is_open = False
        self._lost: Exception | None = None  # why instruments were let go of
        self._has_clock = True  # the camera's frames have times
        self._alternation = Alternation() if settings.projector.alternating else None
        self._configured: tuple[PulseTrain, PulseTrain] | None = None  # as requested, and as it is
        self._open()
        try:
            check_timing(settings, self.trigger, self.camera)
            self._names = str(self.trigger.identity), str(self.camera.identity)
            self.train = self._configure(train_of(settings))
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> "Rig":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop, outputs low, camera stopped, and let go of both; idempotent, and never raises."""
        if self._is_open:
            self._is_open = False
            self._configured = None
            self.trigger.close()
            self.camera.close()
            _log.info("trigger source and camera are closed")

    def bursts(self, *, endless: bool = False) -> Generator[Burst]:
        """Fire burst after burst, and yield each that is whole; one that is not is thrown away and fired again.

        Parameters
        ----------
        endless : bool
            Let pulses run on between bursts, without a gap. What was thrown away is then lost, and pulses start afresh.

        Raises
        ------
        BurstError
            Three tries in a row were not whole; the message names the pulse and the likely cable.
        TriggerError, CameraError
            An instrument was lost, and could not be opened again, or refuses.
        """
        run: Run | None = None
        number = failures = 0
        try:
            while True:
                try:
                    if run is None:
                        run = self._fire(endless=endless)
                    burst = self._take(run, number)
                except _InDoubt:
                    run = None
                    self._stop()
                    continue
                except (_Refused, TriggerError, CameraError) as error:
                    run = None
                    self._doubts = 0
                    failures += 1
                    self._throw_away(number, failures, error)
                    number += endless
                    continue
                failures = self._doubts = 0
                yield burst
                if not endless:
                    run = None
                    number += 1
        finally:
            self._stop()

    @property
    def notes(self) -> tuple[str, ...]:
        """Faults that stay undetected with the present wiring, one sentence each."""
        notes = list(self.camera.unlocked)
        if not self.settings.trigger.strobe and not self._has_clock:
            notes.append(
                "the camera reports no times and its exposures are not counted: frames are paired by their number and "
                "by when they arrive; a trigger box with its exposure output wired back, and trigger.strobe = true, "
                "shows more"
            )
        return tuple(notes)

    def _open(self) -> None:
        self.trigger, self.camera = self._open_instruments()
        self._is_open = True
        self._doubts = 0  # runs in a row that were fired again
        self._clock_restarts = False  # the camera's, whenever it is armed
        self._starts_s: list[float] = []  # how long the last start commands took
        self._strobe_delay_s: float | None = None  # from a pulse's period to its exposure; None: not known yet
        self._least_arrival_s: float | None = None  # from a pulse to its frame; None: not known yet
        self._last: CameraFrame | None = None  # that came

    def _reopen(self) -> None:
        deadline = time.monotonic() + _REOPEN_S
        _log.warning("an instrument is lost; both are opened again")
        while not self._is_open:
            try:
                self._open()
            except (TriggerError, CameraError):
                if time.monotonic() > deadline:
                    raise
                time.sleep(_POLL_S)
        names = str(self.trigger.identity), str(self.camera.identity)
        for error, before, now in zip((TriggerError, CameraError), self._names, names, strict=True):
            if before != now:
                raise error(f"{now} answers where {before} was: connect it again, or start anew")

    def _configure(self, asked: PulseTrain) -> PulseTrain:
        if self._configured is None or self._configured[0] != asked:
            self._configured = asked, self.trigger.configure(asked)
            _log.info("pulses are set: %s", self._configured[1])
        return self._configured[1]

    def _throw_away(self, number: int, attempt: int, error: Exception) -> None:
        """Say why, or give up."""
        if isinstance(error, _Refused):
            found = error.faults
        else:
            found = (Fault("instrument failed", str(error)),)
            if self._is_open:  # else it could not be opened again, and why it was let go of explains more
                self._lost = error
            self.close()  # it may be lost: the next try opens it again, and sets it up anew
        self._stop()
        _log.warning("burst %d is thrown away, try %d of %d: %s", number, attempt, TRIES, found[0])
        self._notify(Rejected(number, attempt, found))
        if attempt == TRIES:
            if isinstance(error, _Refused):
                raise BurstError(f"burst {number} was not whole in {TRIES} tries; {found[0]}") from None
            raise self._lost or error

    def _stop(self) -> None:
        if self._alternation is not None:
            self._alternation.forget()
        if self._is_open:
            try:
                self.trigger.abort()
                self.camera.disarm()
            except (TriggerError, CameraError):
                self.close()

    def _fire(self, *, endless: bool) -> Run:
        if not self._is_open:
            self._reopen()
        train = train_of(self.settings)
        # No other frame shows what exposed a single one: when exposures come after their pulses is learned first.
        is_lone = train.count == 1 and self.settings.trigger.strobe and self._strobe_delay_s is None
        if not endless and not is_lone and (self._alternation is None or self._alternation.known):
            return self._start(train)
        counted = self._counted(train)
        if not endless:
            return self._start(train)
        numbered = self.settings.trigger.strobe and counted.frame_ids is not None
        if (counted.device_s is None or self._clock_restarts) and not numbered:
            counted = self._agreeing(train, counted)
        return self._start(replace(train, count=None), counted)

    def _counted(self, train: PulseTrain) -> Start:
        """Fire some pulses, and return how their frames follow them."""
        sync = self._start(replace(train, count=_SYNC_FRAMES))
        frames = [paired.frame for paired in self._whole(sync, _SYNC_FRAMES).frames]
        if self._alternation is not None:
            found = self._alternation.start(frames)
            if found:
                raise _Refused(found)
        return start_of(frames, 0, sync.train.period_s, sync.fired_at_s)

    def _agreeing(self, train: PulseTrain, counted: Start) -> Start:
        """Fire some pulses again until their frames take as long as before, which busy machines make them do late."""
        for _ in range(_REPEATS):
            again = self._counted(train)
            agree = abs(again.arrival_s - counted.arrival_s) < _AGREEMENT * train.period_s
            counted = min(counted, again, key=lambda start: start.arrival_s)
            if agree:
                return counted
        reason = (
            "frames take now longer and now shorter to this machine, by a quarter of a period: make the period longer"
        )
        raise _Refused([Fault("uneven latency", reason)])

    def _start(self, asked: PulseTrain, counted: Start | None = None) -> Run:
        train = self._configure(asked)
        self.camera.arm(train.count)
        self.trigger.arm()
        armed = self.trigger.status()
        before_s = time.monotonic()
        self.trigger.fire()
        after_s = time.monotonic()
        self._starts_s = [*self._starts_s[-_STARTS:], after_s - before_s]
        return Run(train, armed, (before_s, after_s), counted)

    def _take(self, run: Run, number: int) -> Burst:
        """Return the next frames of a run once they are whole."""
        first, count = run.next_pulse, self.settings.timing.frames
        if run.train.count is None:
            count = max(count, _LEAST_RUNNING_ON)
        burst = self._whole(run, count, number)
        if self._alternation is not None:
            found = self._alternation.check([paired.frame for paired in burst.frames], first)
            if found:
                raise _Refused(found)
        return burst

    def _whole(self, run: Run, count: int, number: int = 0) -> Burst:
        train, first = run.train, run.next_pulse
        behind_s = time.monotonic() - run.fired_at_s[1] - first * train.period_s - self.camera.limits.min_period_s
        frames, n_repeated = self._collect(run, count)
        status = self._settled(run, first + count)
        if train.count is not None:
            n_repeated += self._surplus(run, frames)
        strobes = self._exposures(run, first + count, status) if self.settings.trigger.strobe else None
        seen = Evidence(
            train=train,
            by_software=self.settings.trigger.driver == SOFTWARE,
            first_pulse=first,
            count=count,
            exposure_s=self.camera.exposure_s,
            jitter_s=self.trigger.limits.jitter_s,
            fired_at_s=run.fired_at_s,
            quickest_s=min(self._starts_s) if len(self._starts_s) >= _LEAST_STARTS else 0.0,
            clock=CLOCK,
            counted=run.counted,
            frames=frames,
            ahead=run.ahead,
            previous=run.previous,
            least_arrival_s=self._least_arrival_s,
            armed=run.armed,
            ended=status,
            strobe_wired=self.settings.trigger.strobe,
            strobes=strobes,
            strobe_delay_s=self._strobe_delay_s,
            picture_a_pulse=self.settings.trigger.vsync == "per-pulse",
        )
        seen, found, n_again = self._wait_for_those_ahead(run, seen)
        n_repeated += n_again
        if run.previous is None and self._doubts < _REPEATS:
            self._check_start(seen.lateness, found, ended=train.count is not None)
        if found and behind_s > _BEHIND_S:
            slow = f"this machine is {behind_s:.1f} s behind the camera: record fewer frames a second, or to .zarr"
            found.insert(0, Fault("computer behind", slow, first))
        if found:
            raise _Refused(found)
        self._has_clock = all(frame.device_time_s is not None for frame in frames)
        started_s = sum(run.fired_at_s) / 2
        run.take(frames)
        if train.count is not None:
            self.camera.disarm()
            arrival_s = start_of(frames, 0, train.period_s, run.fired_at_s).arrival_s
            self._least_arrival_s = min(arrival_s, self._least_arrival_s or arrival_s)
        if strobes:
            self._strobe_delay_s = float(np.median([each.time_s - each.pulse * train.period_s for each in strobes]))
        by_pulse = {strobe.pulse: strobe.time_s for strobe in strobes or ()}
        paired = []
        for pulse, frame in enumerate(frames, first):
            if frame.image is None:  # which is a fault
                raise _Refused([Fault("frame not whole", "its frame is not whole", pulse)])
            pulse_s, strobe_s = pulse * train.period_s + train.camera.delay_s, by_pulse.get(pulse)
            exposed_s = pulse_s if strobe_s is None else strobe_s
            paired.append(PairedFrame(pulse, frame.image, frame, pulse_s, strobe_s, started_s + exposed_s))
        return Burst(number, tuple(paired), status, n_repeated, _camera_ppm(paired))

    def _check_start(self, late: Lateness, found: Sequence[Fault], *, ended: bool) -> None:
        """Have a run fired again whose start is uncertain."""
        learned = late.clock_restarted and not self._clock_restarts
        self._clock_restarts |= late.clock_restarted  # then it takes two bursts to know how late frames come
        # How late frames usually are may not be known yet.
        may_be_slow = ended and bool(found) and all(fault.may_pass for fault in found)
        if learned or late.in_doubt or may_be_slow:
            self._doubts += 1
            raise _InDoubt

    def _collect(self, run: Run, count: int) -> tuple[list[CameraFrame], int]:
        """Wait for `count` frames; fewer where they do not come in time. Second: how many came twice."""
        frames, run.ahead = run.ahead[:count], run.ahead[count:]
        n_repeated = 0
        pulses_s = (run.next_pulse + count * (1 + CLOCK)) * run.train.period_s
        due_s = run.fired_at_s[1] + pulses_s + self.camera.exposure_s + self.camera.limits.min_period_s
        deadline = due_s + _TRANSPORT_S
        poll_s = min(time.monotonic() + _POLL_S, due_s)
        while len(frames) < count and (now_s := time.monotonic()) < deadline:
            if now_s >= poll_s:
                poll_s = now_s + _POLL_S
                status = self.trigger.status()
                if status.boot != run.armed.boot or status.complaints:
                    break
                # Where exposures are counted, none that was not made is waited for.
                if self.settings.trigger.strobe and not status.running and status.strobes == len(frames):
                    break
            frame = self.camera.frame(min(deadline, poll_s) - now_s)
            if frame is not None and self._is_new(frame, frames[-1] if frames else run.previous):
                frames.append(frame)
            elif frame is not None:
                n_repeated += 1
        return frames, n_repeated

    def _wait_for_those_ahead(self, run: Run, seen: Evidence) -> tuple[Evidence, list[Fault], int]:
        """Wait for the next frames as long as they may show that those before were late, and none is missing.

        Return what is known then, what speaks against it, and how many frames came twice.
        """
        found = at_first = find_faults(seen)
        n_repeated = 0
        give_up_s = time.monotonic() + _TRANSPORT_S + _AHEAD * run.train.period_s
        while run.train.count is None and found and all(fault.may_pass for fault in found):
            if time.monotonic() > give_up_s:
                break
            before = run.ahead[-1] if run.ahead else seen.frames[-1]
            frame = self.camera.frame(_SHORT_POLL_S)
            if frame is None:
                continue
            if not self._is_new(frame, before):
                n_repeated += 1
                continue
            run.ahead.append(frame)
            if not seen.is_next(frame, before):  # then those after it show nothing
                break
            seen = replace(seen, ahead=run.ahead)
            found = find_faults(seen)
        if not found and at_first and self.settings.trigger.strobe and not self._one_exposure_each(run, seen):
            found = at_first
        return seen, found, n_repeated

    def _one_exposure_each(self, run: Run, seen: Evidence) -> bool:
        """Return whether the pulses whose frames were waited for made an exposure each, and no other was made."""
        self._ask_for_exposures(run)
        first = seen.first_pulse + seen.count
        last = first + len(seen.ahead)
        return [strobe.pulse for strobe in run.strobes if strobe.pulse < last] == list(range(first, last))

    def _surplus(self, run: Run, frames: list[CameraFrame]) -> int:
        """Add a frame that comes after the last one, if any does; return how many came twice."""
        n_repeated = 0
        while (frame := self.camera.frame(self.camera.limits.min_period_s + _SHORT_POLL_S)) is not None:
            if self._is_new(frame, frames[-1] if frames else run.previous):
                frames.append(frame)
                break
            n_repeated += 1
        return n_repeated

    def _is_new(self, frame: CameraFrame, before: CameraFrame | None) -> bool:
        """Return whether a frame was not delivered before: in this run, or in the one before this."""
        last, self._last = self._last, frame
        return not repeats(frame, before) and not (before is None and is_left_over(frame, last))

    def _exposures(self, run: Run, last: int, status: TriggerStatus) -> list[Strobe] | None:
        """Return the exposures of the pulses up to the last one; None: the trigger source has forgotten some."""
        self._ask_for_exposures(run)
        taken = [strobe for strobe in run.strobes if strobe.pulse < last]
        run.strobes = [strobe for strobe in run.strobes if strobe.pulse >= last]
        if run.n_strobes < (status.strobes or 0):
            run.n_strobes = status.strobes or 0
            return None
        return taken

    def _ask_for_exposures(self, run: Run) -> None:
        strobes = self.trigger.strobes()
        run.n_strobes += len(strobes)
        run.strobes += strobes

    def _settled(self, run: Run, last: int) -> TriggerStatus:
        """Return the trigger source's status once a burst has ended."""
        deadline = run.fired_at_s[1] + last * run.train.period_s * (1 + CLOCK) + _TRANSPORT_S
        polls = 0
        while True:
            status = self.trigger.status()
            if status.boot != run.armed.boot or status.complaints:
                return status
            if run.train.count is None:
                polls += 1
                if polls == _POLLS or not self._may_be_reported(status):
                    return status
                time.sleep(_POLL_PERIODS * run.train.period_s)
                continue
            if not status.running:
                return status
            if time.monotonic() > deadline:
                raise TriggerError("the trigger source does not end its burst: switch it off and on, and start anew")
            time.sleep(_SHORT_POLL_S)

    def _may_be_reported(self, status: TriggerStatus) -> bool:
        """Return whether the last pulse's exposure or picture is missing, as both are for some time in every period."""
        wired = self.settings.trigger
        counts = [status.strobes] * wired.strobe + [status.vsyncs] * (wired.vsync == "per-pulse")
        off = [abs(status.pulses - count) for count in counts if count is not None and status.pulses is not None]
        return max(off, default=0) == 1


def _camera_ppm(paired: Sequence[PairedFrame]) -> float | None:
    """Return how much faster the camera's clock is, by a straight line through its times over the exposures'."""
    camera_s = [each.frame.device_time_s for each in paired]
    if len(paired) < _LEAST_FOR_CLOCK or None in camera_s:
        return None
    trigger_s = [each.pulse_s if each.strobe_s is None else each.strobe_s for each in paired]
    slope = np.polyfit(trigger_s, np.array(camera_s, np.float64) - (camera_s[0] or 0.0), 1)[0]
    return float(1e6 * (slope - 1))
