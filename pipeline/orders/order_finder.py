"""Which whole cycles every surface of a frame has: by the pattern's code, the frame before, or the expected depth."""

from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.calibration import Geometry
from pipeline.decoding.frame import DecodedFrame
from pipeline.decoding.light_path import LightPath
from pipeline.decoding.workspace import Workspace
from pipeline.errors import CalibrationError
from pipeline.orders.carried_orders import MAX_ERROR_PROBABILITY as MAX_CARRIED_ERROR
from pipeline.orders.carried_orders import CarriedOrders, count_votes, split_by_votes
from pipeline.orders.coded_orders import blur_shift, code_departures, find_absolute_orders, modulation_corrections
from pipeline.orders.posterior import MAX_ERROR_PROBABILITY, AbsoluteOrders, OrderRange
from pipeline.pattern.contrast_code import cycle_modulations
from tikernels import runtime
from tikernels.order_evidence import adopt_pixels, correct_by_modulation, measure_contrast, vote_orders
from tikernels.phase.equalization import modulation_tables
from tikernels.phase.smoothing import RATE_ACROSS
from tikernels.unwrapping.patches import MIN_REGION_PX, PatchGraph, RegionTable

# With a code, the share of pixels without an absolute order from which the user is told, and the smallest correction
# (rad) that is worth a pass over the image.
_MAX_LOST = 0.02
_MIN_CORRECTION = 1e-3
# Every eighth column tells how far blur shifts the phase.
_EVERY_COLUMN = 8


class OrderFinder:
    """Give the regions of frame after frame their orders.

    Parameters
    ----------
    code : {"contrast"} or None
        The pattern's code.
    path : LightPath
        What is known of the light.
    geometry : Geometry, optional
        The rig's; with it, the depth tells what the orders may be.
    depth_range_mm : (2,) float, optional
        Where surfaces may be.

    Raises
    ------
    CalibrationError
        Nothing tells where the object is.
    """

    def __init__(
        self,
        code: str | None,
        path: LightPath,
        geometry: Geometry | None,
        depth_range_mm: tuple[float, float] | None,
    ) -> None:
        self._code = code
        self._code_looked_for = code is not None
        self._path = path
        self._geometry = geometry
        self._depth_range_mm = depth_range_mm
        if geometry is not None:
            self._depth_mm = _expected_depth(geometry, depth_range_mm)

    def ask_for_no_code(self) -> None:
        """Do not look in the first frame for a code that nobody has told of."""
        self._code_looked_for = True

    def find(
        self,
        image: Any,
        work: Workspace,
        frame: DecodedFrame,
        previous: DecodedFrame | None,
        correction: npt.NDArray[np.float32],
    ) -> str | None:
        """Place the regions that `work.patches` belong to, and write the unwrapped phase.

        Parameters
        ----------
        image : (H, W, 3)
            Linear light, stripes along the rows.
        work : Workspace
            What the frame's phase was recovered with.
        frame : DecodedFrame
            Its phase is read; `unwrapped`, `mask` and `region` are written.
        previous : DecodedFrame, optional
            The frame before.
        correction : (N,) float32
            The response's correction of the phase over a cycle, rad.

        Returns
        -------
        str or None
            What the user should know of the orders.
        """
        patches, buffers = work.patches, frame._buffers
        orders, readable = None, True
        if self._code == "contrast":
            orders, readable = self._read_code(image, work, frame)
        carried = None if previous is None else self._carry_orders(previous, work, buffers["phase"])
        if orders is None and self._depth_range_mm is not None:
            orders = self._place_by_depth(work, frame)
        if frame._rig is not None:
            patches.place(buffers["phase"], *frame._rig, self._depth_mm)
        if orders is not None:
            errors = orders.error_probability(orders.offsets)
            # Of what the range alone leaves possible, the order nearest its middle stays.
            told = (errors < 1) if self._code else np.zeros(len(errors), np.bool_)
            patches.set_orders(orders.parts[told], orders.offsets[told])
        if carried is not None:
            patches.set_orders(carried.roots, carried.offsets)
        if orders is not None:
            absolute = errors < MAX_ERROR_PROBABILITY
            patches.set_orders(orders.parts[absolute], orders.offsets[absolute])
        outputs = (buffers["unwrapped"], buffers["mask"], buffers["region"])
        regions = patches.write(buffers["phase"], work.rates, *outputs)
        _note_orders(orders, carried, previous, regions.roots, work, frame)
        doubt = None
        if self._code == "contrast":
            doubt = self._use_code(readable, correction, regions, work, frame)
        if carried is not None and not carried.same_scene:
            doubt = "nothing of the frame before is seen again: the orders start afresh"
        if not self._code_looked_for:
            self._code_looked_for = True
            graph = patches.graph()
            found, readable = self._find_orders(image, work, frame, graph, None)
            absolute = found.error_probability(found.offsets) < MAX_ERROR_PROBABILITY
            share = graph.pixels[np.isin(found.roots, found.parts[absolute])].sum() / graph.pixels.sum()
            if readable and share > 0.5:
                doubt = 'the frame shows a contrast code: set code = "contrast" to use it'
        return doubt

    def _read_code(self, image: Any, work: Workspace, frame: DecodedFrame) -> tuple[AbsoluteOrders, bool]:
        """Find the absolute orders, split the regions that the code contradicts, and say whether the code is seen."""
        graph = work.patches.graph()
        orders, readable = self._find_orders(image, work, frame, graph, self._order_range(frame, graph))
        if not np.array_equal(orders.roots, graph.root):
            work.patches.split(orders.roots)
        return orders, readable

    def _find_orders(
        self, image: Any, work: Workspace, frame: DecodedFrame, graph: PatchGraph, order_range: OrderRange | None
    ) -> tuple[AbsoluteOrders, bool]:
        buffers = frame._buffers
        seen = (buffers["phase"], buffers["modulation"])
        sums = measure_contrast(image, self._path.crosstalk, work.gains, *seen, work.patches)
        rising = float(runtime.to_host(work.rates)[-1, RATE_ACROSS]) > 0
        return find_absolute_orders(sums, graph, int(image.shape[1]), rising, order_range)

    def _place_by_depth(self, work: Workspace, frame: DecodedFrame) -> AbsoluteOrders | None:
        """Find the orders that the depth range leaves possible."""
        graph = work.patches.graph()
        order_range = self._order_range(frame, graph)
        if order_range is None:
            return None
        parts = np.flatnonzero(np.bincount(graph.root, graph.pixels, len(graph.root)) >= MIN_REGION_PX)
        ranges = order_range.by_part(graph.root, parts, graph.pixels)
        return AbsoluteOrders(graph.root, parts, tuple(within.alone() for within in ranges))

    def _carry_orders(self, previous: DecodedFrame, work: Workspace, phase: Any) -> CarriedOrders:
        """Find the orders that agree with the frame before, and split the regions that it contradicts."""
        patches, before = work.patches, previous._buffers
        counted = vote_orders(phase, patches, before["unwrapped"], before["region"])
        if self._code is not None:  # the code has split them already, and knows better
            return count_votes(counted, patches.roots())
        graph = patches.graph()
        roots = split_by_votes(counted, graph, previous.order_is_known)
        carried = count_votes(counted, roots)
        if carried.same_scene and not np.array_equal(roots, graph.root):
            patches.split(roots)
        return carried

    def _order_range(self, frame: DecodedFrame, graph: PatchGraph) -> OrderRange | None:
        """Return how many cycles every patch may lack: its first pixel's ray in the depth range and the pattern."""
        if self._geometry is None or frame._rig is None:
            return None
        phase = runtime.to_host(frame._buffers["phase"])  # synchronises
        y, x = np.divmod(graph.first, phase.shape[1])
        here = phase[y, x] / (2 * np.pi) + graph.offset
        pattern = self._geometry.pattern
        cycles = self._geometry.projector.size_px[self._geometry.phase_axis] / pattern.period_px
        least, most = np.zeros(len(here)), np.full(len(here), cycles)
        if self._depth_range_mm is not None:
            rays = np.column_stack([runtime.to_host(frame._rig[0])[y, x], np.ones(len(here))])
            ends = np.sort([self._geometry.pattern_cycles(z * rays) for z in self._depth_range_mm], axis=0)
            least, most = np.maximum(least, ends[0]), np.minimum(most, ends[1])
        return OrderRange(least - here, most - here, self._depth_range_mm is not None)

    def _use_code(
        self,
        readable: bool,
        correction: npt.NDArray[np.float32],
        regions: RegionTable,
        work: Workspace,
        frame: DecodedFrame,
    ) -> str | None:
        """Note what is known of each region, and correct the phases by the modulation that their cycles have.

        Returns what the user should know.
        """
        buffers, known = frame._buffers, frame.order_is_known
        if known.any():
            seen = (buffers["phase"], work.raw_phase, buffers["modulation"], work.rates)
            outputs = (buffers["unwrapped"], buffers["mask"], buffers["region"])
            adopt_pixels(work.patches.final, *seen, known, out=outputs)
        # The response is taken from all cycles alike; a table of the pattern's own response holds for full modulation.
        usual = 0.5 if self._path.response_is_full else float(cycle_modulations().mean())
        departures, slopes = code_departures(usual)
        columns = (slice(None), slice(None, None, _EVERY_COLUMN))
        sampled = runtime.to_host(buffers["unwrapped"])[columns], runtime.to_host(buffers["region"])[columns]
        corrections = modulation_corrections(departures, modulation_tables(correction))
        corrections -= blur_shift(*sampled, known, slopes, frame.period_px or 0.0) * slopes
        if np.abs(corrections).max() > _MIN_CORRECTION and known.any():
            phases = (buffers["phase"], buffers["unwrapped"])
            correct_by_modulation(buffers["region"], known, corrections, out=phases)
        pixels = regions.pixels
        lost = float(pixels[~known[1:]].sum() / max(pixels.sum(), 1))
        if not readable:
            return "the frame does not show the contrast code: project a pattern made with --code contrast"
        if lost > _MAX_LOST:
            return f"{lost:.0%} of the pixels show too little of the code, or contradict it: their order is a guess"
        return None


def _note_orders(
    orders: AbsoluteOrders | None,
    carried: CarriedOrders | None,
    previous: DecodedFrame | None,
    roots: npt.NDArray[np.int64],
    work: Workspace,
    frame: DecodedFrame,
) -> None:
    """Note of every region whether its orders are absolute, and how probably they are not."""
    known, errors = np.zeros(len(roots) + 1, np.bool_), np.ones(len(roots) + 1)
    if previous is not None and carried is not None and previous._placed is not None:
        known_before, errors_before = previous._placed
        goes_on = np.isin(roots, carried.roots)
        found = np.searchsorted(carried.roots, roots[goes_on])
        before, number = carried.before[found], 1 + np.flatnonzero(goes_on)
        errors[number] = 1 - (1 - errors_before[before]) * (1 - carried.error_probability[found])
        known[number] = known_before[before] & (errors[number] < MAX_CARRIED_ERROR)
    if orders is not None and len(orders.parts):
        part = np.searchsorted(orders.parts, roots)
        by_itself = orders.error_probability(work.patches.orders(orders.parts).astype(np.int64))[part]
        absolute = by_itself < MAX_ERROR_PROBABILITY
        known[1:] |= absolute
        errors[1:] = np.where(absolute | ~known[1:], by_itself, errors[1:])
    errors[0] = np.nan
    frame._placed = known, errors.astype(np.float32)


def _expected_depth(geometry: Geometry, depth_range_mm: tuple[float, float] | None) -> float:
    if depth_range_mm is not None:
        return float(np.mean(depth_range_mm))
    depth = geometry.working_distance_mm()
    if depth is None:
        raise CalibrationError(
            "camera and projector look in parallel, so nothing tells how far the object is: give depth_range_mm"
        )
    return depth
