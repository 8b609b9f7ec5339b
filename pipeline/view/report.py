"""A result or a calibration as a document: one HTML file that needs nothing else, and runs nothing but the viewer."""

import base64
import io
import json
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import numpy.typing as npt

from pipeline import __version__
from pipeline.calibration import Calibration
from pipeline.decoding.frame import FIELDS
from pipeline.diagnosis.certificate import (
    check_balls,
    form,
    measure_balls,
    measure_plate,
    measured_spacing_mm,
    spread,
)
from pipeline.errors import CalibrationError, FootageError, OutputError
from pipeline.output.notebook import calibration_figures, calibration_warnings
from pipeline.output.range_image import shade_range
from pipeline.output.report import depth_in_words, mm_per_rad
from pipeline.output.store_files import identity_digest
from pipeline.output.stored_result import ResultFrame, StoredResult
from pipeline.showing import plot_image
from pipeline.text import one_line
from pipeline.view.message import ViewedFrame
from pipeline.view.page import page, page_text, policy
from pipeline.view.subjects import ResultSubject

if TYPE_CHECKING:
    from jinja2 import Environment

T = TypeVar("T")

# Frames of a long result that are looked at: medians and scatter of more differ little, and a minute is enough.
_LOOKED_AT = 50
# Frames that can be turned, and pixels of all of them together: 16 MB of a file, which mail and viewers take up to 25.
_TURNED, _MOST_PIXELS = 8, 640_000
_MAPS = ("points", "depth", "sigma", "texture")
# Of the picture: its letters are as large as the text's on a page of A4, and it is as sharp as print.
_SIZE_IN, _DPI = (9.0, 6.6), 160
_MOST_WARNINGS = 50
_PROGRAM = f"colorphase {__version__}"


@dataclass(frozen=True)
class Artefacts:
    """Objects in a result whose true shape is known."""

    plane: bool = False
    ball_mm: float | None = None  # diameter of a ball, or of two
    spacing_mm: float | None = None  # distance of the centres of two


@dataclass(frozen=True)
class Section:
    """A table of a report."""

    heading: str
    rows: Sequence[Sequence[str]]
    head: Sequence[str] = ()
    note: str = ""


def report_calibration(calibration: Calibration, name: str) -> str:
    """Return the report of a calibration, from a file of this name, as HTML.

    Raises
    ------
    OutputError
        jinja2 is not installed.
    """
    environment = _environment()
    made = [("calibration, SHA-256", calibration.digest()), ("reported by", _PROGRAM)]
    return _rendered(
        environment,
        kind="Calibration report",
        title=name,
        about=Section("Rig", [*calibration_figures(calibration).items()]),
        warnings=[(text, 1) for text in calibration_warnings(calibration)],
        sections=[Section("Provenance", made)],
    )


def report_result(location: str, calibration: Calibration | None = None, artefacts: Artefacts | None = None) -> str:
    """Return the report of a result as HTML, of less than 25 MB.

    Parameters
    ----------
    location : str
        The ``result.zarr``.
    calibration : Calibration, optional
        The one that it was decoded with; None: its uncertainty is not known.
    artefacts : Artefacts, optional
        What it shows.

    Raises
    ------
    FootageError
        There is no such result, none of its frames can be read, or it lacks a field by which artefacts are measured.
    CalibrationError
        It was decoded with another calibration, or does not show those artefacts.
    OutputError
        jinja2 is not installed.
    """
    environment = _environment()
    result, subject = StoredResult(location), ResultSubject(location)
    if calibration is not None and calibration.digest() != (other := result.attributes["calibration_sha256"]):
        digests = f"its SHA-256 is {other}, this one's {calibration.digest()}"
        raise CalibrationError(f"{result.name} was decoded with another calibration ({digests}): give that one")
    seen = _Seen(result, calibration)
    turned = _spaced(seen.frames, _TURNED)
    step = int(np.ceil(np.sqrt(len(turned) * np.prod(result.size_px) / _MOST_PIXELS)))
    about = subject.about()
    about["maps"] = {name: entry for name, entry in about["maps"].items() if name in _MAPS}
    about["rate_hz"] *= len(turned) / len(result)
    about |= {"count": len(turned), "growing": False}
    return _rendered(
        environment,
        kind="Measurement report",
        title=subject.title,
        about=seen.summary(),
        warnings=seen.warnings.most_common(_MOST_WARNINGS),
        looked_at=min(len(result), _LOOKED_AT),
        picture=_picture(seen.shown),
        pictured="" if len(result) == 1 else f"Frame {seen.shown.number}.",
        sections=[*seen.errors(artefacts or Artefacts()), seen.budget(), seen.coverage()],
        viewer=page(about, [ViewedFrame.of(frame, _MAPS) for frame in turned], step),
        turned=_of(len(turned), len(result)).capitalize() + (f", one of {step} x {step} pixels" if step > 1 else ""),
        appendix=seen.appendix(),
    )


class _Seen:
    """Frames of a result that are looked at, evenly spaced, and what they show.

    Raises
    ------
    FootageError
        None of them can be read.
    """

    def __init__(self, result: StoredResult, calibration: Calibration | None) -> None:
        self.result, self.calibration = result, calibration
        self.unit = "mm" if result.in_mm else "rad"
        self.frames: list[ResultFrame] = []
        self.figures: dict[str, list[float]] = defaultdict(list)
        self.warnings: Counter[str] = Counter()
        for frame in _spaced([*result], _LOOKED_AT):
            try:
                found = _figures(frame)
                self.warnings.update(frame.warnings)
            except FootageError as error:
                self.warnings[str(error)] += 1
                continue
            self.frames.append(frame)
            for name, value in found.items():
                self.figures[name].append(value)
        if not self.frames:
            raise FootageError(next(iter(self.warnings), f"{result.name} holds no frame: run colorphase decode"))
        self.shown = self.frames[len(self.frames) // 2]

    @cached_property
    def per_rad(self) -> float | None:
        """Depth per phase, mm per rad, from the frames or else from the rig; None: unknown."""
        per_rad, depth_mm = (_middle(self.figures[name]) for name in ("mm_per_rad", "depth"))
        if np.isfinite(per_rad):
            return per_rad
        return None if self.calibration is None else 1 / self.calibration.geometry().rad_per_mm(depth_mm)

    @property
    def note(self) -> str:
        """Explanation of figures over several frames."""
        return "" if len(self.frames) == 1 else "The median of the frames, with the least and the largest value."

    def over(self, name: str, words: str, unit: str = "", scale: float = 1.0) -> str:
        """Return a figure over the frames, in words."""
        if name not in self.figures:
            return f"not known: {name} is not stored"
        values = scale * np.array(self.figures[name])
        values = values[np.isfinite(values)]
        if not values.size:
            return "not known"
        low, middle, high = (words.format(value) for value in (values.min(), np.median(values), values.max()))
        return (middle if low == high else f"{middle} ({low} to {high})") + unit

    def in_depth(self, name: str) -> str:
        """Return a figure of phases over the frames, in words: in mm if that is known."""
        if self.per_rad is not None:
            return self.over(name, "{:.4f}", " mm", self.per_rad)
        known = self.over(name, "{:.4f}", " rad")
        return f"{known}; give --calibration for mm" if self.result.in_mm and name in self.figures else known

    def summary(self) -> Section:
        """Return what the result is."""
        result, (width, height) = self.result, self.result.size_px
        depth = _depth(self.shown)
        known = depth[np.isfinite(depth)]
        low, high = np.percentile(known, (1, 99)) if known.size else (np.nan, np.nan)
        span = f"{low:.2f} to {high:.2f} {self.unit}" if known.size else "nothing is measured"
        rows = [
            ("frames", _of(len(self.frames), len(result))),
            ("taken", _times(self.frames[0], self.frames[-1])),
            ("size", f"{width} x {height} px"),
            ("depth, 1 to 99 %", span if result.in_mm else f"{span}, relative: not metric"),
        ]
        lacks = [name for name in FIELDS if name not in result.fields and (result.in_mm or not FIELDS[name].in_mm)]
        if lacks:
            rows.append(("not stored", f"{', '.join(lacks)}: name them in decode's --fields"))
        return Section("Result", rows)

    def errors(self, given: Artefacts) -> Iterator[Section]:
        """Yield how far artefacts are off their true shape, in the words of a certificate."""
        if given == Artefacts():
            return
        self.result.require_mm()
        window_px = self.result.attributes["settings"]["smoothing_px"]
        camera, per_rad = self.result.camera, self.per_rad
        if camera is None or per_rad is None:
            raise FootageError(f"{self.result.name} lacks phase_sigma or point_sigma: decode with both")
        flats, groups, by = [], [], []
        for frame in self.frames:
            try:
                if given.plane:
                    flats.append(measure_plate(frame, window_px))
                if given.ball_mm is not None:
                    count = 1 if given.spacing_mm is None else 2
                    groups.append(measure_balls(frame, given.ball_mm, count, camera, window_px))
                    check_balls(groups[-1], given.ball_mm, given.spacing_mm, lambda _: 1 / per_rad)
            except CalibrationError as error:
                raise CalibrationError(f"frame {frame.number}: {error}") from None
        balls, figures, predicted = [ball for group in groups for ball in group], [], ""
        if given.ball_mm is not None:
            by.append(f"a ball of {given.ball_mm:g} mm")
            sizes = [2 * ball.radius_mm - given.ball_mm for ball in balls]
            figures += [form("probing error, form", balls), spread("probing error, size", sizes)]
        if given.spacing_mm is not None:
            by = [f"two balls of {given.ball_mm:g} mm, {given.spacing_mm:g} mm apart"]
            spacings = [measured_spacing_mm(pair) - given.spacing_mm for pair in groups]
            figures.append(spread("sphere spacing error", spacings))
        if given.plane:
            by.append("a plane")
            figures.append(form("flatness measurement error", flats))
            predicted = f" The predicted noise of a point is {_middle([flat.sigma_mm for flat in flats]):.3f} mm."
        rows = [(each.name, *_mm(each.largest_mm, each.trueness_mm, each.precision_mm)) for each in figures]
        rows.append(("noise of a point", "", "", *_mm(form("", [*flats, *balls]).precision_mm)))
        note = (
            f"In the words of VDI/VDE 2634 Part 2, by {' and '.join(by)}. Trueness is what repeats: the mean error, of "
            "forms what is left in the means of tiles of a cycle. Precision is what scatters about it."
            f"{predicted} A certificate takes seven positions: colorphase certify."
        )
        yield Section("Errors", rows, ("mm", "largest", "trueness", "precision"), note)

    def budget(self) -> Section:
        """Return what a depth is uncertain by, part by part."""
        known = "not known: give --calibration" if self.result.in_mm else "none: the result is not metric"
        if self.calibration is not None:
            sigmas = self.calibration.uncertainty
            bias_mm = None if sigmas is None else sigmas.depth_bias_mm
            known = "not known: the calibration does not state it" if bias_mm is None else f"{bias_mm:.3f} mm"
        cycle = "a cycle" if self.per_rad is None else f"a cycle, {2 * np.pi * self.per_rad:.4g} mm"
        order = f"{cycle}; probability {self.over('order_error_probability', '{:.2%}')}"
        noise = (
            self.over("point_sigma", "{:.4f}", " mm") if "point_sigma" in self.figures else self.in_depth("phase_sigma")
        )
        rows = [
            ("noise", noise, "each point by itself"),
            ("constant of all phases", self.in_depth("constant_sigma"), "a frame as a whole"),
            ("calibration", known, "all frames alike, smooth over the picture"),
            ("order", order, "a surface as a whole"),
        ]
        return Section("Error budget", rows, ("part", "one standard deviation", "moves"), self.note)

    def coverage(self) -> Section:
        """Return how much is measured, and how surely."""
        rows = [
            ("measured, of all pixels", self.over("measured", "{:.1%}")),
            ("absolute, of the measured pixels", self.over("absolute", "{:.1%}")),
            ("regions", self.over("region", "{:.0f}")),
        ]
        depth = depth_in_words(self.shown, front_known=self.result.front_known)
        if depth is not None:
            rows.append(("depth" if len(self.frames) == 1 else f"depth of frame {self.shown.number}", depth))
        return Section("Coverage", rows, note=self.note)

    def appendix(self) -> list[Section]:
        """Return how the result was made."""
        about = self.result.attributes
        values = {name: value for name, value in about["settings"].items() if value is not None}
        texts = [(name, value if isinstance(value, str) else json.dumps(value)) for name, value in values.items()]
        footage = about.get("footage", {})
        rows = [
            ("footage", str(footage.get("name", "a picture"))),
            ("its first frame, SHA-256", str(footage.get("first_frame_sha256", "not recorded"))),
            ("decoded by", f"colorphase {about['colorphase_version']}"),
            ("reported by", _PROGRAM),
            ("calibration, SHA-256", about["calibration_sha256"] or "none"),
            ("how it was decoded, SHA-256 begins with", identity_digest(about)),
        ]
        note = "What is not listed was left to the program."
        return [Section("Settings", texts, note=note), Section("Provenance", rows)]


def _figures(frame: ResultFrame) -> dict[str, float]:
    """Return a frame's figures, as far as its fields allow; NaN: unknown."""
    depth, stored = _depth(frame), frame.fields.keys()
    mask = frame.mask if "mask" in stored else np.isfinite(depth)
    per_rad = mm_per_rad(frame, mask)
    found = {"measured": float(mask.mean()), "depth": _middle(depth[mask])}
    found["mm_per_rad"] = np.nan if per_rad is None else per_rad
    for name in stored & {"point_sigma", "phase_sigma"}:
        found[name] = _middle(getattr(frame, name)[mask])
    for name in stored & {"absolute", "order_error_probability"}:
        found[name] = float(getattr(frame, name)[mask].mean()) if mask.any() else np.nan
    for name in stored & {"region", "constant_sigma"}:
        found[name] = float(getattr(frame, name).max())
    return found


def _depth(frame: ResultFrame) -> npt.NDArray[np.float32]:
    if "range_image" in frame.fields or frame.points is None:
        return frame.range_image
    return frame.points[..., 2]


def _middle(values: npt.ArrayLike) -> float:
    known = np.asarray(values)[np.isfinite(values)]
    return float(np.median(known)) if known.size else np.nan


def _spaced(things: Sequence[T], most: int) -> list[T]:
    places = np.linspace(0, len(things) - 1, min(len(things), most))
    return [things[place] for place in np.rint(places).astype(int)]


def _of(count: int, of: int) -> str:
    if of == 1:
        return "one frame"
    return f"all {of:,} frames" if count == of else f"{count} of {of:,} frames, evenly spaced"


def _mm(*values: float) -> list[str]:
    return [f"{value:.3f}" if np.isfinite(value) else "n/a" for value in values]


def _times(first: ResultFrame, last: ResultFrame) -> str:
    if first.time_s is None or last.time_s is None:
        return "not recorded"
    seconds = dict.fromkeys((first.time_s, last.time_s))
    if first.dated:
        return " to ".join(f"{datetime.fromtimestamp(time_s, UTC):%Y-%m-%d %H:%M:%S}" for time_s in seconds) + " UTC"
    return " to ".join(f"{time_s:.3f}" for time_s in seconds) + " s after the first frame"


def _picture(frame: ResultFrame) -> str:
    """Return the address of a picture of a frame: its surface, shaded, and maps with their bars."""
    from matplotlib.figure import Figure  # slow to import, and only needed here

    depth, stored = _depth(frame), frame.fields.keys()
    known = np.isfinite(depth) & (frame.mask if "mask" in stored else True)
    shaded = shade_range(depth, known, frame.points if "points" in stored else None)
    opacity = np.where(known, np.uint8(255), np.uint8(0))  # the paper shows where nothing is measured
    maps: dict[str, tuple[npt.NDArray[Any], str | None]] = {
        "surface": (np.dstack([shaded, opacity]), None),
        "depth": (depth, frame.range_unit),
    }
    for name in ("point_sigma" if "point_sigma" in stored else "phase_sigma", "texture"):
        if name in stored:
            maps[name.replace("_", " ")] = (getattr(frame, name), frame.fields[name].unit)
    figure, file = Figure(_SIZE_IN, layout="compressed"), io.BytesIO()
    places = figure.subplots(2, 2).flat if len(maps) > 2 else figure.subplots(1, 2)
    for place in places[len(maps) :]:
        place.set_axis_off()
    for place, (name, (values, unit)) in zip(places, maps.items(), strict=False):
        plot_image(values, name, unit, place)
    figure.savefig(file, format="png", dpi=_DPI, bbox_inches="tight")
    return f"data:image/png;base64,{base64.b64encode(file.getvalue()).decode()}"


def _environment() -> "Environment":
    try:
        import jinja2  # of the extra `view`
    except ImportError:
        raise OutputError("reports need jinja2: pip install 'colorphase[view]'") from None

    def printable(value: Any) -> Any:
        return one_line(value) if type(value) is str else value

    return jinja2.Environment(autoescape=True, finalize=printable)


def _rendered(environment: "Environment", **values: Any) -> str:
    """Return the page; texts in it are escaped, whoever wrote them."""
    from markupsafe import Markup, escape  # with jinja2

    style = page_text("report.css")
    values |= {"policy": policy(style), "style": Markup(style)}
    if "viewer" in values:
        values["viewer"] = escape(values["viewer"])  # not as one line: its scripts are known by their hashes
    return environment.from_string(page_text("report.html")).render(values)
