"""The cost of footage in phase before it is decoded, and what to change; `docs/footage.md` explains each finding."""

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from pipeline.calibration import Calibration
from pipeline.diagnosis.channel_spectra import LEAST_RAD
from pipeline.diagnosis.footage_evidence import (
    MIN_CONTRAST,
    FootageEvidence,
    FrameQuality,
    Scale,
    bits_of,
    gather_evidence,
    measure_gains,
    measure_scale,
    stands_still,
)
from pipeline.diagnosis.ripple import BANDS
from pipeline.footage.footage import Footage, StoredAs
from pipeline.footage.image_folder import ImageFolder
from pipeline.footage.opening import open_footage
from pipeline.footage.video_file import VideoFile, films
from pipeline.planning.motion_cost import USUAL_SPEED_MM_S, motion_costs
from pipeline.settings import DecodeSettings
from tikernels import runtime
from tikernels.raw.pixel_format import FLOAT_BITS

_NUMBER = re.compile(r"\d+")
_LOSSY_SUFFIXES = (".jpg", ".jpeg", ".jpe")
# A step longer than this many usual ones hides a missing frame; shorter ones are those of an uneven clock.
_GAP = 1.5
Grade = Literal["fine", "costs", "spoils"]
#: From the best to the worst.
GRADES: tuple[Grade, ...] = ("fine", "costs", "spoils")

# A greater one, RMS rad, should not be put up with: a dark surface under a bad projector has less in good footage with
# subsampled colours.
_MOST_RAD = 0.06
# Share of what is lit that may have no significant fringe, as highlights.
_LITTLE_FAINT = 0.02
# Shares of the lit pixels whose phase is lost by clipping: up to the first it costs nothing, above the second it
# spoils.
_LITTLE_LOST, _MUCH_LOST = 0.005, 0.2
# Part by which all channels may have changed from the first frame on, and one compared with the others.
_MOST_GAIN, _MOST_TINT = 0.03, 0.015
# A surface that moves by more in a frame, rad, is on another cycle as far as the next frame shows.
_THIRD_OF_A_CYCLE = 2 * np.pi / 3
# The 95th percentile of a change by noise alone, in standard deviations of a phase: 1.96 sqrt(2).
_NOISE_CHANGE = 2.8
# Noise is not the same everywhere: only a change that exceeds it by this factor is motion.
_MOVING = 1.5
# Levels matter where what rounding does to the phase is more than this part of what noise does.
_ROUGH = 0.5
# Where this many upper bits are unused, that is a mistake, or the exposure much too short.
_UNUSED_BITS = 2
# What is the rig's and not the footage's: decoding learns it from a frame, or a calibration holds it.
_OF_THE_RIG = {"response", "crosstalk", "even crosstalk"}
_STILL_UNKNOWN = "frames that are the same may be repeated, or nothing moved: this codec makes them alike either way"
#: Exit code for footage that should not be used as it is.
NOT_AS_IT_IS = 3


@dataclass(frozen=True)
class ContainerFacts:
    """Facts that are known without decoding."""

    container: str
    codec: str
    pixels: str  # in FFmpeg's words, or those of `PixelFormat`
    lossy: bool  # whether the codec drops what it considers invisible
    predicts: bool  # whether frames are made of others, so that one that does not change is repeated exactly
    rate_hz: float | None  # frames per second
    bits_a_pixel: float | None
    missing: int | None  # frames that are not there between others; None: unknown
    gaps: int  # in how many places


def container_facts(path: Path, source: Footage) -> ContainerFacts:
    """Return the facts that the container of an open source states."""
    width, height = source.size_px
    if isinstance(source, VideoFile):
        import av  # slow to import, and only needed here

        with av.open(f"file:{path.absolute()}", metadata_errors="replace") as container:
            stream = next(films(container))
            context = stream.codec_context
            rate = stream.average_rate
            missing, gaps = _missing(source.stamps)
            return ContainerFacts(
                container=container.format.long_name,
                codec=context.name,
                pixels=str(context.pix_fmt),
                lossy=bool(context.codec.lossy),
                predicts=not (context.codec.intra_only or context.name == "ffv1"),
                rate_hz=None if not rate else float(rate),
                bits_a_pixel=8 * path.stat().st_size / (len(source) * width * height),
                missing=missing,
                gaps=gaps,
            )
    if isinstance(source, ImageFolder):
        lossy = source.names[0].lower().endswith(_LOSSY_SUFFIXES)
        # The number that changes from name to name: the last one.
        numbers = [int(found[-1]) for name in source.names if (found := _NUMBER.findall(Path(name).stem))]
        missing, gaps = _missing(numbers) if len(numbers) == len(source) else (None, 0)
        several = "a folder of pictures" if Path(source.name).is_dir() else "pages of a file"
        kind = "a picture" if len(source) == 1 else several
        codec = Path(source.names[0]).suffix[1:].lower()
        return ContainerFacts(kind, codec, source.format.layout, lossy, False, None, None, missing, gaps)
    return ContainerFacts("our recording in Zarr", "blosc", source.format.layout, False, False, None, None, None, 0)


def _missing(places: Sequence[int]) -> tuple[int | None, int]:
    """Return how many steps are missing from ascending places, and in how many gaps; None where none are usual."""
    if len(places) < 3:
        return None, 0
    steps = np.diff(np.asarray(places, np.float64))
    usual = float(np.median(steps))
    if usual <= 0 or steps.min() <= 0:
        return None, 0
    gaps = steps[steps > _GAP * usual]
    # A clock without a rate: what looks like gaps is how it goes.
    if len(gaps) > 0.2 * len(steps):
        return None, 0
    return int((np.rint(gaps / usual) - 1).sum()), len(gaps)


@dataclass(frozen=True)
class FootageFinding:
    """One property that was inspected."""

    topic: str  # a word for programs, as "chroma"
    found: str
    cost_rad: float | None = None  # RMS of the phase's error by it; None: it has none, or none that can be known
    grade: Grade = "fine"
    advice: str = ""


def _finding(
    topic: str, found: str, cost_rad: float | None = None, advice: str = "", *, grade: Grade | None = None
) -> FootageFinding:
    """Return a finding; without a grade its cost gives it."""
    if grade is None:
        cost = cost_rad or 0.0
        grade = "spoils" if cost >= _MOST_RAD else "costs" if cost >= LEAST_RAD else "fine"
    return FootageFinding(topic, found, cost_rad, grade, "" if grade == "fine" else advice)


def container_findings(facts: ContainerFacts, source: Footage) -> Iterator[FootageFinding]:
    """Yield the container's facts, and what is missing from the file."""
    width, height = source.size_px
    rate = "" if facts.rate_hz is None else f", {facts.rate_hz:.4g} a second"
    frames = "1 frame" if len(source) == 1 else f"{len(source)} frames"
    yield _finding("container", f"{facts.container}: {frames} of {width}x{height}{rate}")
    for note in source.notes:
        what, _, advice = note.partition(": ")
        if "cut off" in advice:
            yield _finding("truncated", what, advice="copy it again, or decode what is there", grade="spoils")
        elif "not undone" in what:
            yield _finding("transfer", what, advice=advice, grade="spoils")
        elif "interlaced" in what:
            yield _finding("interlaced", note, advice="record whole frames (progressive)", grade="spoils")
        else:
            yield _finding("container", note)
    if facts.missing:
        places = "1 place" if facts.gaps == 1 else f"{facts.gaps} places"
        yield _finding(
            "dropped",
            f"{facts.missing} frames are missing in {places}",
            0.0,
            "the others are as good as ever, but what moves jumps there; the file does not say why they are missing",
            grade="costs",
        )


def frame_findings(seen: FootageEvidence, facts: ContainerFacts, given: DecodeSettings) -> Iterator[FootageFinding]:
    """Yield what makes frames unusable."""
    if seen.bad:
        first = seen.bad[0]
        yield _finding(
            "damaged",
            first.reason
            if seen.n_frames == 1
            else f"{len(seen.bad)} of {seen.n_frames} frames; frame {first.number}: {first.reason}",
            advice="copy it again; decoding leaves such frames out",
            grade="spoils",
        )
    n_good = seen.n_frames - len(seen.bad)
    if not seen.kept:
        yield _finding(
            "fringes",
            "none in this frame" if n_good == 1 else f"none in {n_good} frames",
            advice=next(iter(seen.no_fringes.values()), ""),
            grade="spoils",
        )
    elif seen.no_fringes:
        yield _finding(
            "fringes",
            f"none in {len(seen.no_fringes)} of {n_good} frames, as in frame {next(iter(seen.no_fringes))}",
            advice="leave such frames out (--start, --stop)",
            grade="costs",
        )
    if seen.kept and seen.settings.stripes != given.stripes:
        stripes = seen.settings.stripes
        yield _finding("direction", f"the stripes are {stripes}", None, f'set stripes = "{stripes}"', grade="spoils")
    if seen.repeats and not (facts.predicts and not _moves(seen)):
        yield _finding(
            "repeated",
            f"{len(seen.repeats)} of {seen.n_pairs} frames are the one before, as frame {seen.repeats[0]}",
            0.0,
            "they hold nothing new: record at the rate at which the camera delivers",
            grade="costs",
        )


def fringe_findings(seen: FootageEvidence, typical: FrameQuality) -> Iterator[FootageFinding]:
    """Yield what the fringes are like, and how noisy their phase is."""
    periods = [look.period_px for look in seen.kept]
    yield _finding("fringes", f"{seen.settings.stripes}, {np.median(periods):.1f} px per cycle")
    # A limit that is lower than neighbours differ by shows what it is that costs.
    faint, spoils = typical.contrast < MIN_CONTRAST, typical.limit_rad >= _MOST_RAD
    found = f"the fringe's amplitude is {typical.contrast:.0%} of the light"
    if not faint and typical.faint > _LITTLE_FAINT:
        faint, spoils = True, typical.faint > _MUCH_LOST
        found += f", and less than {MIN_CONTRAST:.0%} on {typical.faint:.0%} of what is lit"
    yield _finding(
        "contrast",
        found,
        typical.limit_rad,
        "a frame under black shows the other light; where there is little, focus and expose shorter",
        grade="fine" if not faint else "spoils" if spoils else "costs",
    )
    yield _finding(
        "total",
        "noise of a pixel's phase by all causes together, as neighbours differ by it",
        typical.sigma_rad,
        "change what costs most",
        grade="spoils" if typical.sigma_rad >= _MOST_RAD else "fine",
    )


def storage_findings(
    seen: FootageEvidence, facts: ContainerFacts, source: Footage, typical: FrameQuality
) -> Iterator[FootageFinding]:
    """Yield what codec, chroma and levels cost."""
    # The codec's part of the noise: what neither the camera's noise, as far as the codec has left it, nor levels make.
    rest = float(np.sqrt(max(0.0, typical.sigma_rad**2 - typical.limit_rad**2)))
    x, y = source.format.subsampling
    subsampled = source.format.layout == "yuv" and (x, y) != (1, 1)
    if seen.repeated is not None:
        yield _finding(
            "chroma",
            f"RGB made of a video: each colour is repeated for {seen.repeated}; interpolated instead, it costs this",
            rest,
            "decode the video itself, or record its planes: cv2.VideoCapture and ffmpeg repeat colours",
            grade=None if rest >= LEAST_RAD else "costs",
        )
    names = {(2, 2): "4:2:0", (2, 1): "4:2:2", (1, 2): "4:4:0", (4, 1): "4:1:1", (4, 4): "4:1:0"}
    name = names.get((x, y), f"one in {x} across and {y} down")
    rate = "" if facts.bits_a_pixel is None else f", {facts.bits_a_pixel:.2f} bits per pixel"
    yield _finding(
        "codec",
        f"{facts.codec}, {facts.pixels}, {'with' if facts.lossy else 'without'} loss{rate}",
        rest if facts.lossy and not subsampled else None,
        "give it more bits (H.264: crf 10), or record without loss (FFV1)",
    )
    if subsampled:
        yield _finding(
            "chroma",
            f"{name}: one colour for {x * y} pixels" + (", what the codec costs included" if facts.lossy else ""),
            rest,
            "record RGB, 4:4:4 or raw Bayer" + ("; a lossy codec with more bits" if facts.lossy else ""),
            grade=None if rest >= LEAST_RAD else "costs",
        )
    if seen.siting is not None:
        assumed, better = source.format.siting, seen.siting.better
        if better is None:
            found = f"{assumed} is assumed; these frames do not show it; if it is the other one, its cost is this"
            yield _finding("siting", found, seen.siting.differ_rad, grade="fine")
        elif better == assumed:
            yield _finding("siting", f"{assumed} fits better than the other", 0.0)
        else:
            advice = f"add --siting {better}"
            found = f"{better} fits better than {assumed}, which is assumed"
            yield _finding("siting", found, seen.siting.differ_rad, advice, grade="spoils")
    bits = bits_of(source)
    kind = "floats" if source.format.bits == FLOAT_BITS else f"{bits} bits"
    if seen.brightest < 2.0**-_UNUSED_BITS:
        used = max(1, bits + int(np.ceil(np.log2(max(seen.brightest, 2.0**-bits)))))
        kind += f", but no value uses more than {used} of them"
        advice = f"if the camera delivers {used} bits, add --bits {used}, or clipping goes unseen; else expose more"
        yield _finding("depth", kind, typical.level_limit_rad, advice, grade="costs")
        return
    rough = typical.level_limit_rad > max(LEAST_RAD, _ROUGH * typical.limit_rad)
    advice = "record more bits, or expose more"
    yield _finding("depth", kind, typical.level_limit_rad, advice, grade=None if rough else "fine")


def light_findings(seen: FootageEvidence, typical: FrameQuality) -> Iterator[FootageFinding]:
    """Yield what is wrong with exposure and transfer, and what the rig itself does."""
    diagnosed = () if seen.diagnosis is None else seen.diagnosis.findings
    cut = [_rms(finding.ripple_rad) for finding in diagnosed if finding.causes == ("clipping",)]
    cost = max(cut, default=0.0)
    grade: Grade | None = "costs" if typical.lost > _LITTLE_LOST and cost < LEAST_RAD else None
    yield _finding(
        "saturation",
        f"{typical.clipped:.1%} of the lit pixels have a channel at full scale, {typical.lost:.1%} no phase by it",
        cost,
        "expose less, or dim the projector",
        grade="spoils" if typical.lost > _MUCH_LOST else grade,
    )
    transfer, other = seen.settings.transfer, [f for f in diagnosed if f.causes == ("transfer",)]
    if other:
        worst = other[0]
        yield _finding(
            "transfer", f"taken for {transfer}, but {worst.size}", _rms(worst.ripple_rad), worst.advice, grade="spoils"
        )
    elif seen.diagnosis is not None and np.isnan(seen.diagnosis.limit_rad):
        yield _finding(
            "transfer",
            f"taken for {transfer}, which these frames do not show, nor the projector's response",
            advice="calibrate the light, or show a larger smooth surface: what is not known of them makes waves",
            grade="costs",
        )
    elif any("transfer" in finding.causes for finding in diagnosed):
        yield _finding("transfer", f"{transfer}; or it is the projector's response: these frames do not show which")
    else:
        yield _finding("transfer", f"{transfer}; the fringes do not contradict it")
    rig = [f for f in diagnosed if "clipping" not in f.causes and f.causes != ("transfer",)]
    for finding in rig:
        causes = " or ".join(finding.causes)
        learnt = set(finding.causes) <= _OF_THE_RIG
        cost = _rms(finding.ripple_rad)
        yield _finding(
            "rig",
            f"{causes} ({finding.size})" + ("; decoding learns it, a calibration knows it" if learnt else ""),
            cost,
            finding.advice,
            # Less than a pixel's noise is what learning the crosstalk from one frame leaves.
            grade="costs" if finding.causes == BANDS else "fine" if learnt or cost < typical.sigma_rad else None,
        )


def time_findings(seen: FootageEvidence, typical: FrameQuality) -> Iterator[FootageFinding]:
    """Yield what changes from frame to frame."""
    yield from _drift_findings(seen)
    if seen.motion_rad:
        moved = _moved_rad(seen, typical)
        # An exposure as long as a frame averages over all of it, and takes this from the contrast.
        left = float(np.sinc(moved / (2 * np.pi)))
        cost = typical.sigma_rad * float(np.sqrt(1 / max(left, 0.05) ** 2 - 1))
        yield _finding(
            "motion",
            f"{moved:.2f} rad per frame; at most {1 - left:.0%} of the contrast is blurred away, if exposed all the "
            "time"
            if moved
            else "none that stands out of the noise",
            cost,
            "expose for less time"
            if moved < _THIRD_OF_A_CYCLE
            else "more frames per second, or a coded pattern: by "
            "more than a third of a cycle per frame, orders cannot be followed",
            grade="spoils" if moved >= _THIRD_OF_A_CYCLE else None,
        )
    for finding in () if seen.sequence is None else seen.sequence.findings:
        yield _finding(
            "colour fields",
            f"{finding.causes[0]}: {finding.size}",
            _rms(finding.ripple_rad),
            finding.advice,
            grade="costs",
        )


def _moved_rad(seen: FootageEvidence, typical: FrameQuality) -> float:
    """Return how far the fastest surface moves from frame to frame; 0 if nothing stands out of the noise."""
    noise, most = _NOISE_CHANGE * typical.sigma_rad, max(seen.motion_rad, default=0.0)
    return float(np.sqrt(most**2 - noise**2)) if most > _MOVING * noise else 0.0


def cost_findings(
    seen: FootageEvidence, facts: ContainerFacts, typical: FrameQuality, scale: Scale | None, n_rows: int
) -> Iterator[FootageFinding]:
    """Yield the costs of motion in mm, in the words of `colorphase plan`, at the speed seen or the usual one."""
    settings, moved = seen.settings, _moved_rad(seen, typical)
    speed_mm_s, rate_hz = USUAL_SPEED_MM_S, facts.rate_hz or (1 / settings.frame_s if settings.frame_s else None)
    if scale is not None and rate_hz is not None and moved:
        speed_mm_s = moved * scale.mm_per_rad * rate_hz
    cycle_s = None if settings.fields is None else settings.fields.cycle_s
    mm_per_px = None if scale is None else scale.mm_per_px
    for cost in motion_costs(speed_mm_s, mm_per_px, cycle_s, settings.row_s * (n_rows - 1)):
        yield _finding(cost.topic, f"{cost.value:.2g} {cost.unit} {cost.meaning}")


def _drift_findings(seen: FootageEvidence) -> Iterator[FootageFinding]:
    """Yield how the camera's gains change; its exposure only where most of what is in view stands still."""
    tints, exposures = [], []
    for later in seen.kept[1:]:
        change = measure_gains(seen.kept[0], later)
        if change is not None:
            common = float(np.log(change).mean())
            tints.append(np.log(change) - common)
            exposures += [common] if stands_still(seen.kept[0], later) else []
    if not tints:
        return
    gain, shade = max(map(abs, exposures), default=0.0), float(np.abs(tints).max())
    exposure = f"exposure by up to {np.expm1(gain):.1%}" if exposures else "exposure unknown, as what is in view moves"
    yield _finding(
        "drift",
        f"{exposure}; white balance by up to {np.expm1(shade):.1%}",
        0.0,  # gains are what the balance undoes
        "the balance undoes gains, but a calibration holds for one exposure only: lock exposure, gain and "
        "white balance",
        grade="costs" if gain > _MOST_GAIN or shade > _MOST_TINT else "fine",
    )


def unknown_facts(seen: FootageEvidence, facts: ContainerFacts, source: Footage) -> Iterator[str]:
    """Yield what these frames cannot show, one sentence each."""
    if facts.lossy:
        yield "the camera's own noise: the codec has removed some of it"
    if seen.diagnosis is not None and np.isnan(seen.diagnosis.limit_rad):
        yield f"transfer, response and lateral colour: {seen.diagnosis.notes[0]}"
    elif source.transfer is None:
        yield "a transfer that the projector's response happens to undo: the footage does not say how it encodes light"
    if len(source) == 1:
        yield "motion and drift: it is one frame"
    elif not seen.motion_rad:
        yield "how anything moves: no two neighbours with fringes were found"
    else:
        yield "how long the camera exposed, and motion along the surface, which changes no phase"
    if seen.repeats and facts.predicts and not _moves(seen):
        yield _STILL_UNKNOWN
    if seen.sequence is not None:
        yield from seen.sequence.notes


def _moves(seen: FootageEvidence) -> bool:
    """Return whether anything but noise moves between neighbours."""
    sigma = float(np.median([shown.sigma_rad for shown in seen.qualities])) if seen.qualities else 0.0
    return bool(seen.motion_rad) and float(np.median(seen.motion_rad)) > _MOVING * _NOISE_CHANGE * sigma


def _rms(ripple_rad: dict[int, float]) -> float:
    """Return the RMS of harmonics with these amplitudes."""
    return float(np.sqrt(sum(size**2 for size in ripple_rad.values()) / 2))


@dataclass(frozen=True)
class Inspection:
    """All findings about some footage, the container's first."""

    findings: tuple[FootageFinding, ...]
    unknown: tuple[str, ...]  # what these frames cannot show, one sentence each
    n_looked_at: int
    n_frames: int

    @property
    def grade(self) -> Grade:
        """The worst of all findings."""
        return max((finding.grade for finding in self.findings), key=GRADES.index)

    def topics(self, grade: Grade) -> tuple[str, ...]:
        """Return what has this grade."""
        return tuple(finding.topic for finding in self.findings if finding.grade == grade)

    def as_json(self) -> dict[str, Any]:
        """Return all of it for programs."""
        return {"grade": self.grade, **asdict(self)}


def inspect_footage(
    path: str | Path,
    says: StoredAs | None = None,
    settings: DecodeSettings | None = None,
    arch: str = "auto",
    notify: Callable[[str], None] = lambda _: None,
    calibration: Calibration | None = None,
) -> Inspection:
    """Inspect about twenty frames, however many there are, and report what their phase suffers from.

    Parameters
    ----------
    path : str or Path
        Path for `open_footage`.
    says : StoredAs, optional
        The user's description of how pixels are stored.
    settings : DecodeSettings, optional
        Settings intended for decoding.
    arch : {"auto", "cpu", "vulkan", "cuda", "metal"}
        Device to compute on.
    notify : callable
        Called with what is being done.
    calibration : Calibration, optional
        Of the rig, to give the costs of motion in mm.

    Raises
    ------
    FootageError
        It cannot be read at all.
    CalibrationError
        The calibration is for another frame size.
    DeviceNotReady
        The machine lacks the arch.
    """
    says, settings = says or StoredAs(), settings or DecodeSettings()
    notify("opening")
    with open_footage(path, **vars(says)) as source:
        runtime.init(arch)
        facts = container_facts(Path(path), source)
        seen = gather_evidence(source, says, settings, arch, notify)
        scale = None if calibration is None else measure_scale(source, seen.settings, calibration, arch)
    findings = [*container_findings(facts, source), *frame_findings(seen, facts, settings)]
    open_questions = []
    if facts.missing is None and len(source) > 1:
        open_questions.append(
            "whether frames are missing between others: neither even time stamps nor numbers in names show it"
        )
    if seen.kept:
        typical = FrameQuality(*np.median([list(vars(shown).values()) for shown in seen.qualities], axis=0).tolist())
        findings += [
            *fringe_findings(seen, typical),
            *storage_findings(seen, facts, source, typical),
            *light_findings(seen, typical),
            *time_findings(seen, typical),
            *cost_findings(seen, facts, typical, scale, source.size_px[1]),
        ]
        open_questions += unknown_facts(seen, facts, source)
    if seen.n_frames < len(source):
        open_questions.append(
            f"what is wrong in frames between the {seen.n_frames} of {len(source)} that were looked at"
        )
    return Inspection(tuple(findings), tuple(open_questions), seen.n_frames, len(source))
