"""The mechanisms of the decoder that can be switched off one by one, by patching: the product has no option for it.

Each entry names the code that only it needs, and a frame of the scorecard that changes without it, or why none does.
Modules are named by the last part of their names.
"""

import ast
import importlib
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from inspect import getattr_static, getsource
from pathlib import Path
from typing import Any

import numpy as np

from tikernels import runtime
from tikernels._taichi import f32, i32, ti
from tikernels.phase.channel_template import HARMONICS, known_template
from tikernels.phase.phase_vector import absolute_lanes, channel_delays

Original = Any
Replacement = Callable[[Original], Any]


@dataclass(frozen=True)
class Mechanism:
    """One mechanism of the decoder."""

    name: str
    meaning: str
    shows: str  # a frame that changes without it; "": none does
    patches: dict[str, Replacement] = field(repr=False)  # by "module:name": from what is there to what takes its place
    code: str  # modules, "module:name" and "module:Class.name" that only it needs
    promise: str = ""  # what it is for where no figure shows it

    def switch_off(self) -> None:
        """Patch the product, before any kernel is compiled."""
        importlib.import_module("pipeline.decoder")
        for place, replacement in self.patches.items():
            owner, name = located(place)
            original = getattr_static(owner, name)
            new = replacement(original)
            setattr(owner, name, new)
            if callable(original):  # and where it has been imported
                for module in list(sys.modules.values()):
                    if getattr(module, "__name__", "").startswith(("pipeline", "tikernels")):
                        for key in [key for key, value in vars(module).items() if value is original]:
                            setattr(module, key, new)

    def lines(self) -> int:
        """Return how many lines of code only it needs."""
        return sum(lines_of(place) for place in self.code.split())


@cache
def modules() -> dict[str, str]:
    """Return the full name of every module of the decoder by its last part."""
    root = Path(__file__).resolve().parents[2]
    rooms = ("pipeline", *(f"pipeline/{name}" for name in ("decoding", "orders")))
    rooms += tuple(f"tikernels/{name}" for name in ("phase", "unwrapping", "order_evidence"))
    files = [file for room in rooms for file in (root / room).glob("*.py")]
    return {file.stem: ".".join(file.relative_to(root).with_suffix("").parts) for file in files}


def located(place: str) -> tuple[Any, str]:
    """Return the module or class that holds "module:name" or "module:Class.name", and the last name."""
    module, _, name = place.partition(":")
    *owners, last = name.split(".")
    owner: Any = importlib.import_module(modules()[module])
    for part in owners:
        owner = getattr(owner, part)
    if not hasattr(owner, last):
        raise AttributeError(f"{place} is not there: change the table of mechanisms")
    return owner, last


def lines_of(place: str) -> int:
    """Return how many lines a module, or what it defines under a name, has."""
    module, _, name = place.partition(":")
    source = getsource(importlib.import_module(modules()[module]))
    if not name:
        return len(source.splitlines())
    body: list[ast.stmt] = ast.parse(source).body
    for part in name.split("."):
        found = next(node for node in body if getattr(node, "name", None) == part)
        body = getattr(found, "body", [])
    assert found.end_lineno is not None
    return found.end_lineno - found.lineno + 1


# --- what takes a mechanism's place --------------------------------------------------------------------------------


def gives(value: Any) -> Replacement:
    """Return what replaces a function by one that always returns a value, and a constant by the value itself."""
    return lambda original: (lambda *_, **__: value) if callable(original) else value


def nothing(original: Original) -> Any:
    """Replace a function by one that does nothing."""
    return lambda *_, **__: None


def first_argument(original: Original) -> Any:
    """Replace a function by one that returns its first argument."""
    return lambda first, *_, **__: first


def without_memory(original: Original) -> Any:
    """Decode every frame as if it were the first."""
    return lambda self, image, previous=None, out=None: original(self, image, None, out)


def then(change: Callable[[Any], None]) -> Replacement:
    """Return what lets a method run and changes its object afterwards."""

    def replaced(original: Original) -> Any:
        def method(self: Any, *arguments: Any, **named: Any) -> Any:
            result = original(self, *arguments, **named)
            change(self)
            return result

        return method

    return replaced


def setting(**values: Any) -> Callable[[Any], None]:
    """Return what sets attributes of an object."""
    return lambda found: vars(found).update(values)


def with_arguments(**fixed: Any) -> Replacement:
    """Return what calls a function with some arguments fixed."""
    return lambda original: lambda *arguments, **named: original(*arguments, **(named | fixed))


def known_cycle(original: Original) -> Any:
    """Take the template as it is known, and where nothing is, that of sinusoids of full contrast."""

    def fit(self: Any, crosstalk: Any, correction: Any, known: Any, doubt: float, *, fixed: bool = False) -> None:
        if not runtime.to_host(known)[:, 1:].any():
            light = np.exp(1j * channel_delays())[:, None] * np.eye(1, HARMONICS)
            known = known_template(crosstalk.matrix, np.concatenate([np.ones((3, 1)), light / 2], axis=1))
        original(self, crosstalk, correction, known, doubt, fixed=True)

    return fit


def no_light(original: Original) -> Any:
    """Refuse to tell the light."""
    from pipeline.errors import CalibrationError

    def refuse(*_: Any, **__: Any) -> None:
        raise CalibrationError("switched off")

    return refuse


def no_harmonics(original: Original) -> Any:
    """Measure no harmonic of the phase's distribution."""
    return lambda histogram, harmonics=None: original(histogram, 0)


def no_blur(original: Original) -> Any:
    """Take a known response as it is."""
    return lambda self, measured, period_px: (0.0, original(self, measured, period_px)[1])


def no_variance(original: Original) -> Any:
    """Say that all harmonics are certain."""
    return lambda tiles: np.zeros(tiles.shape[1] // 2 + 1)


def first_pass_only(original: Original) -> Any:
    """Find no gains again once the phase is known."""
    return lambda sums, predicted, out: None if predicted else original(sums, predicted, out)


def raw_phase(original: Original) -> Any:
    """Leave the phase as it was fitted."""

    def copied(phase: Any, brightness: Any, precision: Any, out: Any) -> None:
        out[0][...] = phase

    return copied


def still(original: Original) -> Any:
    """Leave a frame's colours where they are."""
    return lambda self, frame, levels, work, memory: (frame.image, None)


def uncut(original: Original) -> Any:
    """Cut no region."""
    return lambda reader, graph, *_: (graph.root.copy(), np.full(len(graph.root), -1))


def unsettled(original: Original) -> Any:
    """Move no patch across a border."""
    from pipeline.orders.border_settling import SettledBorders

    return lambda reader, graph, roots, *_: SettledBorders.none(roots)


def orders_of_this_frame(original: Original) -> Any:
    """Find orders without the frame before."""
    return lambda self, seen, patches, rays, memory: original(self, seen, patches, rays, None)


def no_luck(original: Original) -> Any:
    """Count no piece's freedom to choose where it ends."""
    return lambda self, prior, luck, trust: original(self, prior, 0.0, trust)


def flat_shapes(original: Original) -> Any:
    """Take a part's factor to be the same all over."""

    def shape(place: Any, *_: Any) -> Any:
        return np.pad(np.ones((len(place), 1)), ((0, 0), (0, 3)))

    return staticmethod(shape)


def unflattened(original: Original) -> Any:
    """Leave the contrasts of a part's blocks as they were seen."""
    return lambda self, part, offsets, terms, around, step: np.repeat(part.values[:1, ::step], len(offsets), axis=0)


def no_ripples(original: Original) -> Any:
    """Correct by what the response makes of the contrast alone."""

    def measured(*arguments: Any, **named: Any) -> Any:
        return original(*arguments, **named)._replace(shares=np.array([1, 0, 0], np.float32))

    return measured


def no_slopes(original: Original) -> Any:
    """Take all patches for equally steep."""
    return lambda phase, labels, cells, draft_bits, count: np.zeros((2, count))


def no_model_variance(original: Original) -> Any:
    """Take the model of the light to be right."""
    return lambda precision, *_, **__: np.zeros(precision.shape, np.float32)


def zeros_like_mask(original: Original) -> Any:
    """Return zeros of the size of the first argument."""
    return lambda first, *_, **__: np.zeros(np.shape(first), np.float32)


def nobody(original: Original) -> Any:
    """Find none of the pixels."""
    return lambda misfit, *_: np.zeros(misfit.shape, bool)


def nowhere(original: Original) -> Any:
    """Find none of a lattice's places."""
    return lambda lattice, *_: np.zeros(lattice.contrast.shape, bool)


def flat_contrast(original: Original) -> Any:
    """Take the fringe to be as sharp everywhere."""
    return property(lambda self: np.ones(self.ratios.shape[:2], np.float32))


def of_roots(original: Original) -> Any:
    """Split no region by votes."""
    return lambda votes, graph, known: graph.root


def without_pairs(original: Original) -> Any:
    """Smooth over no neighbour."""
    return lambda pairs, *rest: original(0, *rest)


@ti.func
def never_between(one: ti.template(), other: ti.template()):
    """Never take a pixel to be between two surfaces."""
    return ti.min(one, other, -1.0)


@ti.func
def counts_always(one: ti.template(), other: ti.template(), variance: ti.template()):
    """Count every neighbour that has a phase."""
    return ti.select(ti.max(absolute_lanes(one), absolute_lanes(other)) < 1e3, 0.0 * one + 1.0, 0.0)


@ti.func
def mean_weights(count: f32, squares: f32, fourths: f32):
    """Return the weights of a mean in place of a quadric's."""
    return 1.0 / count, 0.0 * squares


@ti.func
def never_beside(
    phase: ti.template(), rates: ti.template(), labels: ti.template(), final: ti.template(), y: i32, x: i32
) -> i32:
    """Leave no pixel out beside a step."""
    return 0


def ti_function(function: Any) -> Replacement:
    """Return what puts a function of the kernel language in another one's place."""
    return lambda original: function


# --- the table -----------------------------------------------------------------------------------------------------

# fmt: off
_ALL = (
    # The light.
    Mechanism("light learned", "crosstalk and response from the first frame", "plane-skin-2",
        {"decoder:estimate_light": no_light}, "self_calibration"),
    Mechanism("equalisation", "the phases' distribution undoes the response", "bust-skin-1.8",
        {"light_model:measure_correction": no_harmonics}, "equalization:measure_correction"),
    Mechanism("equalisation's tiles", "how far tiles differ weighs the distribution", "bust-skin-1.8",
        {"equalization:_scatter": no_variance}, "equalization:_scatter"),
    Mechanism("known response", "a calibration's response as a prior", "bust-skin-2-all",
        {"light_model:LightModel.__init__": then(setting(_priors=[], _responses=[]))}, "projector_response"),
    Mechanism("response's blur", "the fringe is blurred after a known response", "r-objects",
        {"projector_response:ResponsePrior.fit": no_blur}, "projector_response:ResponsePrior.fit"),
    Mechanism("telling pixels", "dim pixels do not count for the frame's light", "r-dark-beside-bright",
        {"thresholds:_TELLING": gives(0.0)}, ""),
    Mechanism("limit of sigma", "a pixel is valid if its expected sigma is small", "r-dark-beside-bright",
        {"thresholds:_MOST_SIGMA": gives(1e6)}, ""),
    # Surfaces.
    Mechanism("averaged samples", "matrices are fitted to means over pixels along the stripes", "r-objects",
        {"first_look:REACH_PX": gives(0), "surface_misfits:REACH_PX": gives(0)}, ""),
    Mechanism("surfaces", "surfaces of different colours, each with a matrix", "r-objects",
        {"light_model:find_surfaces": gives((None, None))},
        "surface_search first_look surface_labels surface_misfits surface_matrix "
        "surface_colors surface_edges surfaces"),
    Mechanism("new surfaces", "pixels that no surface explains become new ones", "r-objects",
        {"surface_search:SurfaceSearch._add": gives(False)},
        "surface_search:SurfaceSearch._add surface_search:_largest_part"),
    Mechanism("unusual neighbourhoods", "places with more misfit than elsewhere are looked at anew", "r-objects",
        {"surface_labels:_unusual_neighbourhoods": nowhere}, "surface_labels:_unusual_neighbourhoods"),
    Mechanism("only colour acts after", "no search where the only colour acts after the crosstalk", "",
        {"surface_search:_acts_after": gives(False)}, "surface_search:_acts_after",
        promise="saves the search on frames of one colour"),
    Mechanism("surfaces' contrast", "blur takes more of the fringe where it is finer", "r-objects",
        {"first_look:FirstLook.contrast": flat_contrast}, "first_look:FirstLook.contrast"),
    Mechanism("cycles' contrast", "the code changes contrasts cycle by cycle, which are no surfaces", "r-objects-coded",
        {"surface_misfits:_take_off_code": gives(None)}, "surface_misfits:_take_off_code"),
    Mechanism("surfaces' ambient light", "what of a surface's light does not follow the fringe", "r-objects",
        {"first_look:FirstLook.ambient": lambda original: property(lambda self: 0.0)}, "first_look:FirstLook.ambient"),
    Mechanism("surfaces before", "the search begins with the surfaces of the frame before", "",
        {"light_model:LightModel.fit": with_arguments(before=None)}, "",
        promise="films of coloured things take less time"),
    Mechanism("edge variance", "sigma where two surfaces meet", "r-objects",
        {"frame:edge_variance": gives(None)}, "surface_edges",
        promise="sigma within 4 px of edges, which the table leaves out: of a painted board's pixels between two "
        "colours 0.3 % are off by more than six sigma, and 2.3 % without it"),
    # One channel's model.
    Mechanism("second balance", "gains again once the phase is known", "bust-skin-1.8",
        {"color_balance:find_gains_kernel": first_pass_only}, "color_balance:predict_blocks_kernel"),
    Mechanism("ambient light", "the share of the background that does not follow the fringe", "bust-skin-1.8",
        {"channel_model:ChannelModel.recover": then(setting(_share=0.0))}, "channel_model:ambient_at"),
    Mechanism("template", "one cycle of the channels is read off the frame", "bust-skin-1.8",
        {"channel_model:ChannelModel.fit": known_cycle},
        "channel_model:ChannelModel._fit_template channel_model:sum_template_kernel"),
    Mechanism("empty windows", "nodes whose window is cut off take those around", "objects-skin-2",
        {"channel_model:_EMPTY": gives(1000000.0)}, "channel_model:settle_nodes_kernel"),
    Mechanism("sharpness", "how sharp the fringe is from place to place", "r-deep-out-of-focus",
        {"fringe_sharpness:FringeSharpness.refine": gives(False)}, "fringe_sharpness"),
    Mechanism("model fit", "the phase that fits the channels' model best, not the arctangent", "bust-skin-1.8",
        {"phase_fit:_MAX_STEP": gives(1e-09)}, "phase_fit:fitted_step phase_fit:across"),
    Mechanism("contrast's variance", "how far a pixel's contrast may be from its neighbourhood's", "bust-skin-2-coded",
        {"light_model:_PLAIN_DOUBT": gives(0.0), "light_model:_CODED_DOUBT": gives(0.0)}, ""),
    Mechanism("misfit's weight", "pixels that the model does not fit count less", "r-objects",
        {"phase_fit:MAX_MISFIT": gives(1000000000.0), "model_variance:MAX_MISFIT": gives(1000000000.0)},
        "model_variance:divided_by", promise="hot pixels and sparkling highlights, which none of its frames has"),
    Mechanism("camera blur", "the phase is corrected where the brightness changes", "bust-skin-2-blurred",
        {"decoder:undo_camera_blur": raw_phase}, "camera_blur"),
    Mechanism("camera blur's misfit", "sigma of that correction", "r-face",
        {"camera_blur:_DOUBT_PX": gives(0.0)}, ""),
    Mechanism("field motion", "motion between the colours is undone", "film-in-turns",
        {"decoder:Decoder._hold_still": still}, "field_motion decoder:Decoder._hold_still"),
    Mechanism("field motion's second turn", "motion is undone twice", "film-in-turns",
        {"decoder:MOTION_TURNS": gives(1)}, "",
        promise="faster motion than the film's, as in its unit test: 0.4 rad per frame"),
    Mechanism("field motion's misfit", "sigma where motion was undone", "film-in-turns",
        {"decoder:doubt_motion": nothing}, "field_motion:doubt_motion",
        promise="surfaces that speed up or turn; the film's move evenly"),
    # Smoothing.
    Mechanism("smoothing along", "along the stripes", "bust-skin-1.8",
        {"smoothing:_smooth_rows_kernel": without_pairs}, ""),
    Mechanism("smoothing across", "across the stripes", "bust-skin-1.8",
        {"smoothing:_smooth_columns_kernel": without_pairs}, ""),
    Mechanism("smoothing's quadric", "a quadric and not a mean", "bust-skin-1.8",
        {"smoothing:quadric_weights": ti_function(mean_weights)}, "smoothing:quadric_share"),
    Mechanism("smoothing's edges", "neighbours beyond a bend count less", "objects-skin-2",
        {"smoothing:pair_counts": ti_function(counts_always)}, "smoothing:pair_counts"),
    Mechanism("between surfaces", "pixels between two surfaces are left out", "objects-skin-2",
        {"smoothing:between_surfaces": ti_function(never_between)}, "smoothing:between_surfaces"),
    # Sigma.
    Mechanism("model variance", "what the model is wrong by is part of sigma", "bust-skin-1.8",
        {"uncertainty:model_variance": no_model_variance}, "model_variance"),
    Mechanism("window variance", "what the model is wrong by around a place", "bust-skin-1.8",
        {"model_variance:_window_error": zeros_like_mask},
        "model_variance:_window_error model_variance:sum_blocks_kernel"),
    Mechanism("row scatter", "sigma is scaled to what rows differ by", "bust-skin-1.8",
        {"uncertainty:_scatter": gives(1.0)}, "uncertainty:_scatter uncertainty:compare_rows"),
    Mechanism("empty share", "sigma where the balance's window is empty", "objects-skin-2",
        {"uncertainty:_empty_share": zeros_like_mask}, "uncertainty:_empty_share wide_blur",
        promise="sigma at rims, which the table leaves out: 94 % of rendered objects' errors lie within two sigma, "
        "and 90 % without it"),
    # Unwrapping.
    Mechanism("parting", "regions that step along most of a border are parted", "touching",
        {"unwrapper:regions_that_step": nobody}, "region_parting patch_slopes"),
    Mechanism("parting's slopes", "patches of like slopes join first", "touching",
        {"unwrapper:measure_slopes": no_slopes}, "patch_slopes"),
    Mechanism("hidden steps", "cells that must hold a step are left out", "r-grey-objects-coded",
        {"patches:mark_hidden_steps_kernel": nothing}, "hidden_steps"),
    Mechanism("step pixels", "the last pixel before a step is left out", "objects-skin-2",
        {"region_writing:beside_step": ti_function(never_beside)},
        "region_writing:beside_step region_writing:beyond_step"),
    Mechanism("strangers", "pixels cut off from their surface by another's light are left out", "objects-skin-2",
        {"rim_pixels:leave_out_strangers_kernel": nothing},
        "rim_pixels:mark_strangers rim_pixels:is_cut_off rim_pixels:follow_ray rim_pixels:stopped_pixels"),
    Mechanism("rims", "the last pixels of surfaces are left out", "objects-skin-2",
        {"rim_pixels:trim_rims_kernel": nothing}, "rim_pixels:mark_rim rim_pixels:ends_at"),
    Mechanism("rim growing", "surfaces grow into measured pixels at their rims", "objects-skin-2",
        {"decoder:grow_rims": nothing}, "rim_growing"),
    Mechanism("rims' leak", "sigma of pixels at rims next to brighter ones", "r-face",
        {"decoder:doubt_rims": nothing}, "rim_growing:doubt_rims_kernel rim_growing:brightest_beyond"),
    # Orders by the code.
    Mechanism("cutting", "regions that the code contradicts are cut", "pile-small-coded",
        {"coded_orders:cut_regions": uncut}, "region_cutting:cut_regions offset_labelling"),
    Mechanism("cutting's pooling", "patches pool their evidence with their neighbours'", "pile-small-coded",
        {"region_cutting:pool_evidence": first_argument},
        "offset_labelling:pool_evidence"),
    Mechanism("cutting's windows", "windows of several sizes show another offset", "pile-small-coded",
        {"region_cutting:_WINDOWS": gives(np.array([[1, 1]]))},
        "offset_windows:find_other_offsets offset_windows:scan_windows_kernel offset_windows:sum_tables_kernel"),
    Mechanism("rejoining", "pieces with their region's offset are put back", "capture-parcel-coded",
        {"coded_orders:_rejoined": first_argument}, "coded_orders:_rejoined"),
    Mechanism("settling", "patches at a border move to the part that they fit, or are left out", "touching-coded",
        {"coded_orders:settle_borders": unsettled}, "border_settling",
        promise="on 120 piles of `piles.py` a quarter less is wrong and not flagged, of large objects three quarters"),
    Mechanism("nearness", "parts are near the rest rather than anywhere", "pile-small-coded",
        {"coded_orders:log_nearness": lambda original: lambda lacking, offsets: 0.0 * offsets},
        "nearness:nearness nearness:log_nearness"),
    Mechanism("luck", "a piece that was cut off fits the code by chance more often", "pile-small-coded",
        {"code_evidence:PartEvidence.posterior": no_luck}, "",
        promise="a sequence that is not the code's, such as the code's reversed, makes nothing absolute"),
    Mechanism("same surface", "a piece has its region's orders before its own steps count", "pile-small-coded",
        {"posterior:Posterior.beside": first_argument}, "posterior:Posterior.beside"),
    Mechanism("order range", "the projector's picture and the depth range limit the orders", "pile-small-coded",
        {"order_finder:OrderFinder._order_range": gives(None)},
        "order_finder:OrderFinder._order_range posterior:PartRange",
        promise="a depth range determines the orders of plain patterns; none of the frames has one"),
    Mechanism("part's factor", "a part's contrasts have a plane and a share of ambient light in common",
        "pile-small-coded", {"code_evidence:Factor.shape": flat_shapes}, "code_evidence:Factor.shape"),
    Mechanism("flattening", "what surfaces of a part have of their own is taken off", "",
        {"code_evidence:CodeReader._flat": unflattened}, "code_evidence:CodeReader.flattened factor_fit:flatten",
        promise="regions that have joined surfaces"),
    Mechanism("cycles count once", "what is not known of the response all blocks of a cycle share", "pile-small-coded",
        {"code_evidence:OF_CYCLE": gives(1e9)}, "code_evidence:CodeReader._counts",
        promise="of 192 strips of two to four cycles 18 were absolute and wrong without it"),
    Mechanism("code's shift", "the second code is read where it lies, up to a quarter of a cell off", "",
        {"code_evidence:CodeReader._shift_near": gives(0.0)},
        "code_evidence:CodeReader._shift_near code_evidence:CodeReader.shift_anywhere code_evidence:CodeReader.is_far",
        promise="rigs that have moved since their calibration"),
    Mechanism("code's correction", "the phase is corrected by the modulation of its place", "bust-skin-2-coded",
        {"order_finder:correct_by_modulation": nothing}, "modulation_correction modulation"),
    Mechanism("code's ripples", "how much the code bends the phase is measured", "bust-skin-2-coded",
        {"order_finder:measure_ripples": no_ripples}, "modulation:measure_ripples",
        promise="a projector out of focus"),
    Mechanism("guesses", "small parts whose order is a guess are left out", "pile-small-coded",
        {"order_finder:_MIN_GUESSED": gives(0.0)}, ""),
    # The frame before.
    Mechanism("frame before", "everything of the frame before", "film-coded-once",
        {"decoder:Decoder.decode": without_memory}, "carried_orders order_votes"),
    Mechanism("orders before", "orders of the frame before", "film-coded-once",
        {"order_finder:OrderFinder.find": orders_of_this_frame}, "carried_orders order_votes"),
    Mechanism("split by votes", "regions that the frame before saw apart are split", "",
        {"order_finder:split_by_votes": of_roots}, "carried_orders:split_by_votes part_joining",
        promise="surfaces that come to touch in a video, as in none of its films"),
    Mechanism("orders of neighbours", "parts that nothing carries follow what they continue", "",
        {"carried_orders:CarriedOrders.with_neighbours": first_argument},
        "carried_orders:CarriedOrders.with_neighbours",
        promise="surfaces in a video that move too far to be recognised, as in none of its films"),
    Mechanism("certainty before", "orders that were certain before are certain now", "film-coded-once",
        {"order_finder:with_frame_before": first_argument}, "order_finder:with_frame_before posterior:Posterior.after"),
)
# fmt: on
#: Every mechanism by name.
MECHANISMS = {mechanism.name: mechanism for mechanism in _ALL}
