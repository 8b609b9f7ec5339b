"""Draw the pictures of docs/troubleshooting.md, from simulated frames with the fault put in.

python tests/benchmarks/symptom_pictures.py [name ...]      the pictures, or those of these names
python tests/benchmarks/symptom_pictures.py --say [name ...]  what the commands say of the page's frames
"""

import argparse
import tempfile
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import _tests_path  # noqa: F401 - puts `support` on the path
import matplotlib.pyplot as plt
import numpy as np
import numpy.typing as npt
from support.symptom_frames import (
    SEQUENCES,
    SYMPTOMS,
    Symptom,
    approaching,
    calibrated,
    one_fault,
    rig,
)
from support.symptom_words import what_is_said

from pipeline import Decoder, DecodeSettings
from pipeline.decoding.frame import DecodedFrame
from pipeline.footage.footage import StoredFrame
from pipeline.footage.opening import open_footage
from pipeline.output.pictures.picture_overlay import ColorScale
from pipeline.output.range_image import depth_colors, shade_range
from pipeline.simulation import SimulatedFrame
from tikernels import runtime
from tikernels.raw.development import develop
from tikernels.raw.linearization import linearize

_PAGE = Path(__file__).resolve().parents[2] / "docs" / "troubleshooting"
# A strip of four panels is then as wide as a page of text, and its fringes are not resampled to nothing.
_PANEL_IN, _DPI = 2.1, 100
# JPEG as small as fringes bear; the page's pictures are to stay below 600 kB together.
# Their colours are not to be subsampled, of all pictures.
_JPEG = {"quality": 75, "optimize": True, "subsampling": 0}
_ERROR_RAD = 0.3  # of all pictures of errors
_HIDDEN = 48  # grey level where nothing was measured, as in `range.png`
Picture = npt.NDArray[np.uint8]
Panel = tuple[str, Picture]
#: The rows and columns that a panel shows of a frame, px.
WHOLE = np.s_[:, :]
FACE = np.s_[120:330, 210:490]
DETAIL = np.s_[150:270, 240:400]


def as_seen(image: Picture, part: Any = WHOLE) -> Picture:
    """Return a part of a frame of linear light as a display shows it."""
    return np.asarray(255 * (image[part] / 255) ** (1 / 2.2), np.uint8)


def error_colors(frame: DecodedFrame, truth: SimulatedFrame, part: Any = WHOLE) -> Picture:
    """Return the error of the phase, a constant removed: blue is too small, white right, red too large."""
    error = np.angle(np.exp(1j * (frame.wrapped_phase - truth.phase)))
    error -= np.nanmedian(error)
    colors = plt.get_cmap("RdBu_r")(0.5 + 0.5 * np.nan_to_num(error) / _ERROR_RAD)[..., :3]
    return np.asarray(np.where((frame.mask & truth.mask)[..., None], 255 * colors, _HIDDEN)[part], np.uint8)


def shaded(frame: DecodedFrame, part: Any = WHOLE) -> Picture:
    """Return a surface as `shaded.png` shows it, and of a part only that part's relief."""
    return shade_range(frame.range_image, frame.mask, frame.points)[part]


def ranges(frame: DecodedFrame, *truths: SimulatedFrame, part: Any = WHOLE) -> Picture:
    """Return a range image as `range.png` shows it, in the colours of the true depths where these are given."""
    values = frame.range_image
    scale = ColorScale.over(values[frame.mask & np.isfinite(values)], "", "")
    if truths:
        depths_mm = np.concatenate([truth.points[..., 2][truth.mask] for truth in truths])
        near, far = np.percentile(depths_mm, (1, 99)).tolist()
        scale = ColorScale(near - 25.0, far + 25.0, "", "")
    return depth_colors(values, frame.mask, scale)[part]


def seen(name: str) -> tuple[Symptom, DecodedFrame]:
    """Return a symptom and what decoding makes of it."""
    symptom = SYMPTOMS[name]()
    return symptom, symptom.decode()


def draw(name: str, panels: list[Panel], columns: int) -> None:
    """Write panels in rows, each under a few words."""
    rows = -(-len(panels) // columns)
    height, width = panels[0][1].shape[:2]
    size = (columns * _PANEL_IN, rows * (_PANEL_IN * height / width + 0.2))
    figure, axes = plt.subplots(rows, columns, figsize=size, squeeze=False, layout="constrained")
    for axis in axes.flat:
        axis.set_axis_off()
    for axis, (title, picture) in zip(axes.flat, panels, strict=False):
        axis.imshow(picture, interpolation="antialiased")
        axis.set_title(title, fontsize=7.5, pad=3)
    save(figure, name)


def save(figure: Any, name: str) -> None:
    """Write a figure into the page's folder."""
    figure.get_layout_engine().set(w_pad=0.02, h_pad=0.02, wspace=0.01, hspace=0.01)
    _PAGE.mkdir(exist_ok=True)
    figure.savefig(_PAGE / f"{name}.jpg", dpi=_DPI, pil_kwargs=_JPEG)
    plt.close(figure)


def draw_nothing_measured() -> None:
    """Draw frames of which nothing is measured."""
    titles = {
        "dark": "too dark",
        "no_pattern": "no pattern",
        "vertical": "stripes the other way",
        "too_fine": "3 px a cycle",
    }
    draw("nothing_measured", [(title, as_seen(SYMPTOMS[n]().image, DETAIL)) for n, title in titles.items()], 4)


def draw_holes() -> None:
    """Draw highlights and a frame that is over-exposed."""
    panels: list[Panel] = []
    for name, title in (("gloss", "highlights"), ("over_exposed", "over-exposed")):
        symptom, frame = seen(name)
        assert symptom.truth is not None
        panels += [(title, as_seen(symptom.image, FACE)), ("range", ranges(frame, symptom.truth, part=FACE))]
    draw("holes", panels, 4)


def draw_ripple() -> None:
    """Draw ripple once, twice and three times a cycle, with the error below."""
    symptoms = {
        "good": one_fault(scene="waves"),
        "over-exposed: once a cycle, and more": one_fault(scene="waves", exposure=2.2),
        "crosstalk: twice a cycle": SYMPTOMS["crosstalk"](),
        "transfer: three times a cycle": SYMPTOMS["transfer"](),
    }
    frames = {title: symptom.decode() for title, symptom in symptoms.items()}
    panels = [
        ("frame" if title == "good" else title, as_seen(symptoms["good"].image, DETAIL))
        if title == "good"
        else (title, shaded(frame, DETAIL))
        for title, frame in frames.items()
    ]
    for title, frame in frames.items():
        truth = symptoms[title].truth
        assert truth is not None
        panels.append(("error, as it should be" if title == "good" else "error", error_colors(frame, truth, DETAIL)))
    draw("ripple", panels, 4)


def draw_orders() -> None:
    """Draw parts that float, and a pattern that is not the calibration's."""
    apart, floating = seen("parts_apart")
    other, mistaken = seen("other_pattern")
    coded, bust = one_fault(scene="objects"), one_fault()
    assert coded.truth is not None and bust.truth is not None
    draw(
        "orders",
        [
            ("three objects, plain pattern", as_seen(apart.image)),
            ("range", ranges(floating, coded.truth)),
            ("with the code", ranges(coded.decode(), coded.truth)),
            ("a plain pattern, taken for a coded one", as_seen(other.image)),
            ("range", ranges(mistaken, bust.truth)),
            ("with the code", ranges(bust.decode(), bust.truth)),
        ],
        3,
    )


def draw_sides() -> None:
    """Draw front and back, and a picture that was mirrored."""
    symptom, inside_out = seen("inside_out")
    right = symptom.decode(settings={"code": "contrast"})
    good = one_fault(scene="objects")
    mirrored = Symptom(np.ascontiguousarray(good.image[:, ::-1]), None, good.calibration)
    draw(
        "sides",
        [
            ("frame, no calibration", as_seen(symptom.image)),
            ('range, projector_side = "below"', ranges(inside_out)),
            ("range, as it should be", ranges(right)),
            ("frame, mirrored", as_seen(mirrored.image)),
            ("its surface, mirrored, too", shaded(mirrored.decode())),
            ("surface, as it should be", shaded(good.decode())),
        ],
        3,
    )


def draw_geometry() -> None:
    """Draw depth along a column: of a plane after the projector was moved, and of a ball with a wrong scale."""
    figure, axes = plt.subplots(1, 2, figsize=(4 * _PANEL_IN, 2.3), layout="constrained")
    names = (
        ("projector_moved", "a plane, projector turned by 0.5 degrees"),
        ("wrong_scale", "a ball, baseline 20 % long"),
    )
    for axis, (name, title) in zip(axes, names, strict=True):
        symptom, frame = seen(name)
        assert symptom.truth is not None and frame.points is not None
        column = np.s_[:, frame.mask.shape[1] // 2]
        for points, style, label in ((frame.points, "tab:red", "measured"), (symptom.truth.points, "0.4", "true")):
            axis.plot(points[column][:, 2], color=style, label=label)
        axis.set_title(title, fontsize=7.5)
        axis.set_xlabel("row", fontsize=7)
        axis.set_ylabel("depth, mm", fontsize=7)
        axis.tick_params(labelsize=6)
        axis.legend(fontsize=7)
    save(figure, "geometry")


def draw_edges() -> None:
    """Draw edges of paint, lateral colour and subsampled colours, enlarged."""
    part, edge = np.s_[160:320, 140:360], np.s_[180:260, 190:300]
    panels: list[Panel] = []
    for name, title, shown in (
        ("paint", "edges of paint", part),
        ("lateral_color", "lateral colour, 1 px", edge),
        ("subsampled", "a JPEG, 4:2:0", edge),
    ):
        symptom = SYMPTOMS[name]()
        if symptom.jpeg_quality is not None:
            symptom = _read_again(symptom)
        assert symptom.truth is not None
        panels.insert(len(panels) // 2, (title, as_seen(symptom.image, shown)))
        panels.append(("error", error_colors(symptom.decode(), symptom.truth, shown)))
    draw("edges", panels, 3)


def _read_again(symptom: Symptom) -> Symptom:
    """Return a symptom with the linear light that its file holds."""
    with tempfile.TemporaryDirectory() as folder:
        (stored,) = open_footage(symptom.write(Path(folder))).frames()
    assert isinstance(stored, StoredFrame)
    levels = runtime.to_host(linearize(develop(stored.planes, stored.format), "srgb"))
    return replace(symptom, image=np.asarray(np.rint(255 * levels), np.uint8), jpeg_quality=None)


def draw_noise() -> None:
    """Draw the same face by less and less fringe."""
    panels = [("as it should be", shaded(one_fault().decode(), FACE))]
    for name, title in (("noisy", "noise of 8 levels"), ("other_light", "other light, contrast 10 %")):
        panels.append((title, shaded(seen(name)[1], FACE)))
    draw("noise", [*panels, ("56 px a cycle", shaded(seen("long_period")[1], FACE))], 4)


def draw_motion() -> None:
    """Draw motion during the exposure and between the colours, and a rolling shutter."""
    panels: list[Panel] = []
    titles = {
        "motion_blur": "40 mm during the exposure",
        "color_fields": "2 mm from colour to colour",
        "rolling_shutter": "rolling shutter, colour wheel",
    }
    found = {name: seen(name) for name in titles}
    panels += [(titles[name], as_seen(symptom.image)) for name, (symptom, _) in found.items()]
    for symptom, frame in found.values():
        assert symptom.truth is not None
        panels.append(("error", error_colors(frame, symptom.truth)))
    draw("motion", panels, 3)


def draw_video() -> None:
    """Draw a head that comes nearer, frame by frame, under a plain pattern and under the coded one."""
    panels: list[Panel] = []
    kinds: tuple[tuple[Literal["contrast"] | None, str], ...] = ((None, "plain"), ("contrast", "with the code"))
    for code, title in kinds:
        film = approaching(code, 6)
        decoder, before = Decoder(DecodeSettings(), calibrated(rig(code)), arch="cpu"), None
        for number, truth in enumerate(film):
            before = decoder.decode(np.asarray(truth.image, np.uint8), previous=before)
            if number >= len(film) - 4:
                panels.append((f"{title}, frame {number}", ranges(before, *film)))
    draw("video", panels, 4)


PICTURES: dict[str, Callable[[], None]] = {
    name.removeprefix("draw_"): make for name, make in list(globals().items()) if name.startswith("draw_")
}


def say(names: list[str]) -> Iterator[str]:
    """Yield what the commands say of frames, as the page quotes it."""
    for name in names or (*SYMPTOMS, *SEQUENCES):
        with tempfile.TemporaryDirectory() as folder:
            yield "\n".join([f"<!-- says: {name} -->", "```text", *what_is_said(name, Path(folder)), "```"])


def main() -> None:
    """Draw the pictures, or print what is said."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--say", action="store_true")
    parser.add_argument("names", nargs="*")
    asked = parser.parse_args()
    runtime.init("cpu")
    if asked.say:
        for block in say(asked.names):
            print(block, flush=True)
        return
    warnings.simplefilter("ignore")
    for name in asked.names or PICTURES:
        PICTURES[name]()


if __name__ == "__main__":
    main()
