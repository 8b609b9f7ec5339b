"""Pictures of a calibration: what was measured, how well it fits, and the rig drawn to scale.

Colours are those of M. Okabe and K. Ito (Color Universal Design, 2008), which colour-blind readers distinguish; the
three colours of light also differ in their markers.
"""

import io
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from pipeline.calibration.bundle_adjustment import BundleAdjustment
from pipeline.calibration.lens import Lens
from pipeline.calibration.model import Geometry
from pipeline.calibration.radiometry import PRIMARIES, RAMP_CODES, Radiometry
from pipeline.calibration.rig_geometry import GeometryFit
from pipeline.files import write_atomically
from pipeline.models import FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

_LIGHT = ("#D55E00", "#009E73", "#0072B2")  # of red, green and blue
_MARKERS = ("o", "s", "^")
_CAMERA, _PROJECTOR, _BOTH, _LEFT_OUT = "#0072B2", "#D55E00", "#009E73", "#CC79A7"
# At this resolution a letter of 10 points is 14 px high, which is read on a screen at 1:1.
_DPI = 100
# Residuals are magnified so that their RMS is about this part of the picture's width: seen, and not crossing.
_ARROW = 0.015
# Bars end at this many times the worst pose that was used; what was left out may lie far beyond.
_TALLEST = 2.0
# Names with more letters in all lie across each other unless they are turned.
_LEVEL_LETTERS = 100
# Rays along either side of the picture, and depths, that are looked up for the volume that both see.
_RAYS, _DEPTHS = 25, 5
# The views of the rig: title, the camera's axis that is drawn downwards, and where it points.
_VIEWS = (("from the side", 1, "down"), ("from above", 0, "to the right"))


def write_figure(figure: "Figure", path: Path) -> None:
    """Write a figure as PNG.

    Raises
    ------
    OutputError
        The place cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # slow to import, and only needed here

    buffer = io.BytesIO()
    FigureCanvasAgg(figure).print_png(buffer)  # type: ignore[no-untyped-call]  # matplotlib has no annotation there
    write_atomically(path, buffer.getvalue())


def _new_figure(width_in: float, height_in: float, title: str) -> "Figure":
    from matplotlib.figure import Figure  # slow to import, and only needed here

    figure = Figure(figsize=(width_in, height_in), dpi=_DPI, layout="constrained")
    figure.suptitle(title, fontsize=13)
    return figure


def radiometry_figure(found: Radiometry) -> "Figure":
    """Draw the light of each primary in each camera channel, the projector's responses and the crosstalk.

    Parameters
    ----------
    found : Radiometry
        Measured light.

    Returns
    -------
    Figure
        Top, one panel per primary: measured points, and the model's curves; below, what the points lie off these.
        Bottom: the responses with their standard deviation; grey and the sum of its colours; the crosstalk.
    """
    transfer = found.transfer if isinstance(found.transfer, str) else "measured"
    title = f"Light of projector and camera: points are measured, lines fitted; the camera's transfer: {transfer}"
    figure = _new_figure(15, 10.5, title)
    rows = figure.subfigures(2, 1, height_ratios=(6, 4.5), squeeze=False)[:, 0]
    white = found.ramps[3, -1]  # of each camera channel
    codes = np.array([0, *RAMP_CODES])
    panels = rows[0].subplots(2, 3, sharex=True, sharey="row", height_ratios=(4, 1.4))
    for k, primary in enumerate(PRIMARIES):
        for i, channel in enumerate(PRIMARIES):
            measured = found.ramps[k, :, i] / white[i]
            curve = found.crosstalk_matrix[i, k] * found.response[k] / white[i]
            panels[0, k].plot(np.arange(256), curve, color=_LIGHT[i], linewidth=1.2)
            panels[0, k].plot(codes, measured, _MARKERS[i], color=_LIGHT[i], label=f"seen by {channel}")
            panels[1, k].plot(codes, 1e3 * (measured - curve[codes]), _MARKERS[i], color=_LIGHT[i], markersize=4)
        panels[0, k].set_title(f"the projector shows {primary}")
        panels[0, k].legend(loc="upper left")
        panels[1, k].axhline(0, color="grey", linewidth=0.8)
        panels[1, k].set_xlabel("projector code, 0 to 255")
    panels[0, 0].set_ylabel("light, share of white")
    panels[1, 0].set_ylabel("points less lines,\nthousandths of white")
    panels[0, 0].set_xticks(range(0, 257, 32))
    lower = rows[1].subplots(1, 3)
    _draw_responses(lower[0], found, codes)
    _draw_grey(lower[1], found, codes)
    _draw_crosstalk(lower[2], found)
    for panel in (*panels.ravel(), *lower[:2]):
        panel.grid(alpha=0.3)
    return figure


def _draw_responses(axes: "Axes", found: Radiometry, codes: FloatArray) -> None:
    """Draw each primary's light against its code, measured points and band of one standard deviation."""
    for k, primary in enumerate(PRIMARIES):
        # A ramp's points are the column of the crosstalk matrix times the response: here the response by least squares.
        column = found.crosstalk_matrix[:, k]
        points = found.ramps[k] @ column / (column @ column)
        light, sigma = found.response[k], found.response_sigma[k]
        axes.fill_between(range(256), light - sigma, light + sigma, color=_LIGHT[k], alpha=0.3, linewidth=0)
        label = f"{primary}, ± {1e3 * sigma.max():.2g} thousandths"
        axes.plot(np.arange(256), light, color=_LIGHT[k], linewidth=1.2)
        # Hollow, and of three sizes, so that all show where the responses are equal.
        size = 12 - 3 * k
        axes.plot(codes, points, _MARKERS[k], color=_LIGHT[k], markersize=size, fillstyle="none", label=label)
    axes.set(title="the projector's responses", xlabel="projector code, 0 to 255", ylabel="light, share of white")
    axes.set_xticks(range(0, 257, 32))
    axes.legend(loc="upper left", title="standard deviation, of white")


def _draw_grey(axes: "Axes", found: Radiometry, codes: FloatArray) -> None:
    """Draw by how much grey differs from the sum of red, green and blue."""
    white = found.ramps[3, -1]
    off = 1e3 * (found.ramps[3] - found.ramps[:3].sum(axis=0)) / white
    for i, channel in enumerate(PRIMARIES):
        axes.plot(codes, off[:, i], _MARKERS[i], color=_LIGHT[i], label=f"seen by {channel}")
    axes.axhline(0, color="grey", linewidth=0.8)
    axes.set(title=f"grey less its colours: {found.additivity:.2%} of white at most")
    axes.set(xlabel="projector code, 0 to 255", ylabel="thousandths of white")
    axes.set_xticks(range(0, 257, 32))
    axes.margins(y=0.4)
    axes.legend(loc="upper left")


def _draw_crosstalk(axes: "Axes", found: Radiometry) -> None:
    """Draw the crosstalk matrix as a table, each row divided by its sum."""
    rows = found.crosstalk_matrix.sum(axis=1, keepdims=True)
    shares, sigma = 100 * found.crosstalk_matrix / rows, 100 * found.crosstalk_sigma / rows
    axes.imshow(shares, cmap="Greys", vmin=0, vmax=100, aspect="auto")
    for i in range(3):
        for k in range(3):
            axes.text(k, i, f"{shares[i, k]:.2f} %\n± {sigma[i, k]:.2f}", ha="center", va="center", fontsize=11,
                      color="white" if shares[i, k] > 50 else "black")  # fmt: skip
    axes.set_xticks(range(3), [f"projector's\n{name}" for name in PRIMARIES])
    axes.set_yticks(range(3), [f"camera's\n{name}" for name in PRIMARIES])
    axes.set_title("crosstalk: sources of each channel's light")


def geometry_figure(found: GeometryFit) -> "Figure":
    """Draw the corners in both pictures with their residuals, the poses' residuals, and the rig to scale.

    Parameters
    ----------
    found : GeometryFit
        A solved geometry.

    Returns
    -------
    Figure
        Top: both pictures with all corners. Middle: the RMS residual of each pose. Bottom: the rig from the side and
        from above, with both fields, the boards, and the volume that both see between the boards' depths.
    """
    place, fit = found.calibration.geometry(), found.adjustment
    baseline_mm = float(np.linalg.norm(place.translation_mm))
    title = (
        f"Geometry from {len(found.poses)} poses, {len(found.unused)} left out; baseline {baseline_mm:.1f} mm; "
        f"depth off by {found.verdict.bias_mm:.2f} mm at {found.verdict.distance_mm:.0f} mm (one standard deviation)"
    )
    figure = _new_figure(14, 14.5, title)
    top, middle, bottom = figure.subfigures(3, 1, height_ratios=(6.2, 3, 5.3), squeeze=False)[:, 0]
    pictures = top.subplots(1, 2)
    _draw_corners(pictures[0], "camera", place.camera, fit, 0, _CAMERA)
    _draw_corners(pictures[1], "projector", place.projector, fit, 1, _PROJECTOR)
    _draw_pose_bars(middle.subplots(), found)
    _draw_rig(bottom, place, fit)
    return figure


def _draw_corners(axes: "Axes", name: str, lens: Lens, fit: BundleAdjustment, device: int, color: str) -> None:
    """Draw a picture's frame, the corners that are seen in it, and how far the fit puts them from there."""
    seen = [(pose.camera_px, pose.projector_px)[device] for pose in fit.poses]
    residuals = [fit.corner_residuals_px(k)[:, device] for k in range(len(fit.poses))]
    used = np.concatenate(fit.used)
    corners, steps = np.concatenate(seen), np.concatenate(residuals)
    width, height = lens.size_px
    rms = max(float(np.sqrt((steps[used] ** 2).sum(axis=1).mean())), 1e-6)  # corners without noise are nowhere off
    scale = _round_down(_ARROW * width / rms)
    share = picture_share(corners[used], lens.size_px)
    for pose in seen:
        axes.fill(*cv2.convexHull(pose.astype(np.float32))[:, 0].T, facecolor="none", edgecolor="0.8", linewidth=0.8)
    hull = cv2.convexHull(corners[used].astype(np.float32))[:, 0]
    axes.fill(*hull.T, facecolor=color, alpha=0.07)
    axes.plot(*np.concatenate([hull, hull[:1]]).T, "--", color="0.4", linewidth=1, label="hull of all corners")
    axes.plot(*corners[used].T, ".", color="0.35", markersize=2.5, label="corner; grey outline: a board")
    arrows = axes.quiver(
        *corners[used].T, *(scale * steps[used]).T, color=color, angles="xy", scale_units="xy", scale=1, width=0.0022,
        label=f"residual, {scale:g} times as long",
    )  # fmt: skip
    known = _round_down(2 * rms)
    axes.quiverkey(arrows, 0.9, -0.09, scale * known, f"{known:g} px ", labelpos="W")
    if not used.all():
        axes.plot(*corners[~used].T, "x", color="black", markersize=6, label="corner that was left out")
    axes.set(xlim=(0, width), ylim=(height, 0), aspect="equal", xlabel=f"{name}'s column, px")
    axes.set_ylabel(f"{name}'s row, px")
    axes.set_title(f"{name}: {np.count_nonzero(used)} corners fill {share:.0%} of the picture, off by {rms:.3f} px RMS")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.11), ncols=2)


def _round_down(value: float) -> float:
    """Return the largest of 1, 2 and 5 times a power of ten that is not above a value.

    >>> _round_down(0.7), _round_down(390.0)
    (0.5, 200.0)
    """
    ten = 10.0 ** np.floor(np.log10(value))
    return float(max(step for step in (1, 2, 5) if step * ten <= value) * ten)


def picture_share(corners_px: FloatArray, size_px: tuple[int, int]) -> float:
    """Return the share of a picture that lies within the convex hull of corners, (N, 2) px."""
    hull = cv2.convexHull(corners_px.astype(np.float32))
    return float(cv2.contourArea(hull) / (size_px[0] * size_px[1]))


class PoseBar(NamedTuple):
    """The residuals of one pose."""

    name: str
    rms_px: tuple[float, float]  # camera, projector
    used: bool


def pose_bars(found: GeometryFit) -> list[PoseBar]:
    """Return the RMS residuals of every pose, by name; those that were left out stand where the lenses see them."""
    fit = found.adjustment
    bars = [
        PoseBar(pose.name, (float(rms[0]), float(rms[1])), True)
        for pose, rms in zip(fit.poses, fit.pose_rms_px(), strict=True)
    ]
    for pose in found.unused:
        errors, _ = fit.corner_errors(pose, fit.rough_stand(pose))
        camera, projector = np.sqrt((errors**2).sum(axis=-1).mean(axis=0))
        bars.append(PoseBar(pose.name, (float(camera), float(projector)), False))
    return sorted(bars)


def _draw_pose_bars(axes: "Axes", found: GeometryFit) -> None:
    """Draw the RMS residual of each pose in camera and projector."""
    bars = pose_bars(found)
    top = _TALLEST * max(max(bar.rms_px) for bar in bars if bar.used)
    for device, (name, color) in enumerate((("camera", _CAMERA), ("projector", _PROJECTOR))):
        heights = np.array([bar.rms_px[device] for bar in bars])
        at = np.arange(len(bars)) + 0.4 * (device - 0.5)
        usual = float(np.median([bar.rms_px[device] for bar in bars if bar.used]))
        axes.bar(at, np.minimum(heights, top), 0.38, color=color, label=f"{name}; dashed: middle pose, {usual:.3f} px")
        axes.axhline(usual, color=color, linestyle="--", linewidth=1)
    names = [bar.name for bar in bars]
    is_turned = sum(map(len, names)) > _LEVEL_LETTERS
    for k, bar in enumerate(bars):
        if not bar.used:
            axes.axvspan(k - 0.48, k + 0.48, color=_LEFT_OUT, alpha=0.35, linewidth=0, zorder=0)
            text = "left out{}{:.2f}, {:.2f} px".format(" " if is_turned else "\n", *bar.rms_px)
            box = {"facecolor": "white", "edgecolor": "none", "pad": 2}
            axes.text(k, 0.97 * top, text, ha="center", va="top", rotation=90 * is_turned, bbox=box)
    axes.set_xticks(range(len(bars)), names, rotation=90 * is_turned)
    axes.set(xlim=(-0.6, len(bars) - 0.4), ylim=(0, top), ylabel="residual, px RMS")
    axes.set_title("residuals of each pose", loc="left")
    axes.grid(axis="y", alpha=0.3)
    axes.set_axisbelow(True)
    axes.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=2)


def shared_volume(geometry: Geometry, near_mm: float, far_mm: float) -> FloatArray:
    """Return points that camera and projector both see between two depths, (N, 3) mm in the camera's frame."""
    width, height = geometry.camera.size_px
    grid = np.stack(np.meshgrid(np.linspace(0, width, _RAYS), np.linspace(0, height, _RAYS)), axis=-1).reshape(-1, 2)
    rays = np.column_stack([geometry.camera.rays_through(grid), np.ones(len(grid))])
    points = np.concatenate([depth * rays for depth in np.linspace(near_mm, far_mm, _DEPTHS)])
    turn, lens = cv2.Rodrigues(geometry.rotation)[0], geometry.projector
    pixels, _ = cv2.projectPoints(points, turn, geometry.translation_mm, lens.matrix, lens.distortion)
    inside = np.all((pixels[:, 0] >= 0) & (pixels[:, 0] <= np.array(lens.size_px)), axis=1)
    return np.asarray(points[inside])


def _field(lens: Lens, centre: FloatArray, rotation: FloatArray, far_mm: float) -> FloatArray:
    """Return a device's place and where the rays of its picture's corners reach a depth, (5, 3) mm."""
    width, height = lens.size_px
    ends = lens.rays_through(np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float64))
    rays = np.column_stack([ends, np.ones(4)]) @ rotation
    return np.vstack([centre, centre + rays * ((far_mm - centre[2]) / rays[:, 2:])])


def _boards(fit: BundleAdjustment) -> list[FloatArray]:
    """Return each pose's outline through its outer corners, (M, 3) mm in the camera's frame."""
    outlines = []
    for pose, stands in zip(fit.poses, fit.parameters[24:].reshape(-1, 6), strict=True):
        around = cv2.convexHull(pose.corners_mm[:, :2].astype(np.float32), returnPoints=False).ravel()
        outlines.append(pose.corners_mm[around] @ cv2.Rodrigues(stands[:3])[0].T + stands[3:])
    return outlines


def _draw_rig(panel: "SubFigure", geometry: Geometry, fit: BundleAdjustment) -> None:
    """Draw the rig to scale in two views: devices, their fields, the boards, and the volume that both see."""
    depths = fit.depths_mm()
    near, far = float(depths.min()), float(depths.max())
    volume = shared_volume(geometry, near, far)
    middle = shared_volume(geometry, (near + far) / 2, (near + far) / 2)
    centre = -geometry.rotation.T @ geometry.translation_mm
    beyond = far + 0.15 * (far - near)
    boards = _boards(fit)
    views = panel.subplots(1, 2)
    fields = (
        ("camera", _CAMERA, _field(geometry.camera, np.zeros(3), np.eye(3), beyond)),
        ("projector", _PROJECTOR, _field(geometry.projector, centre, geometry.rotation, beyond)),
    )
    # Both views have the same scale and size.
    ends = np.concatenate([field[:, :2] for _, _, field in fields])
    room = 0.1 * np.ptp(ends)
    for axes, (title, axis, side) in zip(views, _VIEWS, strict=True):
        for device, color, field in fields:
            _fill(axes, field, axis, facecolor=color, alpha=0.12, edgecolor=color, label=f"{device}'s field")
        if len(volume):
            _fill(axes, volume, axis, facecolor=_BOTH, alpha=0.45, edgecolor=_BOTH, label="both see, at boards' depths")
        for k, board in enumerate(boards):
            label = "board" if k == 0 else None
            _fill(axes, board, axis, facecolor="none", alpha=1.0, edgecolor="black", label=label)
        _draw_devices(axes, centre, axis)
        axes.set(aspect="equal", xlabel="z, in front of the camera, mm", ylabel=f"{'xy'[axis]}, {side}, mm")
        axes.set(xlim=(min(0, centre[2]) - 1.5 * room, beyond + room), ylim=(ends.max() + room, ends.min() - room))
        axes.grid(alpha=0.3)
        seen = np.ptp(middle[:, axis]) if len(middle) else 0
        axes.set_title(f"{title}: both see {seen:.0f} mm, {(near + far) / 2:.0f} mm away")
    handles, labels = views[0].get_legend_handles_labels()
    panel.legend(handles, labels, loc="outside lower center", ncols=len(labels))


def _fill(axes: "Axes", points: FloatArray, axis: int, *, alpha: float, facecolor: str, edgecolor: str,
          label: str | None) -> None:  # fmt: skip
    """Draw the outline of points (N, 3) as they are seen along one of the camera's axes."""
    outline = cv2.convexHull(points[:, [2, axis]].astype(np.float32))[:, 0]
    axes.fill(*outline.T, facecolor=facecolor, alpha=alpha, edgecolor=edgecolor, linewidth=1.0, label=label)


def _draw_devices(axes: "Axes", centre: FloatArray, axis: int) -> None:
    """Draw camera, projector and the baseline between them, each with its name."""
    label = f"baseline, {np.linalg.norm(centre):.1f} mm"
    axes.plot([0, centre[2]], [0, centre[axis]], color="black", linewidth=2.5, label=label, zorder=4)
    above = centre[axis] < 0  # the axis runs downwards
    # The camera last and smaller: from above it may hide the projector.
    for name, place, color, marker, size, is_above in (
        ("projector", centre, _PROJECTOR, "s", 10, above),
        ("camera", np.zeros(3), _CAMERA, "o", 6, not above),
    ):
        axes.plot(place[2], place[axis], marker, color=color, markersize=size, zorder=5)
        axes.annotate(
            name, (place[2], place[axis]), xytext=(0, 9 if is_above else -9), textcoords="offset points", color=color,
            ha="center", va="bottom" if is_above else "top", weight="bold",
        )  # fmt: skip
