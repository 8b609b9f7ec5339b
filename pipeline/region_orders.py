"""Which whole cycles every surface of a frame has: by the pattern's code, the frame before, or the expected depth."""

from typing import Any

import numpy as np
import numpy.typing as npt

from pipeline.absolute_order import AbsoluteOrders, blur_shift, find_absolute_orders
from pipeline.calibration import Geometry
from pipeline.contrast_code import cycle_modulations
from pipeline.errors import CalibrationError
from pipeline.light_path import LightPath
from pipeline.results import DecodedFrame
from pipeline.temporal_order import MAX_ERROR_PROBABILITY, CarriedOrders, count_votes, split_by_votes
from pipeline.workspace import Workspace
from tikernels import runtime
from tikernels.absolute_order import SLOTS, adopt_pixels_kernel, correct_by_modulation_kernel, measure_contrast_kernel
from tikernels.equalization import modulation_tables
from tikernels.temporal_order import VOTES_A_CELL, vote_orders_kernel
from tikernels.unwrapping import PatchGraph

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
        """Place the regions that `work.unwrapper` has joined, and write the unwrapped phase.

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
        unwrapper, buffers = work.unwrapper, frame._buffers
        orders = self._read_code(image, work, frame) if self._code == "contrast" else None
        carried = None if previous is None else self._carry_orders(previous, work, buffers["phase"])
        if frame._rig is not None:
            unwrapper.place(buffers["phase"], *frame._rig, self._depth_mm)
        if carried is not None:
            unwrapper.set_orders(carried.roots, carried.offsets)
        if orders is not None:
            unwrapper.set_orders(orders.parts[orders.absolute], orders.offsets[orders.absolute])
        unwrapper.write(buffers["phase"], work.rates, buffers["unwrapped"], buffers["mask"], buffers["region"])
        _note_orders(orders, carried, previous, work, frame)
        doubt = None if orders is None else self._use_orders(orders, correction, work, frame)
        if carried is not None and not carried.same_scene:
            doubt = "nothing of the frame before is seen again: the orders start afresh"
        if not self._code_looked_for:
            self._code_looked_for = True
            graph = unwrapper.graph()
            found = self._find_orders(image, work, frame, graph)
            if graph.pixels[np.isin(found.roots, found.parts[found.absolute])].sum() > graph.pixels.sum() / 2:
                doubt = 'the frame shows a contrast code: set code = "contrast" to use it'
        return doubt

    def _read_code(self, image: Any, work: Workspace, frame: DecodedFrame) -> AbsoluteOrders:
        """Find the absolute orders, and split the regions that the code contradicts."""
        graph = work.unwrapper.graph()
        orders = self._find_orders(image, work, frame, graph)
        if not np.array_equal(orders.roots, graph.root):
            work.unwrapper.split(orders.roots)
        return orders

    def _find_orders(self, image: Any, work: Workspace, frame: DecodedFrame, graph: PatchGraph) -> AbsoluteOrders:
        unwrapper, buffers = work.unwrapper, frame._buffers
        sums = runtime.empty((unwrapper.patch_count, SLOTS, 4), np.float32)
        light = (image, self._path.inverse, work.gains.gains, work.gains.cell, buffers["phase"], buffers["modulation"])
        patches = (unwrapper.labels, unwrapper.firsts, unwrapper.draft_bits)
        measure_contrast_kernel(self._path.balance_first)(*light, *patches, sums)
        width = int(image.shape[1])
        rising = float(runtime.to_host(work.rates)[-1, 1]) > 0
        return find_absolute_orders(
            runtime.to_host(sums), graph, width, rising, self._order_bounds(frame, graph, width)
        )

    def _carry_orders(self, previous: DecodedFrame, work: Workspace, phase: Any) -> CarriedOrders:
        """Find the orders that agree with the frame before, and split the regions that it contradicts."""
        unwrapper, before = work.unwrapper, previous._buffers
        votes = runtime.empty((unwrapper.cells * VOTES_A_CELL, 4), np.int32)
        patches = (unwrapper.labels, unwrapper.firsts, unwrapper.draft_bits, unwrapper.patches)
        vote_orders_kernel(phase, *patches, before["unwrapped"], before["region"], votes)
        counted = runtime.to_host(votes)
        if self._code is None:  # a code has split them already, and knows better
            graph = unwrapper.graph()
            roots = split_by_votes(counted, graph)
            if not np.array_equal(roots, graph.root):
                unwrapper.split(roots)
        return count_votes(counted, unwrapper.patch_roots())

    def _order_bounds(self, frame: DecodedFrame, graph: PatchGraph, width: int) -> npt.NDArray[np.float64] | None:
        """Return the absolute phases, in cycles, that the depth range allows the first pixel of each patch."""
        if self._geometry is None or frame._rig is None or self._depth_range_mm is None:
            return None
        rays = runtime.to_host(frame._rig[0])[graph.first // width, graph.first % width]
        depths = [np.column_stack([rays, np.ones(len(rays))]) * z for z in self._depth_range_mm]
        ends = [self._geometry.pattern_cycles(points) for points in depths]
        return np.sort(np.stack(ends, axis=1), axis=1)

    def _use_orders(
        self, orders: AbsoluteOrders, correction: npt.NDArray[np.float32], work: Workspace, frame: DecodedFrame
    ) -> str | None:
        """Note what is known of each region, and correct the phases by the modulation that their cycles have.

        Returns what the user should know.
        """
        buffers, known = frame._buffers, frame.order_is_known
        if known.any():
            absolute = known.astype(np.int32)
            adopted = runtime.empty((*buffers["region"].shape, 2), np.float32)
            outputs = (buffers["unwrapped"], buffers["mask"], buffers["region"])
            adopt_pixels_kernel(
                buffers["phase"], work.raw_phase, buffers["modulation"], work.rates, absolute, adopted, *outputs
            )
        # The response is taken from all cycles alike; a table of the pattern's own response holds for full modulation.
        usual = 0.5 if self._path.response_is_full else cycle_modulations().mean()
        departures, tables = modulation_tables(correction, cycle_modulations() / usual - 1)
        columns = (slice(None), slice(None, None, _EVERY_COLUMN))
        sampled = runtime.to_host(buffers["unwrapped"])[columns], runtime.to_host(buffers["region"])[columns]
        shift = blur_shift(*sampled, known, departures, frame.period_px or 0.0)
        if max(np.abs(tables).max(), abs(shift)) > _MIN_CORRECTION and known.any():
            arguments = (buffers["region"], known.astype(np.int32), departures, tables, shift)
            correct_by_modulation_kernel(*arguments, buffers["phase"], buffers["unwrapped"])
        pixels = np.bincount(runtime.to_host(buffers["region"]).ravel(), minlength=len(known))[1:]
        lost = float(pixels[~known[1:]].sum() / max(pixels.sum(), 1))
        if not orders.readable:
            return "the frame does not show the contrast code: project a pattern made with --code contrast"
        if lost > _MAX_LOST:
            return f"{lost:.0%} of the pixels show too little of the code, or contradict it: their order is a guess"
        return None


def _note_orders(
    orders: AbsoluteOrders | None,
    carried: CarriedOrders | None,
    previous: DecodedFrame | None,
    work: Workspace,
    frame: DecodedFrame,
) -> None:
    """Note of every region whether its orders are absolute, and how probably they are not."""
    roots = work.unwrapper.roots
    known, errors = np.zeros(len(roots) + 1, np.bool_), np.ones(len(roots) + 1)
    if previous is not None and carried is not None and previous._placed is not None:
        known_before, errors_before = previous._placed
        place = {int(root): number for number, root in enumerate(carried.roots)}
        for number, root in enumerate(roots, start=1):
            if (found := place.get(int(root))) is not None:
                before = carried.before[found]
                errors[number] = 1 - (1 - errors_before[before]) * (1 - carried.error_probability[found])
                known[number] = known_before[before] and errors[number] < MAX_ERROR_PROBABILITY
    if orders is not None and len(orders.parts):
        part = np.searchsorted(orders.parts, roots)
        by_code = orders.absolute[part]
        by_error = orders.error_probability(work.unwrapper.orders(orders.parts).astype(np.int64))[part]
        known[1:] |= by_code
        errors[1:] = np.where(by_code | ~known[1:], by_error, errors[1:])
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
