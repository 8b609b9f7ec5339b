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
from support.picture_sheet import Panel, Picture, enlarged, write_sheet
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
from pipeline.output.background import object_pixels
from pipeline.output.pictures.picture_overlay import ColorScale
from pipeline.output.range_image import depth_colors, shade_frame, with_color_bar
from pipeline.simulation import SimulatedFrame
from tikernels import runtime
from tikernels.raw.development import develop
from tikernels.raw.linearization import linearize

_PAGE = Path(__file__).resolve().parents[2] / "docs" / "troubleshooting"
# Half of a page's width is then as many pixels as a screen has there.
_PANEL_PX, _COLUMNS = 340, 2
_ERROR = ColorScale(-0.3, 0.3, "error", "rad", diverging=True)  # of all pictures of errors
#: The rows and columns that a panel shows of a frame, px.
WHOLE = np.s_[:, :]
FACE = np.s_[120:330, 210:490]
DETAIL = np.s_[150:270, 240:400]


def as_seen(image: Picture, part: Any = WHOLE) -> Picture:
    """Return a part of a frame of linear light as a display shows it."""
    return np.asarray(255 * (image[part] / 255) ** (1 / 2.2), np.uint8)


def error_colors(frame: DecodedFrame, truth: SimulatedFrame, part: Any = WHOLE) -> Picture:
    """Return the error of the phase, a constant removed, with its scale."""
    error = np.angle(np.exp(1j * (frame.wrapped_phase - truth.phase)))
    error -= np.nanmedian(error)
    return colored(error.astype(np.float32), frame.mask & truth.mask, _ERROR, part)


def colored(values: npt.NDArray[np.float32], mask: npt.NDArray[np.bool_], scale: ColorScale, part: Any) -> Picture:
    """Return a part of a field as large as a panel, with its scale."""
    return with_color_bar(enlarged(depth_colors(values, mask, scale)[part], _PANEL_PX), scale)


def shaded(frame: DecodedFrame, part: Any = WHOLE) -> Picture:
    """Return a surface as `shaded.png` shows it, and of a part only that part's relief."""
    return shade_frame(frame)[part]


def ranges(frame: DecodedFrame, *truths: SimulatedFrame, part: Any = WHOLE) -> Picture:
    """Return a range image as `range.png` shows it, in the colours of the true depths where these are given."""
    values, shown = frame.range_image, frame.mask & np.isfinite(frame.range_image)
    if truths:
        depths_mm = np.concatenate([truth.points[..., 2][truth.mask] for truth in truths])
        near, far = np.percentile(depths_mm, (1, 99)).tolist()
        scale = ColorScale(near - 25.0, far + 25.0, "depth", "mm")
    else:
        known = object_pixels(values, shown) if frame.calibrated else shown
        name = "depth" if frame.calibrated else "range"
        scale = ColorScale.over(values[known], name, frame.range_unit, grey_beyond=not np.array_equal(known, shown))
    return colored(values, shown, scale, part)


def seen(name: str) -> tuple[Symptom, DecodedFrame]:
    """Return a symptom and what decoding makes of it."""
    symptom = SYMPTOMS[name]()
    return symptom, symptom.decode()


def draw(name: str, panels: list[Panel]) -> None:
    """Write panels into the page's folder, two in a row."""
    large = [
        (words, picture if len(picture) == _PANEL_PX else enlarged(picture, _PANEL_PX)) for words, picture in panels
    ]
    write_sheet(_PAGE / f"{name}.jpg", large, _COLUMNS)


def draw_nothing_measured() -> None:
    """Draw frames of which nothing is measured."""
    titles = {
        "dark": "too dark",
        "no_pattern": "no pattern",
        "vertical": "stripes the other way",
        "too_fine": "3 px per cycle",
    }
    draw("nothing_measured", [(title, as_seen(SYMPTOMS[n]().image, DETAIL)) for n, title in titles.items()])


def draw_holes() -> None:
    """Draw highlights and a frame that is over-exposed."""
    panels: list[Panel] = []
    for name, title in (("gloss", "highlights"), ("over_exposed", "over-exposed")):
        symptom, frame = seen(name)
        assert symptom.truth is not None
        panels += [(title, as_seen(symptom.image, FACE)), ("depth", ranges(frame, part=FACE))]
    draw("holes", panels)


def draw_ripple() -> None:
    """Draw ripple once, twice and three times a cycle, with the error next to it."""
    symptoms = {
        "frame, as it should be": one_fault(scene="waves"),
        "over-exposed: once per cycle, and more": one_fault(scene="waves", exposure=2.2),
        "crosstalk: twice per cycle": SYMPTOMS["crosstalk"](),
        "transfer: three times per cycle": SYMPTOMS["transfer"](),
    }
    panels: list[Panel] = []
    for title, symptom in symptoms.items():
        frame = symptom.decode()
        assert symptom.truth is not None
        first = shaded(frame, DETAIL) if panels else as_seen(symptom.image, DETAIL)
        panels += [(title, first), ("its error", error_colors(frame, symptom.truth, DETAIL))]
    draw("ripple", panels)


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
            ("a plain pattern, taken for a coded one", as_seen(other.image)),
            ("depth", ranges(floating, coded.truth)),
            ("depth", ranges(mistaken, bust.truth)),
            ("depth with the code", ranges(coded.decode(), coded.truth)),
            ("depth with the code", ranges(bust.decode(), bust.truth)),
        ],
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
            ("frame, mirrored", as_seen(mirrored.image)),
            ('range, projector_side = "below"', ranges(inside_out)),
            ("its surface, mirrored, too", shaded(mirrored.decode())),
            ("range, as it should be", ranges(right)),
            ("surface, as it should be", shaded(good.decode())),
        ],
    )


def draw_geometry() -> None:
    """Draw depth along a column: of a plane after the projector was moved, and of a ball with a wrong scale."""
    figure, axes = plt.subplots(1, 2, figsize=(10.5, 4), layout="constrained")
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
        axis.set_title(title)
        axis.set_xlabel("row of the camera, px")
        axis.set_ylabel("depth, mm")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=2, frameon=False)
    figure.savefig(_PAGE / "geometry.jpg", dpi=100, pil_kwargs={"quality": 84, "optimize": True, "subsampling": 0})
    plt.close(figure)


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
        panels.append((title, as_seen(symptom.image, shown)))
        panels.append(("its error", error_colors(symptom.decode(), symptom.truth, shown)))
    draw("edges", panels)


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
    draw("noise", [*panels, ("56 px per cycle", shaded(seen("long_period")[1], FACE))])


def draw_motion() -> None:
    """Draw motion during the exposure and between the colours, and a rolling shutter."""
    panels: list[Panel] = []
    titles = {
        "motion_blur": "40 mm during the exposure",
        "color_fields": "2 mm from colour to colour",
        "rolling_shutter": "rolling shutter, colour wheel",
    }
    for name, title in titles.items():
        symptom, frame = seen(name)
        assert symptom.truth is not None
        panels += [(title, as_seen(symptom.image)), ("its error", error_colors(frame, symptom.truth))]
    draw("motion", panels)


def draw_video() -> None:
    """Draw a head that comes nearer, frame by frame, under a plain pattern and under the coded one."""
    shown: dict[str, list[Picture]] = {}
    kinds: tuple[tuple[Literal["contrast"] | None, str], ...] = ((None, "plain"), ("contrast", "with the code"))
    for code, title in kinds:
        film = approaching(code, 6)
        decoder, before = Decoder(DecodeSettings(), calibrated(rig(code)), arch="cpu"), None
        for truth in film:
            before = decoder.decode(np.asarray(truth.image, np.uint8), previous=before)
            shown.setdefault(title, []).append(ranges(before, *film))
    draw("video", [(f"{title}, frame {number}", shown[title][number]) for number in range(2, 6) for title in shown])


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
