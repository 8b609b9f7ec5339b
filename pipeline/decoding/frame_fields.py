"""What a frame that was just decoded and one that is stored have in common: its fields, and what is made of them."""

from abc import ABC, abstractmethod
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from pipeline.calibration.lens import Lens
from pipeline.decoding.labels import FrameLabels, make_dataset
from pipeline.errors import SettingsError
from pipeline.showing import plot_image, save_frame, to_html, to_pyvista

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import FigureBase
    from pyvista import PolyData
    from xarray import Dataset

    from pipeline.decoding.fields import Field

Floats = npt.NDArray[np.float32]


class FrameFields(ABC):
    """A frame: fields of (H, W) pixels, each read when it is first looked at; see `DecodedFrame` for what they mean.

    Attributes
    ----------
    number : int or None
        The frame's, in its footage; None: it is of none.
    time_s : float or None
        When it was taken, s since 1970 where `dated`, else since the footage's first frame; None: nothing tells.
    dated : bool
        Whether the day is known.
    period_px : float or None
        The fringe's, camera px per cycle; None: no fringe was found.
    warnings : tuple of str
        What the user should know about this frame.

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
        """Whether `range_image` is a depth in mm."""

    @property
    @abstractmethod
    def attributes(self) -> dict[str, Any]:
        """How it was decoded: settings, the calibration's hash, version, unit of ranges."""

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

    def plot(self, field: str = "range_image", ax: "Axes | None" = None) -> "FigureBase":
        """Draw a field with its scale, in its unit, from its 1st to its 99th percentile.

        Parameters
        ----------
        field : str
            Which; one with a number, a flag or a colour a pixel.
        ax : matplotlib.axes.Axes, optional
            Where to draw; None: a figure of its own, which a notebook shows and `savefig` writes, without a screen.

        Returns
        -------
        matplotlib.figure.Figure
            What it is drawn in.

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

        Its points have ``Normals``, ``colors`` (sRGB) and ``flags``, and what a mesh knows of its vertices, such as
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
