"""The whole cycles of every region of a frame: by the pattern's code, the frame before, or the expected depth.

`find` combines all evidence and returns where regions are to be split and what their offsets are, `region_orders`
returns the state of each region, and `refine` uses a code that is known now: it corrects the phase by each cycle's
modulation.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipeline.calibration import Geometry
from pipeline.causes import Cause
from pipeline.contrast_code import ContrastCode
from pipeline.decoding.buffers import SurfaceBuffers
from pipeline.decoding.doubts import CODE_CONTRAST
from pipeline.decoding.frame import CameraRays, FrameMemory, RegionOrders
from pipeline.errors import CalibrationError
from pipeline.orders.carried_orders import MAX_CARRIED_ERROR, CarriedOrders, choose_motion, count_votes, split_by_votes
from pipeline.orders.code_blocks import change_by_cycle, read_blocks
from pipeline.orders.coded_orders import CodedOrders, find_absolute_orders
from pipeline.orders.modulation import measure_ripples
from pipeline.orders.posterior import MAX_ABSOLUTE_ERROR, NOTHING_KNOWN, AbsoluteOrders, OrderRange
from pipeline.orders.stripe_columns import StripeColumns
from tikernels import runtime
from tikernels.arrays import F32, LevelsImage
from tikernels.order_evidence import correct_by_modulation, measure_contrast, vote_orders
from tikernels.order_evidence.order_votes import BEFORE
from tikernels.phase.color_balance import Gains
from tikernels.phase.crosstalk import Crosstalk
from tikernels.phase.equalization import modulation_tables
from tikernels.unwrapping.patches import MIN_REGION_PX, Patches, PatchGraph, RegionTable

# Where more of the surface than this does not fit into the depth range, the range is not believed.
_MAX_OUT_OF_RANGE = 0.02
# With a code, the share of pixels without an absolute order from which the user is warned.
_MAX_LOST = 0.02
# Where a code that is not stated places more than this share of the pixels, the frame shows it.
_MIN_CODED = 0.5
# Drop parts that are a smaller share of the frame and whose likeliest order is wrong with a higher probability: their
# depth would be arbitrary, as of a nose's tip that its shadow cuts off.
_MIN_GUESSED, _MAX_GUESS = 0.01, 0.5
# Patterns have some hundreds of cycles; float32 resolves the phase of this many to a hundredth of a radian.
_MOST_CYCLES = 1e4
# At least one part in as many is not the surface that the previous frame saw there, whatever the votes are.
_LEAST_CARRIED_ERROR = 1e-3

_CODE_NOT_SEEN = Cause(
    "code not seen",
    'the frame does not show the contrast code: project what colorphase pattern makes, or set code = "none" '
    "(--code none)",
)
_CODE_TOO_WEAK = Cause("code too weak", "the contrast code cannot be read in this frame")
_OUT_OF_RANGE = (
    "{:.0%} of the surface fits at no order into the depth range of {:g} to {:g} mm, which therefore determines none: "
    "give the range of all that is in view"
)
_OTHER_SCENE = Cause("other scene", "nothing of the frame before is seen again: the orders start afresh")


@dataclass(frozen=True, eq=False)
class SeenPhase:
    """The phase of a frame whose orders are searched; on the device, stripes along the rows."""

    image: LevelsImage  # (H, W, 3) linear light
    gains: Gains  # of the colour balance
    crosstalk: Crosstalk  # what they were measured with
    phase: F32  # (H, W) rad, smoothed along the stripes
    modulation: F32  # (H, W) levels
    rates: F32  # of `measure_rates`
    correction: npt.NDArray[np.float32]  # (N,) rad, the response's, over a cycle
    period_px: float
    contrast: float  # of the fringe: its mean modulation over its mean background
    noise: float  # standard deviation of a channel, levels


@dataclass(frozen=True, eq=False)
class Placement:
    """A frame's orders by its evidence, and warnings about them."""

    roots: npt.NDArray[np.int32] | None  # (P,) where regions are split: the patch that represents each patch's part
    orders: AbsoluteOrders | None  # by all evidence: a code, the depth range and the previous frame
    carried: CarriedOrders | None  # by the frame before, absolute or not
    coded: bool  # whether a code determines them
    left_out: npt.NDArray[np.bool_] | None  # (P,) patches of specks that nothing places, and torn ones
    warning: Cause | None  # what the user should know
    shift_px: float | None = None  # the code's shift along the stripe, projector px; None: unknown

    def offsets(self) -> tuple[npt.NDArray[np.integer], npt.NDArray[np.integer]]:
        """Return the roots of regions, and the whole cycles to add to their orders; later ones overrule earlier ones.

        These are the likeliest offsets by the code, those of the frame before, and those that are almost certain. Of
        what the depth range alone leaves possible, the order nearest its middle stays.
        """
        named = []
        if self.orders is not None:
            likeliest = self.orders.offsets
            errors = self.orders.error_probability(likeliest)
            placed, sure = errors < (1 if self.coded else 0), errors < MAX_ABSOLUTE_ERROR
            named = [(self.orders.parts[which], likeliest[which]) for which in (placed, sure)]
        if self.carried is not None:
            named.insert(1, (self.carried.roots, self.carried.offsets))
        none = np.zeros((2, 0), np.int64)
        roots, offsets = np.concatenate([none, *named], axis=1)
        return roots, offsets

    def region_orders(self, patches: Patches, regions: RegionTable, memory: FrameMemory | None) -> RegionOrders:
        """Return of every region whether its orders are absolute, and how probably they are not.

        Parameters
        ----------
        patches : Patches
            With these offsets added to their orders.
        regions : RegionTable
            The regions that were written.
        memory : FrameMemory, optional
            Of the frame that `carried` comes from.
        """
        roots = regions.roots
        errors = np.append(np.nan, np.ones(len(roots)))
        most = np.full(len(roots) + 1, MAX_ABSOLUTE_ERROR)
        change = np.zeros((len(roots) + 1, 3), np.float32)
        if self.orders is not None and len(self.orders.parts):
            by_part = self.orders.error_probability(patches.orders(self.orders.parts).astype(np.int64))
            part = np.minimum(np.searchsorted(self.orders.parts, roots), len(by_part) - 1)
            errors[1:] = np.where(self.orders.parts[part] == roots, by_part[part], 1.0)
        if memory is not None and self.carried is not None:
            goes_on = np.isin(roots, self.carried.roots)
            found, number = np.searchsorted(self.carried.roots, roots[goes_on]), 1 + np.flatnonzero(goes_on)
            change[number] = self.carried.change[found]
            most[number[memory.orders.known[self.carried.before[found]]]] = MAX_CARRIED_ERROR
        return RegionOrders(np.nan_to_num(errors, nan=1.0) < most, errors.astype(np.float32), change)


def with_frame_before(
    absolute: AbsoluteOrders | None, carried: CarriedOrders | None, before: RegionOrders | None
) -> AbsoluteOrders | None:
    """Let the orders of the frame before, as far as they were sure there, count as evidence of their parts' orders now.

    Parameters
    ----------
    absolute : AbsoluteOrders, optional
        Orders by this frame alone.
    carried : CarriedOrders, optional
        Its orders carried from the previous frame.
    before : RegionOrders, optional
        Those of the previous frame.
    """
    if carried is None or before is None:
        return absolute
    stays = (1 - before.error_probability[carried.before].astype(np.float64)) * (1 - carried.error_probability)
    went_on = stays > 0
    if not went_on.any():
        return absolute
    errors = np.maximum(1 - stays, _LEAST_CARRIED_ERROR)
    posteriors = {} if absolute is None else dict(zip(absolute.parts.tolist(), absolute.posteriors, strict=True))
    for root, offset, error in zip(carried.roots[went_on], carried.offsets[went_on], errors[went_on], strict=True):
        posteriors[int(root)] = posteriors.get(int(root), NOTHING_KNOWN).after(int(offset), float(error))
    parts = np.array(sorted(posteriors), np.int64)
    return AbsoluteOrders(parts, tuple(posteriors[part] for part in parts.tolist()))


class OrderFinder:
    """Give the regions of frame after frame their orders.

    Parameters
    ----------
    code : ContrastCode or None
        The pattern's; it may be set later.
    geometry : Geometry, optional
        The rig's; with it, the depth limits the orders.
    depth_range_mm : (2,) float, optional
        Depths that surfaces may have.

    Raises
    ------
    CalibrationError
        The object's distance is unknown.
    """

    def __init__(
        self,
        code: ContrastCode | None,
        geometry: Geometry | None,
        depth_range_mm: tuple[float, float] | None,
    ) -> None:
        self.code = code
        self._columns: StripeColumns | None = None
        self._geometry = geometry
        self._depth_range_mm = depth_range_mm
        #: Where the object is expected, mm; regions that nothing places are put nearest to it.
        self.expected_depth_mm = None if geometry is None else _expected_depth(geometry, depth_range_mm)
        if geometry is not None and self.expected_depth_mm is not None:
            _check_view(geometry, self.expected_depth_mm, stated=depth_range_mm is not None)

    def find(self, seen: SeenPhase, patches: Patches, rays: CameraRays | None, memory: FrameMemory | None) -> Placement:
        """Find where the evidence contradicts regions, and which offsets it names.

        Parameters
        ----------
        seen : SeenPhase
            The frame.
        patches : Patches
            Its patches, joined to regions.
        rays : CameraRays, optional
            With a calibration.
        memory : FrameMemory, optional
            Of the frame before.
        """
        roots, absolute, carried, warning, left_out = None, None, None, None, None
        found: CodedOrders | None = None
        if self.code is not None:
            graph = patches.graph()
            found = self._find_absolute(seen, patches, graph, self._order_range(seen, graph, rays), rays)
            absolute, roots = found.absolute, found.roots
            patches.shift_orders(found.shifts)
            left_out = found.torn
            if found.readable is False:
                warning = _CODE_TOO_WEAK if seen.contrast < CODE_CONTRAST else _CODE_NOT_SEEN
                if found.shift_px is not None:
                    # What was absolute before the rig moved is so no more.
                    warning, memory = _moved(found.shift_px), None
        if memory is not None:
            change = memory.orders.change
            before = (memory.surface.unwrapped, memory.surface.region)
            votes, places = vote_orders(seen.phase, patches, *before, change)
            constant, along, across = change[votes[:, BEFORE]].T / (2 * np.pi)
            expected = constant + along * places[1] + across * places[0]
            # What a code has split it knows better.
            parts = split_by_votes(votes, patches.graph(), memory.orders.known) if roots is None else roots
            votes, taken_with = choose_motion(votes, parts, expected)
            carried = count_votes(votes, parts, taken_with, expected).with_change(votes, parts, taken_with, places)
            if roots is None and carried.same_scene:
                if patches.beside is not None:
                    carried = carried.with_neighbours(parts, patches.beside)
                roots = parts
            warning = warning if carried.same_scene else _OTHER_SCENE
        if found is not None and found.readable:
            unknown = found.absolute.parts[found.absolute.error_probability(found.absolute.offsets) > _MAX_GUESS]
            unknown = unknown[~np.isin(unknown, [] if carried is None else carried.roots)]
            share = np.bincount(found.roots, graph.pixels, len(graph.pixels)) / np.prod(patches.shape)
            left_out = found.torn | np.isin(found.roots, unknown[share[unknown] < _MIN_GUESSED])
        if found is None and self._depth_range_mm is not None:
            absolute, out_of_range = self._place_by_depth(seen, patches.graph(), roots, rays)
            warning = warning or out_of_range
        orders = with_frame_before(absolute, carried, None if memory is None else memory.orders)
        shift_px = None if found is None or self.code is None or self.code.cell_px is None else found.shift_px
        return Placement(roots, orders, carried, found is not None, left_out, warning, shift_px)

    def refine(
        self,
        seen: SeenPhase,
        raw: F32,
        regions: RegionTable,
        orders: RegionOrders,
        shift_px: float | None,
        out: SurfaceBuffers,
    ) -> tuple[bool, Cause | None]:
        """With a code, correct the phases by the modulation that their places have.

        Parameters
        ----------
        seen : SeenPhase
            The frame.
        raw : (H, W) float32
            rad, the phase before it was smoothed, which is corrected.
        regions, orders
            Its regions, written to `out`, and what is known of them.
        shift_px : float, optional
            By how many projector px the code lies off along the stripe.
        out : SurfaceBuffers
            The frame's.

        Returns
        -------
        bool
            True if anything was corrected.
        Cause or None
            A warning for the user.
        """
        if self.code is None:
            return False, None
        known, corrected = orders.known, False
        if known.any():
            ripples = measure_ripples(
                raw,
                out.unwrapped,
                out.region,
                known,
                within=modulation_tables(seen.correction),
                period_px=seen.period_px,
                code=self.code,
                columns=None if self._columns is None else self._columns.shifted(shift_px or 0.0),
            )
            correct_by_modulation(out.region, out.unwrapped, known, ripples, out=raw)
            corrected = True
        lost = float(regions.pixels[~known[1:]].sum() / max(regions.pixels.sum(), 1))
        if lost > _MAX_LOST:
            text = f"{lost:.0%} of the pixels show too little of the code, or contradict it: their order is a guess"
            return corrected, Cause("orders guessed", text)
        return corrected, None

    def shows_a_code(self, seen: SeenPhase, patches: Patches) -> bool:
        """Return whether a frame shows a code that neither settings nor calibration state."""
        graph, width = patches.graph(), int(seen.image.shape[1])
        blocks = read_blocks(_contrasts(seen, patches), graph, width, seen.noise)
        # Most frames without a code are recognised here, and need no kernels that read one.
        if change_by_cycle(blocks) < ContrastCode.named("contrast").least_change / 2:
            return False
        found = self._find_absolute(seen, patches, graph, None, None)
        absolute = found.absolute
        sure = absolute.error_probability(absolute.offsets) < MAX_ABSOLUTE_ERROR
        share = graph.pixels[np.isin(found.roots, absolute.parts[sure])].sum() / max(graph.pixels.sum(), 1)
        return bool(found.readable and share > _MIN_CODED)

    def _find_absolute(
        self,
        seen: SeenPhase,
        patches: Patches,
        graph: PatchGraph,
        order_range: OrderRange | None,
        rays: CameraRays | None,
    ) -> CodedOrders:
        if self._columns is None and self._geometry is not None and rays is not None:
            self._columns = StripeColumns(self._geometry, runtime.to_host(rays.rays))
        sums = _contrasts(seen, patches)
        width, code = int(seen.image.shape[1]), self.code or ContrastCode.named("contrast")
        return find_absolute_orders(
            sums, graph, code, self._columns, width=width, noise=seen.noise, order_range=order_range
        )

    def _place_by_depth(
        self, seen: SeenPhase, graph: PatchGraph, roots: npt.NDArray[np.int32] | None, rays: CameraRays | None
    ) -> tuple[AbsoluteOrders | None, Cause | None]:
        """Find the orders that the depth range leaves possible, and warn if it does not contain what is in view."""
        order_range = self._order_range(seen, graph, rays)
        if order_range is None or self._depth_range_mm is None:
            return None, None
        roots = graph.root if roots is None else roots
        pixels = np.bincount(roots, graph.pixels, len(roots))
        parts = np.flatnonzero(pixels >= MIN_REGION_PX)
        ranges = order_range.by_part(roots, parts, graph.pixels)
        outside = pixels[parts[[not within.holds for within in ranges]]].sum() / max(pixels[parts].sum(), 1)
        if outside > _MAX_OUT_OF_RANGE:
            # What of the rest fits, fits by chance.
            unknown = AbsoluteOrders(parts, (NOTHING_KNOWN,) * len(parts))
            return unknown, Cause("out of range", _OUT_OF_RANGE.format(outside, *self._depth_range_mm))
        return AbsoluteOrders(parts, tuple(within.alone() for within in ranges)), None

    def _order_range(self, seen: SeenPhase, graph: PatchGraph, rays: CameraRays | None) -> OrderRange | None:
        """Return how many cycles every patch may lack: its first pixel's ray in the depth range and the pattern."""
        if self._geometry is None or rays is None:
            return None
        phase = runtime.to_host(seen.phase)  # synchronises
        y, x = np.divmod(graph.first, phase.shape[1])
        here = phase[y, x] / (2 * np.pi) + graph.offset
        pattern = self._geometry.pattern
        cycles = self._geometry.projector.size_px[self._geometry.phase_axis] / pattern.period_px
        least, most = np.zeros(len(here)), np.full(len(here), cycles)
        if self._depth_range_mm is not None:
            directions = np.column_stack([runtime.to_host(rays.rays)[y, x], np.ones(len(here))])
            ends = np.sort([self._geometry.pattern_cycles(z * directions) for z in self._depth_range_mm], axis=0)
            least, most = np.maximum(least, ends[0]), np.minimum(most, ends[1])
        return OrderRange(least - here, most - here, self._depth_range_mm is not None)


def _contrasts(seen: SeenPhase, patches: Patches) -> npt.NDArray[np.float32]:
    """Return what the patches show of each cycle's contrast; see `measure_contrast`."""
    light = (seen.image, seen.crosstalk, seen.gains)
    return measure_contrast(*light, seen.phase, seen.modulation, patches, seen.period_px)


def _moved(shift_px: float) -> Cause:
    """Return a warning that the code is not at its calibrated place."""
    words = f"the pattern lies {abs(shift_px):.1f} projector px along the stripe from its calibrated place"
    return Cause("rig moved", f"{words}: camera or projector have moved since, calibrate geometry again")


def _check_view(geometry: Geometry, depth_mm: float, *, stated: bool) -> None:
    """Check that the pattern is anywhere near what the camera sees at a depth, stated or the geometry's own."""
    right, bottom = geometry.camera.size_px
    corners = np.array([[0, 0, 1], [right, 0, 1], [0, bottom, 1], [right, bottom, 1], [right / 2, bottom / 2, 1]])
    cycles = geometry.pattern_cycles(depth_mm * corners @ np.linalg.inv(geometry.camera.matrix).T)
    if not np.abs(cycles).max() < _MOST_CYCLES:
        raise CalibrationError(
            Cause(
                "past the pattern",
                f"at {depth_mm:.4g} mm the camera looks far past the pattern, and its axis and the projector's meet at "
                f"{geometry.working_distance_mm() or np.inf:.4g} mm: {'correct depth_range_mm, or ' if stated else ''}"
                "calibrate geometry again",
            )
        )


def _expected_depth(geometry: Geometry, depth_range_mm: tuple[float, float] | None) -> float:
    if depth_range_mm is not None:
        return float(np.mean(depth_range_mm))
    depth = geometry.working_distance_mm()
    if depth is None:
        raise CalibrationError(
            "camera and projector look in parallel, so the object's distance is unknown: give depth_range_mm"
        )
    return depth
