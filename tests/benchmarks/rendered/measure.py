"""Measure decoding on rendered frames, and write their tables to docs/studies.md.

    python tests/benchmarks/rendered/measure.py [--cache FOLDER] [--print] [SECTION ...]

Frames are rendered once and kept in FOLDER (a folder of the user's cache if none is given), so that measuring again
takes the time of decoding. Rendering needs the extra `rendered`, and libLLVM beside it.
"""

import argparse
from collections.abc import Callable, Iterable, Iterator
from datetime import date
from itertools import combinations
from pathlib import Path

import numpy as np
from camera_film import Optics, Sensor
from decoding_cases import KNOWN, Case, Judged, study, study_orders, with_gamma
from judgement import Verdict
from page_parts import write_part
from rendered_scenes import scenes
from spectra import INDUSTRIAL, LAMP, LED, PHOTOGRAPHIC, effective_matrix
from studio import Rig, Studio

from tikernels import runtime
from tikernels.phase.crosstalk import invert_crosstalk

# The truth may be off by this, rad, before anything is measured against it.
_TRUE_RAD = 0.0005
_HEADINGS = (
    "scene", "surface", "pattern", "known", "bands", "mosaic", "RMS", "RMS inside", "constant", "harmonics 1, 2, 3",
    "with noise: RMS inside", "constant", "error over sigma", "within two",
)  # fmt: skip
_ALL = "all"
# Scenes under a compensated pattern, under the contrast code, and under every light.
_COMPENSATED = ("plane", "grey_face", "face", "face_alone", "objects", "grey_objects", "board")
_CODED = ("plane", "grey_face", "face", "grey_objects", "objects", "board", "corner", "lying_corner", "deep")
_WITH_EVERY_RIG = ("plane", "face", "objects")
_RIGS = (
    ("lamp, industrial filters", Rig(LAMP.name), Sensor()),
    ("LED, photographic filters", Rig(camera=PHOTOGRAPHIC.name), Sensor()),
    ("lamp, photographic filters", Rig(LAMP.name, PHOTOGRAPHIC.name), Sensor()),
    ("LED, 12 bits", Rig(), Sensor(bits=12)),
    ("LED, Bayer", Rig(), Sensor(mosaic=True)),
    ("lamp, Bayer, 12 bits", Rig(LAMP.name), Sensor(bits=12, mosaic=True)),
    *((f"LED, gamma {gamma}", with_gamma(Rig(), gamma), Sensor()) for gamma in (1.0, 1.4, 1.8, 2.3)),
)


def main() -> None:
    """Measure what was asked for; write the page if that is everything."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("section", nargs="*", choices=[*SECTIONS, []], help=f"of {', '.join(SECTIONS)}; none: all")
    parser.add_argument("--cache", type=Path, help="where rendered frames are kept")
    parser.add_argument("--print", action="store_true", help="print the tables and leave the page as it is")
    arguments = parser.parse_args()
    runtime.init("cpu")
    studio = Studio(arguments.cache)
    off = truth_error(studio)
    if off > _TRUE_RAD:
        raise SystemExit(f"the truth is off by {off:.5f} rad: the renderer is wrong, nothing is measured")
    render(studio)
    parts = [_INTRODUCTION.format(date=date.today())]
    for name in arguments.section or SECTIONS:
        part = "\n".join(SECTIONS[name](studio)) + "\n"
        print(part, flush=True)
        parts.append(part)
    if not (arguments.print or arguments.section):
        write_part("rendered frames", "\n".join(parts))


def render(studio: Studio) -> None:
    """Render what is not there yet, scene by scene: its rays are followed once for all patterns and lights."""
    for taken_with in {rig for _, rig, _ in _RIGS}:
        studio.calibration(taken_with)
    for name in scenes():
        patterns = ["plain"]
        patterns += ["compensated"] * (name in _COMPENSATED)
        patterns += ["coded"] * (name in _CODED)
        for pattern in patterns:
            studio.exposure(name)
            studio.light(name, pattern)
        for taken_with in {rig for _, rig, _ in _RIGS} if name in _WITH_EVERY_RIG else ():
            studio.exposure(name, taken_with)
            studio.light(name, "plain", taken_with)


def truth_error(studio: Studio) -> float:
    """Return the largest error, rad, of the plain arctangent on ideal fringes on a white plane, against the truth."""
    ideal = Rig(optics=Optics(gamma=1.0, ambient=0.0, point=True))
    light = studio.light("plane", "plain", ideal)
    truth = studio.truth("plane")
    primaries = light @ invert_crosstalk(effective_matrix(LED, INDUSTRIAL)).T
    red, green, blue = np.moveaxis(primaries, -1, 0)
    phase = np.arctan2(np.sqrt(3) * (red - blue), 2 * green - red - blue)
    true = 2 * np.pi / studio.geometry.pattern.period_px * truth.projector_row
    return float(np.abs(np.angle(np.exp(1j * (phase - true))))[truth.lit].max())


# --- rows --------------------------------------------------------------------------------------------------------


def table(headings: Iterable[str]) -> list[str]:
    """Return the first two lines of a table."""
    headings = list(headings)
    return ["| " + " | ".join(headings) + " |", "|" + "---|" * len(headings)]


def row(result: Judged, surface: str, scene: str | None = None) -> str:
    """Return a row of the standard table."""
    case, clean, noisy = result.case, result.clean[surface], result.noisy.get(surface)
    cells = [
        (scene or case.scene.replace("_", " ")) + (", undone" if case.before else ""),
        surface,
        case.pattern,
        case.known,
        case.bands or "found",
        "yes" if case.sensor.mosaic else "no",
        f"{clean.rms:.4f}",
        f"{clean.rms_inside:.4f}",
        f"{clean.constant_inside:+.4f}",
        ", ".join(f"{wave:.3f}" for wave in clean.harmonics),
    ]
    if noisy is None:
        cells += ["-"] * 4
    else:
        cells += [f"{noisy.rms_inside:.4f}", f"{noisy.constant_inside:+.4f}", f"{noisy.pull:.2f}"]
        cells += [f"{noisy.within_two:.2f}"]
    return "| " + " | ".join(cells) + " |"


def rows(cases: Iterable[Case], studio: Studio, surfaces: Callable[[Case, Verdict], bool]) -> Iterator[str]:
    """Yield the rows of cases, of those surfaces that are to be shown."""
    for case in cases:
        result = study(case, studio)
        for name, verdict in result.clean.items():
            if surfaces(case, verdict):
                yield row(result, name)


def knowledge(scene: str, **more) -> list[Case]:
    """Return a scene under both patterns with all that may be known of each."""
    plain = [Case(scene, "plain", known, **more) for known in KNOWN]
    return [*plain, *(Case(scene, "compensated", known, **more) for known in (KNOWN[0], KNOWN[-1]))]


# --- sections ----------------------------------------------------------------------------------------------------


def gray_and_painted(studio: Studio) -> Iterator[str]:
    """Yield plane and faces."""
    yield "### A plane and faces\n"
    yield from table(_HEADINGS)
    for scene in ("plane", "grey_face", "face", "face_alone"):
        yield from rows(knowledge(scene), studio, lambda case, verdict: True)


def colors(studio: Studio) -> Iterator[str]:
    """Yield coloured objects and the board."""
    yield "### Coloured objects, and a flat board of six colours\n"
    yield from table(_HEADINGS)
    for scene in ("objects", "grey_objects", "board"):

        def shown(case: Case, verdict: Verdict) -> bool:
            whole = case.scene == "grey_objects" or case.pattern != "plain" or case.known == "matrix"
            return verdict.surface == _ALL or not whole

        yield from rows(knowledge(scene), studio, shown)


def narrow_bands(studio: Studio) -> Iterator[str]:
    """Yield what it costs to fix where the surfaces' colours act."""
    yield "### Surface colour before or after the crosstalk\n"
    yield "The setting `reflectance_bands` fixes where a surface's colour acts; all other tables have it found.\n"
    yield from table(_HEADINGS)
    for scene in ("plane", "face", "objects", "board"):
        cases = [Case(scene, known=KNOWN[-1], bands=bands) for bands in ("broad", "narrow")]
        yield from rows(cases, studio, lambda case, verdict: True)


def board_steps(studio: Studio) -> Iterator[str]:
    """Yield how flat one board of six colours comes out."""
    yield "### Steps between the colours of one flat board\n"
    yield from table(("pattern", "known", "bands", "largest step, rad", "between", "step, mm", "constant sigma, rad"))
    taken = [Case("board", known=KNOWN[-1], bands=bands) for bands in ("broad", "narrow")]
    for case in [*knowledge("board"), *taken]:
        result = study(case, studio)
        constants = {name: verdict.constant_inside for name, verdict in result.clean.items() if name != _ALL}
        most = max(combinations(constants, 2), key=lambda pair: abs(constants[pair[0]] - constants[pair[1]]))
        step = abs(constants[most[0]] - constants[most[1]])
        per_rad = float(np.nanmedian(np.abs(studio.truth("board").mm_per_rad)))
        yield (
            f"| {case.pattern} | {case.known} | {case.bands or 'found'} | {step:.3f} | {most[0]}, {most[1]} "
            f"| {step * per_rad:.2f} | {result.constant_sigma:.3f} |"
        )


def other_light(studio: Studio) -> Iterator[str]:
    """Yield what light does besides bouncing once off something matt, and motion."""
    yield "### Corners, gloss, depth of focus, motion\n"
    names = ("corner", "lying_corner", "colored_corner", "gloss", "dark_beside_bright", "deep", "deep_out_of_focus",
             "moving", "in_turns_still", "in_turns")  # fmt: skip
    yield from (f"- *{name.replace('_', ' ')}*: {scenes()[name].notes}" for name in names)
    yield "- *undone*: by `fields` and the frame before"
    yield ""
    yield from table(_HEADINGS)
    for name in names:
        cases = [Case(name, known=known) for known in (KNOWN[0], KNOWN[-1])]
        yield from rows(cases, studio, lambda case, verdict: not verdict.surface.startswith("plate"))
    undone = [Case("in_turns", known=known, before="in_turns_before") for known in (KNOWN[0], KNOWN[-1])]
    yield from rows(undone, studio, lambda case, verdict: True)


def other_rigs(studio: Studio) -> Iterator[str]:
    """Yield other projectors, cameras, sensors and responses."""
    yield "### Other projectors, cameras and sensors\n"
    yield from table(("rig", *_HEADINGS))
    for name, taken_with, sensor in _RIGS:
        for scene in _WITH_EVERY_RIG:
            cases = [Case(scene, known=known, sensor=sensor, rig=taken_with) for known in (KNOWN[0], KNOWN[-1])]
            shown = _ALL if scene == "objects" else scene
            for line in rows(cases, studio, lambda case, verdict, shown=shown: verdict.surface == shown):
                yield f"| {name} {line}"


def worth_of_calibration(studio: Studio) -> Iterator[str]:
    """Yield whether a calibration makes it better."""
    yield "### A calibration against none\n"
    yield "RMS inside, rad, with constant and noise. Ratio: matrix and response over nothing known.\n"
    yield from table(("scene", "pattern", "mosaic", "nothing known", "matrix", "matrix and response", "ratio"))
    names = [name for name, scene in scenes().items() if not name.startswith("in_turns")]
    for name in names:
        for pattern in ("plain", "compensated") if name in _COMPENSATED else ("plain",):
            found = []
            for known in KNOWN:
                noisy = study(Case(name, pattern, known), studio).noisy
                found.append((noisy.get(_ALL) or next(iter(noisy.values()))).rms_inside_with_constant)
            figures = " | ".join(f"{value:.4f}" for value in found)
            yield f"| {name.replace('_', ' ')} | {pattern} | no | {figures} | {found[2] / found[0]:.2f} |"


def orders(studio: Studio) -> Iterator[str]:
    """Yield what the contrast code tells."""
    yield "### Absolute orders under the contrast code\n"
    yield "Shares of the pixels that RMS counts, with noise.\n"
    yield from table(("scene", "known", "mosaic", "decoded", "absolute and right", "absolute and wrong"))
    for name in _CODED:
        for known in (KNOWN[0], KNOWN[-1]):
            found = study_orders(Case(name, "coded", known), studio)
            yield (
                f"| {name.replace('_', ' ')} | {known} | no | {found.decoded:.4f} | {found.absolute:.4f} "
                f"| {found.wrong:.5f} |"
            )


SECTIONS: dict[str, Callable[[Studio], Iterator[str]]] = {
    "surfaces": gray_and_painted,
    "colors": colors,
    "narrow": narrow_bands,
    "board": board_steps,
    "light": other_light,
    "rigs": other_rigs,
    "calibration": worth_of_calibration,
    "orders": orders,
}

_INTRODUCTION = """\
## Rendered frames

`python tests/benchmarks/rendered/measure.py`, {date}. It needs the extra `rendered`.

Scenes are rendered from spectra in steps of 1 nm, unless a row names another rig:

| | |
|---|---|
| camera | 640x480, focal length 1.9 image widths, blur 0.5 px, filters of an industrial sensor |
| projector | 1024x768, 44 cycles in view, LEDs, gamma 2, blur 0.6 px, 180 mm beside the camera |
| object | 900 mm away; 12 px per cycle; about 7 mm of depth per rad; ambient light 3 % of the projector's white |
| noise | 8 bits, full well 10,000 electrons, read noise 5 electrons, pedestal 2 %; noise-free frames have 16 bits |
| settings | default, true geometry; *known* is what `colorphase calibrate radiometry` finds on rendered ramps |
| pattern | *compensated*: the projector's response is undone in the pattern, and the decoder knows that |
| pixels | mean over their area; *mosaic*: whether the frame passed through a Bayer mosaic |

| column | meaning |
|---|---|
| RMS | phase error, rad, one constant removed, over pixels brighter than 20 of 255 and 4 px inside the lit area |
| RMS inside | the same, also 4 px from borders of surfaces; all columns to its right are over these pixels |
| constant | the mean error, rad |
| harmonics | amplitudes, rad, of the error's components that repeat once, twice and three times per cycle |
| error over sigma | RMS of the error over its own standard deviation; *within two*: share of errors below two of them |

Surfaces of fewer than 2,000 pixels are omitted.
"""

if __name__ == "__main__":
    main()
