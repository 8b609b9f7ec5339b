"""Arm, fire, pair every frame with its pulse: a burst is kept whole, or thrown away and repeated."""

import time
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hardware.alternating_pictures import Alternation
from hardware.colour_cycle import check_exposure
from hardware.drivers import SOFTWARE
from hardware.errors import BurstError, CameraError, RigError, TriggerError
from hardware.pairing import Evidence, Fault, find_faults, latencies_s
from hardware.protocols import Camera, CameraFrame, Levels, Strobe, Trigger, TriggerStatus
from hardware.pulses import Pulse, PulseTrain
from hardware.settings import RigSettings

#: How often a burst is tried before it is given up.
TRIES = 3
# How long a frame may take to us after its readout: USB and Ethernet repeat lost packets for a while.
_TRANSPORT_S = 0.5
# How far the trigger source's clock may be off the computer's: a resonator, as on an Arduino Uno, by half of it.
_CLOCK = 1e-2
# How often the trigger source is asked while pulses run; the box stops by itself after seconds without a question.
_POLL_S = 0.25
# How often it is asked for the end of a burst.
_SHORT_POLL_S = 0.01
# Behind the camera by more than this, this machine is blamed for lost frames, and not a cable.
_BEHIND_S = 0.1
# How long an instrument may stay away: a board starts for three seconds, a cable is put back in somewhat more.
_REOPEN_S = 5.0
# Frames from which on two clocks are compared.
_LEAST_FOR_CLOCK = 5
# Frames by which the rig learns which of two pictures the projector shows, and how long a frame takes to us.
_SYNC_FRAMES = 4


@dataclass(frozen=True)
class PairedFrame:
    """A frame and the pulse that made it."""

    pulse: int  # from 0, in its burst
    image: Levels
    frame: CameraFrame  # as it arrived
    pulse_s: float  # when its camera pulse began, from the burst's start, by the trigger source's clock
    strobe_s: float | None  # when the camera said that it was exposing, by that clock; None: it does not tell
    exposed_at_s: float  # the same by this machine's time.monotonic(), to some milliseconds; of the middle colour


@dataclass(frozen=True)
class Burst:
    """A run of pulses with a frame to every one of them."""

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


@dataclass
class _Run:
    """Pulses that were fired, and how far their frames were taken."""

    train: PulseTrain
    armed: TriggerStatus  # before the first
    fired_at_s: tuple[float, float]  # time.monotonic() before and after the command, as far as clocks keep pace
    latencies_s: Sequence[float] | None  # of the burst before; None: it does not matter
    next_pulse: int = 0
    strobes: list[Strobe] = field(default_factory=list)  # that were told, of pulses that are to be taken
    n_strobes: int = 0  # that were told in all
    previous: CameraFrame | None = None  # the frame of the pulse before

    def take(self, frames: Sequence[CameraFrame]) -> None:
        """Go on behind frames that were whole, by a start that keeps pace with this machine's clock."""
        if self.latencies_s is not None:
            most_s = _CLOCK * len(frames) * self.train.period_s
            latency_s, *_ = latencies_s(frames, self.next_pulse, self.train.period_s, self.fired_at_s[0])
            drift_s = min(max(latency_s - self.latencies_s[0], -most_s), most_s)
            self.fired_at_s = self.fired_at_s[0] + drift_s, self.fired_at_s[1] + drift_s
        self.next_pulse += len(frames)
        self.previous = frames[-1]


class Rig:
    """A trigger source, a camera and a projector that work together.

    Parameters
    ----------
    settings : RigSettings
        What is wired to what, and when it is fired.
    open_instruments : callable
        Open trigger source and camera; called again after one was lost.
    tell : callable, optional
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
        What is asked for is impossible.
    """

    trigger: Trigger
    camera: Camera

    def __init__(
        self,
        settings: RigSettings,
        open_instruments: Callable[[], tuple[Trigger, Camera]],
        tell: Callable[[Rejected], None] = lambda rejected: None,
    ) -> None:
        self.settings = settings
        self._open_instruments = open_instruments
        self._tell = tell
        self._is_open = False
        self._lost: Exception | None = None  # why instruments were let go of
        self._has_clock = True  # the camera's frames have times
        self._alternation = Alternation() if settings.projector.alternating else None
        self._configured: tuple[PulseTrain, PulseTrain] | None = None  # as asked for, and as it is
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
        run: _Run | None = None
        number = failures = 0
        try:
            while True:
                try:
                    if run is None:
                        run = self._fire(endless=endless)
                    burst = self._take(run, number)
                except (_Refused, TriggerError, CameraError) as error:
                    run = None
                    failures += 1
                    self._throw_away(number, failures, error)
                    number += endless
                    continue
                failures = 0
                yield burst
                if not endless:
                    run = None
                    number += 1
        finally:
            self._stop()

    @property
    def notes(self) -> tuple[str, ...]:
        """What cannot be seen or held with what is wired, a sentence each."""
        notes = list(self.camera.unlocked)
        if not self.settings.trigger.strobe and not self._has_clock:
            notes.append(
                "the camera tells no times and its exposures are not counted: frames are paired by their number and by "
                "when they arrive; a trigger box with its exposure output wired back, and trigger.strobe = true, tells "
                "more"
            )
        return tuple(notes)

    def _open(self) -> None:
        self.trigger, self.camera = self._open_instruments()
        self._is_open = True

    def _reopen(self) -> None:
        deadline = time.monotonic() + _REOPEN_S
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
        return self._configured[1]

    def _throw_away(self, number: int, attempt: int, error: Exception) -> None:
        """Say why, or give up."""
        if isinstance(error, _Refused):
            found = error.faults
        else:
            found = (Fault(str(error)),)
            if self._is_open:  # else it could not be opened again, and why it was let go of says more
                self._lost = error
            self.close()  # it may be lost: the next try opens it again, and sets it up anew
        self._stop()
        self._tell(Rejected(number, attempt, found))
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

    def _fire(self, *, endless: bool) -> _Run:
        if not self._is_open:
            self._reopen()
        train = train_of(self.settings)
        if not endless and (self._alternation is None or self._alternation.known):
            return self._start(train)
        sync = self._start(replace(train, count=_SYNC_FRAMES))
        frames = [paired.frame for paired in self._whole(sync, _SYNC_FRAMES).frames]
        if self._alternation is not None:
            found = self._alternation.start(frames)
            if found:
                raise _Refused(found)
        if not endless:
            return self._start(train)
        latencies = latencies_s(frames, 0, sync.train.period_s, sync.fired_at_s[0])
        return self._start(replace(train, count=None), latencies)

    def _start(self, asked: PulseTrain, latencies: Sequence[float] | None = None) -> _Run:
        train = self._configure(asked)
        self.camera.arm(train.count)
        self.trigger.arm()
        armed = self.trigger.status()
        before_s = time.monotonic()
        self.trigger.fire()
        return _Run(train, armed, (before_s, time.monotonic()), latencies)

    def _take(self, run: _Run, number: int) -> Burst:
        """Return the next frames of a run once they are whole."""
        first = run.next_pulse
        burst = self._whole(run, self.settings.timing.frames, number)
        if self._alternation is not None:
            found = self._alternation.check([paired.frame for paired in burst.frames], first)
            if found:
                raise _Refused(found)
        return burst

    def _whole(self, run: _Run, count: int, number: int = 0) -> Burst:
        train, first = run.train, run.next_pulse
        behind_s = time.monotonic() - run.fired_at_s[1] - first * train.period_s - self.camera.limits.min_period_s
        frames, n_repeated = self._collect(run, count)
        status = self._settled(run, first + count)
        if train.count is not None:
            n_repeated += self._surplus(run, frames)
        strobes = self._exposures(run, first + count, status) if self.settings.trigger.strobe else None
        found = find_faults(
            Evidence(
                train=train,
                by_software=self.settings.trigger.driver == SOFTWARE,
                first_pulse=first,
                count=count,
                exposure_s=self.camera.exposure_s,
                jitter_s=self.trigger.limits.jitter_s,
                fired_at_s=run.fired_at_s[0],
                clock=_CLOCK,
                latencies_s=run.latencies_s,
                frames=frames,
                previous=run.previous,
                armed=run.armed,
                ended=status,
                strobe_wired=self.settings.trigger.strobe,
                strobes=strobes,
                picture_a_pulse=self.settings.trigger.vsync == "per-pulse",
            )
        )
        if found and behind_s > _BEHIND_S:
            slow = f"this machine is {behind_s:.1f} s behind the camera: record fewer frames a second, or to .zarr"
            found.insert(0, Fault(slow, first))
        if found:
            raise _Refused(found)
        self._has_clock = all(frame.device_time_s is not None for frame in frames)
        started_s = sum(run.fired_at_s) / 2
        run.take(frames)
        if train.count is not None:
            self.camera.disarm()
        by_pulse = {strobe.pulse: strobe.time_s for strobe in strobes or ()}
        fields, paired = self.settings.projector.fields, []
        for pulse, frame in enumerate(frames, first):
            if frame.image is None:  # which is a fault
                raise _Refused([Fault("its frame is not whole", pulse)])
            pulse_s, strobe_s = pulse * train.period_s + train.camera.delay_s, by_pulse.get(pulse)
            exposed_s = pulse_s if strobe_s is None else strobe_s
            exposed_s = exposed_s if fields is None else pulse_s + fields.middle_s
            paired.append(PairedFrame(pulse, frame.image, frame, pulse_s, strobe_s, started_s + exposed_s))
        return Burst(number, tuple(paired), status, n_repeated, _camera_ppm(paired))

    def _collect(self, run: _Run, count: int) -> tuple[list[CameraFrame], int]:
        """Wait for `count` frames; fewer where they do not come in time. Second: how many came twice."""
        frames: list[CameraFrame] = []
        n_repeated = 0
        pulses_s = (run.next_pulse + count * (1 + _CLOCK)) * run.train.period_s
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
            if frame is not None and _repeats(frame, frames[-1] if frames else run.previous):
                n_repeated += 1
            elif frame is not None:
                frames.append(frame)
        return frames, n_repeated

    def _surplus(self, run: _Run, frames: list[CameraFrame]) -> int:
        """Add a frame that comes after the last one, if any does; return how many came twice."""
        n_repeated = 0
        while (frame := self.camera.frame(self.camera.limits.min_period_s + _SHORT_POLL_S)) is not None:
            if not _repeats(frame, frames[-1] if frames else run.previous):
                frames.append(frame)
                break
            n_repeated += 1
        return n_repeated

    def _exposures(self, run: _Run, last: int, status: TriggerStatus) -> list[Strobe] | None:
        """Return the exposures of the pulses up to the last one; None: the trigger source has forgotten some."""
        told = self.trigger.strobes()
        run.n_strobes += len(told)
        run.strobes += told
        taken = [strobe for strobe in run.strobes if strobe.pulse < last]
        run.strobes = [strobe for strobe in run.strobes if strobe.pulse >= last]
        if run.n_strobes < (status.strobes or 0):
            run.n_strobes = status.strobes or 0
            return None
        return taken

    def _settled(self, run: _Run, last: int) -> TriggerStatus:
        """Return the trigger source's status once a burst has ended."""
        deadline = run.fired_at_s[1] + last * run.train.period_s * (1 + _CLOCK) + _TRANSPORT_S
        while True:
            status = self.trigger.status()
            if run.train.count is None or not status.running:
                return status
            if status.boot != run.armed.boot or status.complaints:
                return status
            if time.monotonic() > deadline:
                raise TriggerError("the trigger source does not end its burst: switch it off and on, and start anew")
            time.sleep(_SHORT_POLL_S)


def _repeats(frame: CameraFrame, before: CameraFrame | None) -> bool:
    """Whether a frame was delivered twice: its number, and so its exposure, is that of the one before."""
    return before is not None and frame.frame_id is not None and frame.frame_id == before.frame_id


def _camera_ppm(paired: Sequence[PairedFrame]) -> float | None:
    """Return how much faster the camera's clock is, by a straight line through its times over the exposures'."""
    camera_s = [each.frame.device_time_s for each in paired]
    if len(paired) < _LEAST_FOR_CLOCK or None in camera_s:
        return None
    trigger_s = [each.pulse_s if each.strobe_s is None else each.strobe_s for each in paired]
    slope = np.polyfit(trigger_s, np.array(camera_s, np.float64) - (camera_s[0] or 0.0), 1)[0]
    return float(1e6 * (slope - 1))


def train_of(settings: RigSettings) -> PulseTrain:
    """Return the burst that a rig's file asks for."""
    timing = settings.timing
    return PulseTrain(
        period_s=timing.period_s,
        count=timing.frames,
        projector=Pulse(timing.projector_delay_s, timing.projector_width_s),
        camera=Pulse(timing.camera_delay_s, timing.camera_width_s),
    )


def check_timing(settings: RigSettings, trigger: Trigger, camera: Camera) -> None:
    """Refuse what can never make whole bursts.

    Raises
    ------
    RigError
        The message names what contradicts what, and a value that would do.
    """
    timing, projector = settings.timing, settings.projector
    if projector.colour_cycle_s is not None:
        check_exposure(camera.exposure_s, projector.colour_cycle_s)
    if timing.period_s < camera.limits.min_period_s:
        raise RigError(
            f"timing.period_s is {timing.period_s:g}, but a frame takes the camera {camera.limits.min_period_s:.6g} s, "
            "exposure and readout: make the period that long, or the exposure shorter"
        )
    if (settings.trigger.driver == SOFTWARE) != (settings.camera.trigger == "software"):
        raise RigError('trigger.driver and camera.trigger must both be "software", or neither')
    if settings.trigger.strobe and not trigger.limits.counts_strobes:
        raise RigError(f"{trigger.identity} counts no exposures: leave trigger.strobe away")
    if settings.trigger.vsync and not trigger.limits.counts_vsyncs:
        raise RigError(f"{trigger.identity} counts no pictures: leave trigger.vsync away")
    if projector.alternating and timing.frames < 2:
        raise RigError("alternating pictures are told apart by two frames or more: make timing.frames 2 or more")
    if projector.alternating and timing.camera_delay_s < timing.projector_delay_s:
        raise RigError("the camera would expose before the projector's pulse: make timing.camera_delay_s longer")
