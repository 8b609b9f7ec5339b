"""Common base of decoded and of stored frames: the fields, and the results computed from them."""

from abc import ABC, abstractmethod
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from pipeline.calibration.lens import Lens
from pipeline.decoding.labels import FrameLabels, make_dataset
from pipeline.errors import SettingsError
from pipeline.showing import plot_image, save_frame, to_html, to_pyvista, view_frames

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase
    from pyvista import PolyData
    from xarray import Dataset

    from pipeline.decoding.fields import Field
    from pipeline.view.embedded import EmbeddedPage

Floats = npt.NDArray[np.float32]


class FrameFields(ABC):
    """A frame: fields of (H, W) pixels, each read when it is first used; see `DecodedFrame` for their meaning.

    Attributes
    ----------
    number : int or None
        The frame's, in its footage; None: it is not from footage.
    time_s : float or None
        When it was taken, s since 1970 where `dated`, else since the footage's first frame; None: unknown.
    dated : bool
        True if the date is known.
    period_px : float or None
        Of the fringe, camera px per cycle; None: no fringe was found.
    warnings : tuple of str
        Warnings about this frame.

    Examples
    --------
    >>> rig = colorphase.simulated_rig((160, 120), period_px=64)
    >>> sheet = colorphase.simulate_frame(rig, colorphase.SimulationSettings(scene="plane"))
    >>> frame = colorphase.Decoder(calibration=rig, arch="cpu").decode(sheet.image)
    >>> sorted(frame.fields)[:3], frame.range_unit
    (['absolute', 'constant_sigma', 'fringe_order'], 'mm')
    >>> frame.save("face.ply")
    >>> len(colorphase.read_mesh("face.ply").vertices)
    19200
    """

    number: int | None
    time_s: float | None
    dated: bool
    period_px: float | None
    warnings: tuple[str, ...]

    if TYPE_CHECKING:  # the table in `decoding.frame` has their units and meanings
        wrapped_phase: Floats
        unwrapped_phase: Floats
        fringe_order: npt.NDArray[np.int32]
        mask: npt.NDArray[np.bool_]
        modulation: Floats
        region: npt.NDArray[np.int32]
        absolute: npt.NDArray[np.bool_]
        order_error_probability: Floats
        phase_sigma: Floats
        constant_sigma: np.float32
        points: Floats | None
        point_sigma: Floats | None
        range_image: Floats
        texture: npt.NDArray[np.uint8]

    @property
    @abstractmethod
    def calibrated(self) -> bool:
        """True if `range_image` is a depth in mm."""

    @property
    @abstractmethod
    def attributes(self) -> dict[str, Any]:
        """Provenance: settings, the calibration's hash, version, unit of ranges."""

    @property
    @abstractmethod
    def fields(self) -> dict[str, "Field[Any]"]:
        """The fields that it has, by name."""

    @property
    @abstractmethod
    def camera(self) -> Lens | None:
        """The camera whose pixels it has; None: without a calibration."""

    @property
    def range_unit(self) -> Literal["mm", "rad"]:
        """Of `range_image`."""
        return "mm" if self.calibrated else "rad"

    def __repr__(self) -> str:
        name = type(self).__name__ if self.number is None else f"{type(self).__name__} {self.number}"
        if not {"mask", "points"} & self.fields.keys():
            return f"<{name}: {', '.join(self.fields)}>"
        ranges = self.range_image if "range_image" in self.fields or self.points is None else self.points[..., 2]
        mask = self.mask if "mask" in self.fields else np.isfinite(ranges)
        height, width = mask.shape
        known = ranges[mask & np.isfinite(ranges)]
        span = ""
        if known.size:
            nearest, farthest = np.percentile(known, (1, 99))
            span = f", {nearest:.4g} to {farthest:.4g} {self.range_unit}"
        return f"<{name}: {width}x{height} px, {mask.mean():.1%} measured{span}>"

    def _repr_html_(self) -> str | None:
        return to_html(self)

    def view(self) -> "EmbeddedPage":
        """Return a page for a notebook in which the frame can be turned and measured, as by `colorphase view`.

        The frame is in the page, every pixel of it if there are no more than 660,000: the notebook grows by some MB.
        """
        page: EmbeddedPage = view_frames(self)
        return page

    def plot(self, field: str = "range_image", ax: "Axes | None" = None) -> "FigureBase":
        """Draw a field with its scale, in its unit, from its 1st to its 99th percentile.

        Parameters
        ----------
        field : str
            Its name; one with a number, a flag or a colour per pixel.
        ax : matplotlib.axes.Axes, optional
            The axes to draw into; None: a new figure, which a notebook shows and `savefig` writes, without a screen.

        Returns
        -------
        matplotlib.figure.Figure
            The figure that it is drawn in.

        Raises
        ------
        SettingsError
            There is no such field, it is no picture, or not without a calibration.
        """
        pictures = [name for name, entry in self.fields.items() if entry.axes in (("y", "x"), ("y", "x", "rgb"))]
        if field not in pictures:
            raise SettingsError(f"cannot plot {field!r}: choose one of {', '.join(pictures)}")
        unit = self.fields[field].unit
        shown = self.range_unit if unit == "range" else unit
        return plot_image(getattr(self, field), field.replace("_", " "), shown, ax)

    def to_xarray(self) -> "Dataset":
        """Return all fields as an `xarray.Dataset`, with the units and coordinates of a ``result.zarr``.

        A frame of footage has a first axis ``frame`` of length 1, with its number and its ``time`` as coordinates:
        ``xarray.concat([frame.to_xarray() for frame in frames], "frame")`` joins frames.

        Raises
        ------
        OutputError
            xarray is not installed.
        """
        values = {name: (entry, getattr(self, name)) for name, entry in self.fields.items()}
        return make_dataset(values, FrameLabels(self.range_unit, self.warnings, self.number, self.time_s, self.dated))

    def to_pyvista(self) -> "PolyData":
        """Return the frame's mesh, as `frame_mesh` makes it, as `pyvista.PolyData`.

        Its points have ``Normals``, ``colors`` (sRGB) and ``flags``, and the mesh's properties of its vertices, such as
        ``sigma_mm``; its `field_data` has ``unit``, "mm" or "rad". Nothing is drawn.
        """
        return to_pyvista(self)

    def save(self, path: str | Path) -> None:
        """Write the frame as a file, in the format that the path's suffix names.

        Parameters
        ----------
        path : str or Path
            A mesh (.ply, .obj, .stl, .glb, .wrl), the camera's grid of points (.pcd, .xyz, .csv, .npz), depth in 16
            bits (.png, .tiff), or all that was decoded (.zarr), which `StoredResult` opens again.

        Raises
        ------
        OutputError
            It cannot be written there, or not in such a format.
        FootageError
            The format holds places in mm, and there are none.
        """
        save_frame(self, Path(path))
