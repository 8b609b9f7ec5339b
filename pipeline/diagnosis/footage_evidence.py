"""What some twenty frames of footage show, looked at one after another, in pairs of neighbours and as a sequence."""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from pipeline.decoder import Decoder
from pipeline.diagnosis.expected_light import KnownLight
from pipeline.diagnosis.frame_evidence import (
    FrameQuality,
    InspectedFrame,
    KeptFrame,
    SitingFit,
    as_light,
    decoder_settings,
    fit_siting,
    inspect_frame,
    measure_motion,
    measure_quality,
)
from pipeline.diagnosis.frame_sequence import MIN_FRAMES, SequenceDiagnosis, diagnose_sequence
from pipeline.diagnosis.ripple import Diagnosis, diagnose
from pipeline.errors import DecodeWarning, FootageError
from pipeline.footage.source import BadFrame, Source, StoredAs, StoredFrame
from pipeline.models import FloatArray
from pipeline.settings import DecodeSettings
from tikernels.phase.frame_statistics import measure_frame
from tikernels.raw.development import develop
from tikernels.raw.pixel_format import FLOAT_BITS
from tikernels.transposing import transpose

# Pairs of neighbours that are looked at, evenly spaced.
_PAIRS = 4
# Frames of the run in the middle: as many as a sequence needs to tell a beat.
_RUN = MIN_FRAMES


@dataclass
class FootageEvidence:
    """What the frames that were looked at show."""

    settings: DecodeSettings  # as given, with the container's transfer, and the stripes' true direction
    n_frames: int = 0
    bad: list[BadFrame] = field(default_factory=list)
    no_fringes: list[int] = field(default_factory=list)
    kept: list[KeptFrame] = field(default_factory=list)  # the first with fringes of every run
    qualities: list[FrameQuality] = field(default_factory=list)
    motion_rad: list[float] = field(default_factory=list)  # of pairs of neighbours, 95th percentile
    repeats: list[int] = field(default_factory=list)  # frames that are as the one before, value by value
    n_pairs: int = 0
    brightest: float = 0.0  # value, of full scale
    diagnosis: Diagnosis | None = None
    siting: SitingFit | None = None
    sequence: SequenceDiagnosis | None = None


def gather_evidence(
    source: Source, says: StoredAs, settings: DecodeSettings, arch: str, tell: Callable[[str], None]
) -> FootageEvidence:
    """Look at frames all over some footage: pairs of neighbours, and a longer run in its middle.

    Parameters
    ----------
    source : Source
        The footage.
    says : StoredAs
        What the user says of how pixels are stored.
    settings : DecodeSettings
        How it is meant to be decoded.
    arch : str
        Where to compute.
    tell : callable
        Is told what is being done.
    """
    if settings.transfer is None:
        settings = settings.model_copy(update={"transfer": source.transfer or "linear"})
    gatherer = _Gatherer(source, says, settings, arch, tell)
    runs = _runs(len(source))
    middle, total = max(runs, key=len), sum(map(len, runs))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DecodeWarning)
        for run in runs:
            gatherer.look_at_run(run, total, ask=run.start >= middle.start, follow=run == middle and len(run) == _RUN)
        gatherer.finish()
    return gatherer.seen


class _Gatherer:
    """Looks at one frame after another, and keeps what they show."""

    def __init__(
        self, source: Source, says: StoredAs, settings: DecodeSettings, arch: str, tell: Callable[[str], None]
    ) -> None:
        self.seen = FootageEvidence(settings)
        self._source, self._says, self._arch, self._tell = source, says, arch, tell
        self._decoder: Decoder | None = None
        self._sequence: list[KeptFrame] = []  # the frames of the run in the middle

    def look_at_run(self, run: range, total: int, *, ask: bool, follow: bool) -> None:
        """Look at neighbouring frames.

        Parameters
        ----------
        run : range
            Their numbers.
        total : int
            How many frames are looked at all in all.
        ask : bool
            Whether to diagnose the first one with fringes, if none has been.
        follow : bool
            Whether to keep them all as a sequence.
        """
        before: tuple[StoredFrame, InspectedFrame] | None = None
        first = True
        for stored in self._source.frames(run.start, run.stop):
            self.seen.n_frames += 1
            self._tell(f"frame {stored.number} ({self.seen.n_frames} of {total})")
            inspected = self._inspect(stored)
            if isinstance(stored, BadFrame) or inspected is None:
                before = None
                continue
            if before is not None:
                self._compare(before, (stored, inspected))
            before = (stored, inspected)
            if inspected.frame is None:
                self.seen.no_fringes.append(stored.number)
                continue
            self.seen.qualities.append(measure_quality(inspected, inspected.frame, bits_of(self._source)))
            if first or follow:
                kept = KeptFrame.of(inspected, inspected.frame)
                if first:
                    self.seen.kept.append(kept)
                    if ask and self.seen.diagnosis is None:
                        self._diagnose(stored, kept)
                if follow:
                    self._sequence.append(kept)
            first = False

    def finish(self) -> None:
        """Diagnose the sequence, if every frame of it shows fringes."""
        if len(self._sequence) < _RUN:
            return
        self._tell("motion and beat")
        self.seen.sequence = diagnose_sequence(
            [kept.light for kept in self._sequence],
            1.0,
            [kept.unwrapped_phase for kept in self._sequence],
            [kept.mask for kept in self._sequence],
            crosstalk_matrix=_known_crosstalk(self._decoder),
        )

    def _inspect(self, stored: StoredFrame | BadFrame) -> InspectedFrame | None:
        """Decode a frame; None if it is bad."""
        if isinstance(stored, BadFrame):
            self.seen.bad.append(stored)
            return None
        try:
            if self._decoder is None:
                self.seen.settings = _turned(stored, self.seen.settings)
                self._decoder = Decoder(decoder_settings(self.seen.settings), arch=self._arch)
            inspected = inspect_frame(stored, self._decoder, self.seen.settings)
        except FootageError as error:
            self.seen.bad.append(BadFrame(stored.number, str(error)))
            return None
        self.seen.brightest = max(self.seen.brightest, float(inspected.encoded.max()))
        return inspected

    def _compare(self, before: tuple[StoredFrame, InspectedFrame], now: tuple[StoredFrame, InspectedFrame]) -> None:
        """Note whether a frame repeats the one before, or else how its phase has changed."""
        self.seen.n_pairs += 1
        if all(np.array_equal(a, b) for a, b in zip(before[0].planes, now[0].planes, strict=True)):
            self.seen.repeats.append(now[0].number)
        elif (change := measure_motion(before[1], now[1])).size:
            self.seen.motion_rad.append(float(np.quantile(change, 0.95)))

    def _diagnose(self, stored: StoredFrame, kept: KeptFrame) -> None:
        """Diagnose one frame's ripple, and where its colours sit."""
        known, transfer = KnownLight(_known_crosstalk(self._decoder)), self.seen.settings.transfer or "linear"
        self.seen.diagnosis = diagnose(kept.encoded, 1.0, kept.unwrapped_phase, kept.mask, known, transfer)
        if self._source.format.subsampling[0] == 2 and self._says.siting is None:
            self._tell("where the colours sit")
            self.seen.siting = fit_siting(stored, self.seen.settings, self._arch)


def _runs(n_frames: int) -> list[range]:
    """Return which frames to look at: a run in the middle, and pairs before and after it."""
    starts = np.linspace(0, max(n_frames - 2, 0), _PAIRS + 1).round().astype(int).tolist()
    runs = [range(start, min(start + 2, n_frames)) for start in starts]
    begin = max(0, starts[len(starts) // 2] - _RUN // 2)
    middle = range(begin, min(begin + _RUN, n_frames))
    clear = [run for run in runs if run.stop <= middle.start or run.start >= middle.stop]
    return sorted({*clear, middle}, key=lambda run: run.start)


def bits_of(source: Source) -> int:
    """Return how many bits tell levels apart; floats are as fine as their mantissa."""
    return 24 if source.format.bits == FLOAT_BITS else source.format.bits


def _turned(stored: StoredFrame, settings: DecodeSettings) -> DecodeSettings:
    """Return the settings turned to this frame's stripes, if only the other direction shows a fringe."""
    light = as_light(develop(stored.planes, stored.format, stripes=settings.stripes), settings)[1]
    other = "vertical" if settings.stripes == "horizontal" else "horizontal"
    across = {"horizontal": light, "vertical": transpose(light)}
    if measure_frame(across[settings.stripes]).period_px is not None or measure_frame(across[other]).period_px is None:
        return settings
    return settings.model_copy(update={"stripes": other})


def _known_crosstalk(decoder: Decoder | None) -> FloatArray | None:
    """Return the crosstalk that decoding undoes, as far as anything tells it."""
    if decoder is None:
        return None
    known = decoder.settings.crosstalk_matrix
    if known is None and decoder.light is not None and decoder.light.reliable:
        return decoder.light.crosstalk_matrix
    return known
