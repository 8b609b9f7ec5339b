"""A calibrated rig: both lenses, their poses, and how light turns into grey levels."""

import hashlib
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import BeforeValidator, Field, model_validator

from pipeline.calibration.lens import Lens
from pipeline.causes import Cause, Key
from pipeline.errors import CalibrationError, OutputError, SettingsError
from pipeline.files import write_atomically
from pipeline.models import (
    LARGEST,
    ArrayOf,
    CameraState,
    CodeChoice,
    CodeName,
    FloatArray,
    Matrix3,
    Model,
    NonNegative,
    Positive,
    SensorPart,
    Vector3,
    build,
    read_file,
)
from pipeline.showing import to_html
from pipeline.text import sizes_differ
from tikernels.depth.triangulation import ProjectorGeometry

Vector9 = Annotated[FloatArray, ArrayOf((9,))]
Shift = Annotated[FloatArray, ArrayOf((3, 2))]
Response = Annotated[FloatArray, ArrayOf((3, 256))]
_CODE_VERSION: Literal[1] = 1
# Narrower cells of a code are lost in the projector's blur, or in the camera's.
_LEAST_CELL_PX, _LEAST_CELL_CAMERA_PX = 2.0, 4.5
#: Crosstalk worse than this cannot be undone: noise grows by it.
MAX_CONDITION = 100.0
#: What is taken where nobody has named a projector or a pattern: width and height in px, and px per cycle: 44 cycles
# down
#: the picture.
DEFAULT_PROJECTOR_PX = (1024, 768)
DEFAULT_PERIOD_PX = 768 / 44
#: What proves the scale of a geometry, in addition to the side of the board's squares.
ScaleProof = Literal["baseline", "second board"]
# Light of a pattern in which the response has been undone.
_LINEAR = np.array([[0.0, 1.0]] * 3)
_GEOMETRY = ("camera", "projector", "rotation", "translation_mm", "pattern")


#: What patterns have where nobody names a code.
DEFAULT_CODE: CodeName = "contrast"


def _known_version(value: Any) -> Any:
    if isinstance(value, int) and value > _CODE_VERSION:
        raise ValueError(f"version {value} of a code was made by a newer colorphase: update this one to read it")
    return value


class Pattern(Model):
    """The pattern that the projector shows."""

    error_type = CalibrationError

    period_px: Annotated[float, Field(ge=4, le=LARGEST)]  # projector px per cycle
    stripes: Literal["horizontal", "vertical"] = "horizontal"
    #: Code that identifies a place's cycle: "contrast": each cycle's modulation; "contrast2": that of its cells.
    code: CodeName | None = None
    code_version: Annotated[Literal[1], BeforeValidator(_known_version)] = _CODE_VERSION  # of its symbols
    cell_px: Annotated[float, Field(ge=_LEAST_CELL_PX, le=LARGEST)] | None = None  # projector px along the stripe
    compensated: bool | None = None  # whether the projector's response is undone in it; None: unknown

    @model_validator(mode="after")
    def _check(self) -> "Pattern":
        if (self.cell_px is None) == (self.code == "contrast2"):
            raise ValueError(
                "cell_px is how wide the cells of contrast2 are: give it with that code, and with no other"
            )
        return self


class ColorShift(Model):
    """Lateral colour: where R, G and B land, each (x, y) in px relative to the lens matrix."""

    error_type = CalibrationError

    camera: Shift
    projector: Shift


class Uncertainty(Model):
    """Standard deviations of what a calibration holds, under the same names."""

    error_type = CalibrationError

    crosstalk_matrix: Matrix3 | None = None
    response: Response | None = None
    camera: Vector9 | None = None  # fx, fy, cx, cy (px), k1 k2 p1 p2 k3
    projector: Vector9 | None = None
    rotation_deg: Vector3 | None = None
    translation_mm: Vector3 | None = None
    reprojection_px: tuple[NonNegative, NonNegative] | None = None  # RMS of corners' distances: camera, projector
    depth_bias_mm: NonNegative | None = None  # to be expected at the middle of the board's places


@dataclass(frozen=True)
class Geometry:
    """The lenses, and their poses: X_projector = rotation @ X_camera + translation_mm."""

    camera: Lens
    projector: Lens
    rotation: FloatArray  # (3, 3)
    translation_mm: FloatArray  # (3,)
    pattern: Pattern

    @property
    def phase_axis(self) -> int:
        """The projector axis along which the phase changes: 1 (rows) for horizontal stripes, 0 for vertical."""
        return 1 if self.pattern.stripes == "horizontal" else 0

    def for_triangulation(self) -> ProjectorGeometry:
        """Return what triangulation needs to know of the projector."""
        axis = self.phase_axis
        return ProjectorGeometry(
            rotation=self.rotation,
            translation_mm=self.translation_mm,
            focal_px=float(self.projector.matrix[axis, axis]),
            center_px=float(self.projector.matrix[axis, 2]),
            distortion=self.projector.distortion,
            period_px=self.pattern.period_px,
            axis=axis,
        )

    def projector_px(self, points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Return where the projector sees points (N, 3) in the camera's frame, mm: x and y, px, (N, 2)."""
        if len(points) == 0:  # OpenCV then returns nothing
            return np.zeros((0, 2))
        turn, lens = cv2.Rodrigues(self.rotation)[0], self.projector
        given = (np.ascontiguousarray(points), turn, self.translation_mm, lens.matrix, lens.distortion)
        pixels = cv2.projectPoints(*given)[0]
        return np.asarray(pixels[:, 0])

    def pattern_cycles(self, points: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Return the pattern's phase, in cycles, at points (N, 3) in the camera's frame, mm."""
        return self.projector_px(points)[:, self.phase_axis] / self.pattern.period_px

    def camera_px_along(self, depth_mm: float) -> float:
        """Return how many camera px a projector px is wide along the stripe, at this depth on the camera's axis."""
        middle, x1, y1 = self.projector_px(np.array([[0.0, 0, depth_mm], [1, 0, depth_mm], [0, 1, depth_mm]]))
        # mm that go one projector px along the stripe, and none across.
        along = np.linalg.solve(np.column_stack([x1 - middle, y1 - middle]), np.eye(2)[1 - self.phase_axis])
        return float(np.hypot(*(along * self.camera.matrix[[0, 1], [0, 1]] / depth_mm)))

    def rad_per_mm(self, depth_mm: float) -> float:
        """Return how much the phase changes per mm of depth on the camera's axis, rad."""
        near, far = self.pattern_cycles(np.array([[0, 0, depth_mm - 0.5], [0, 0, depth_mm + 0.5]]))
        return float(2 * np.pi * abs(far - near))

    def check_frame(self, size_px: tuple[int, int], what: str = "frame") -> None:
        """Refuse a frame of another size than the camera's, and name what its size can be.

        Parameters
        ----------
        size_px : (width, height)
            The frame's.
        what : str
            Name for messages.

        Raises
        ------
        CalibrationError
            It has another size.
        """
        here, there = (int(size_px[0]), int(size_px[1])), self.camera.size_px
        if here == there:
            return
        smaller, larger = np.divide(there, here), np.divide(here, there)
        factors = "{:.0f}x{:.0f}".format(*np.maximum(smaller, larger))
        convert = "convert the calibration: colorphase calibrate import"
        causes: tuple[tuple[Key, bool, str], ...] = (
            ("on its side", here == there[::-1], "turn it as the camera stood at calibration"),
            ("swapped", here == self.projector.size_px, "that is the projector's size: if the two are swapped in the "
             "calibration, calibrate geometry again"),
            ("binned", bool((smaller % 1 == 0).all()), f"its sides are {factors} times smaller: if the camera bins, "
             f"{convert} --binning {factors}; if it shows a part of its sensor, --region"),
            ("calibrated binned", bool((larger % 1 == 0).all()), f"its sides are {factors} times larger: set the "
             "binning and resolution of the calibration"),
            ("cropped", bool((smaller >= 1).all()), f"if the camera shows a part of its sensor, {convert} --region; a "
             "picture that was cut or scaled afterwards is of no use: cut by --roi"),
            ("another camera", True, "set the camera's resolution as at calibration, or calibrate it as it is now"),
        )  # fmt: skip
        key, cause = next((key, cause) for key, holds, cause in causes if holds)
        raise CalibrationError(Cause(key, f"{sizes_differ(what, here, 'the calibration is for', there)}: {cause}"))

    def working_distance_mm(self) -> float | None:
        """Return the depth at which the projector's axis comes closest to the camera's; None if they never meet.

        A projector turned towards the object meets the camera's axis there, which makes it the best guess of where the
        object is when no depth range is given.
        """
        # Closest point on the camera's axis (0, 0, s) to the projector's axis centre + k * direction.
        centre = -self.rotation.T @ self.translation_mm
        direction = self.rotation[2]
        sine_squared = 1 - direction[2] ** 2
        if sine_squared < 1e-6:
            return None
        depth = (centre[2] - direction[2] * (direction @ centre)) / sine_squared
        return float(depth) if depth > 0 else None


class Calibration(Model):
    """A calibrated rig, as ``calibration.json`` holds it: its light, its geometry, or both.

    X_projector = rotation @ X_camera + translation_mm, both frames OpenCV's (x right, y down, z forward). Without a
    geometry, which is those five together, there are phases but no millimetres.

    Examples
    --------
    >>> rig = colorphase.simulated_rig((160, 120), period_px=64)
    >>> rig
    <Calibration: camera 160x120 px, projector 1024x768 px, 180 mm apart, horizontal stripes of 64 px, code None>
    >>> rig.write("calibration.json")
    >>> f"{np.linalg.norm(colorphase.Calibration.read('calibration.json').translation_mm):.0f} mm apart"
    '180 mm apart'
    """

    error_type = CalibrationError

    camera: Lens | None = None
    projector: Lens | None = None
    rotation: Matrix3 | None = None
    translation_mm: Vector3 | None = None
    pattern: Pattern | None = None
    crosstalk_matrix: Matrix3 | None = None  # camera = matrix @ projector, in linear light
    response: Response | None = None  # linear light for each projector code
    wavelengths_nm: Matrix3 | None = None  # where camera channel i (row) sees primary j
    color_shift_px: ColorShift | None = None
    depth_range_mm: tuple[Positive, Positive] | None = None
    sensor: SensorPart | None = None  # the part of the camera's that its frames are; None: not known
    capture: CameraState | None = None
    uncertainty: Uncertainty | None = None
    scale_proof: ScaleProof | None = None  # None: all lengths are as wrong as the squares' side

    @model_validator(mode="after")
    def _check(self) -> "Calibration":
        lacking = [name for name in _GEOMETRY if getattr(self, name) is None]
        if "crosstalk_matrix" not in self.model_fields_set and len(lacking) == len(_GEOMETRY):
            raise ValueError("it holds neither a geometry (camera, projector ...) nor a crosstalk_matrix")
        if any(name not in ("pattern", *lacking) for name in _GEOMETRY):
            if lacking:
                raise ValueError(f"{lacking[0]}: is missing")
            self._check_geometry(self.geometry())
        if self.crosstalk_matrix is not None and np.linalg.cond(self.crosstalk_matrix) > MAX_CONDITION:
            raise ValueError("crosstalk_matrix cannot be inverted")
        if self.response is not None and (
            np.any(np.diff(self.response) < 0) or np.any(np.abs(self.response[:, [0, -1]] - [0, 1]) > 1e-6)
        ):
            raise ValueError("response must rise from 0 to 1 in every row")
        if self.wavelengths_nm is not None:
            own = np.diag(self.wavelengths_nm)
            if self.wavelengths_nm.min() < 380 or self.wavelengths_nm.max() > 780 or not (np.diff(own) < 0).all():
                raise ValueError("wavelengths_nm must lie from 380 to 780, red's own above green's above blue's")
        if self.depth_range_mm is not None and self.depth_range_mm[1] <= self.depth_range_mm[0]:
            raise ValueError("depth_range_mm must be [nearest, farthest]")
        return self

    def _check_geometry(self, geometry: Geometry) -> None:
        rotation, size = geometry.rotation, geometry.projector.size_px[geometry.phase_axis]
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation) < 0:
            raise ValueError("rotation must be a rotation matrix")
        if np.linalg.norm(geometry.translation_mm) == 0:
            raise ValueError("translation_mm must not be zero: without a baseline there is no depth")
        if geometry.pattern.period_px > size:
            raise ValueError(f"pattern.period_px is larger than the projector's {size} px")

    @property
    def has_geometry(self) -> bool:
        """True where it states the poses of camera and projector."""
        return self.camera is not None

    def geometry(self) -> Geometry:
        """Return the poses of camera and projector.

        Raises
        ------
        CalibrationError
            The calibration holds light only.
        """
        camera, projector, rotation, translation = self.camera, self.projector, self.rotation, self.translation_mm
        if camera is None or projector is None or rotation is None or translation is None or self.pattern is None:
            raise CalibrationError("the calibration holds no geometry: run colorphase calibrate geometry")
        return Geometry(camera, projector, rotation, translation, self.pattern)

    def cropped(self, x: int, y: int, size_px: tuple[int, int]) -> "Calibration":
        """Return the calibration of the same rig whose camera reads out a part of its frame only.

        Parameters
        ----------
        x, y : int
            The part's first column and row in the whole frame.
        size_px : (width, height)
            Its size.

        Raises
        ------
        CalibrationError
            It sticks out of the frame.
        """
        if self.camera is None:
            return self
        if x < 0 or y < 0 or x + size_px[0] > self.camera.size_px[0] or y + size_px[1] > self.camera.size_px[1]:
            part, whole = ("{}x{}".format(*px) for px in (size_px, self.camera.size_px))
            raise CalibrationError(f"{part} px at {x},{y} stick out of the camera's {whole} (width x height)")
        # The lens stays: its distortion counts from the axis, which moves in the image.
        matrix = self.camera.matrix - [[0, 0, x], [0, 0, y], [0, 0, 0]]
        camera = self.camera.replace(size_px=size_px, matrix=matrix)
        sensor = self.sensor
        if sensor is not None:
            (left, above), (across, down) = sensor.offset_px, sensor.binning
            sensor = sensor.replace(offset_px=(left + across * x, above + down * y))
        return self.replace(camera=camera, sensor=sensor)

    def binned(self, across: int, down: int) -> "Calibration":
        """Return the calibration of the same rig whose camera joins so many columns and rows to one.

        A row or column that is left over at the end is not read out.
        """
        if self.camera is None:
            return self
        factor = np.array([across, down])
        matrix = self.camera.matrix.copy()
        matrix[[0, 1], [0, 1]] /= factor
        matrix[:2, 2] = (matrix[:2, 2] + 0.5) / factor - 0.5  # 0 is the middle of the first pixel
        width, height = self.camera.size_px
        camera = self.camera.replace(size_px=(width // across, height // down), matrix=matrix)
        shift = self.color_shift_px
        if shift is not None:
            shift = shift.replace(camera=shift.camera / factor)
        uncertainty = self.uncertainty
        if uncertainty is not None:  # without what is in px of the whole frame
            uncertainty = uncertainty.replace(camera=None, reprojection_px=None)
        sensor = self.sensor
        if sensor is not None:
            sensor = sensor.replace(binning=(across * sensor.binning[0], down * sensor.binning[1]))
        return self.replace(camera=camera, color_shift_px=shift, uncertainty=uncertainty, sensor=sensor)

    def as_read_out(self, size_px: tuple[int, int], sensor: SensorPart | None, what: str = "frame") -> "Calibration":
        """Return the calibration of the same rig for frames of its camera, which may be cropped or binned since.

        Parameters
        ----------
        size_px : (width, height)
            The frames'.
        sensor : SensorPart, optional
            The part of the sensor that they are. Where it or the calibration's is not known, only sizes are compared.
        what : str
            Name for messages.

        Raises
        ------
        CalibrationError
            They are of another size or sensor, or show what was not calibrated.
        """
        lens, before = self.camera, self.sensor
        if lens is None:
            return self
        if sensor is None or before is None:
            self.geometry().check_frame(size_px, what)
            return self
        if (size_px, sensor) == (lens.size_px, before):
            return self
        key: Key = "another sensor"
        cause = "calibrate that camera"
        if sensor.sensor_px == before.sensor_px:
            first = np.subtract(sensor.offset_px, before.offset_px) / before.binning
            factor = np.divide(sensor.binning, before.binning)
            whole = not (first % 1).any() and not (factor % 1).any()
            if whole and (first >= 0).all() and (first + factor * size_px <= lens.size_px).all():
                width, height = (int(side) for side in factor * size_px)
                return self.cropped(int(first[0]), int(first[1]), (width, height)).binned(*map(int, factor))
            key, cause = "not calibrated", "set it as at calibration, or calibrate all of the sensor without binning"
        here, there = (
            "{}x{} on a sensor of {}".format(*size, part) for size, part in ((size_px, sensor), (lens.size_px, before))
        )
        raise CalibrationError(Cause(key, f"{what} is {here}, but the calibration is for {there}: {cause}"))

    @classmethod
    def read(cls, path: str | Path) -> "Calibration":
        """Read ``calibration.json``.

        Raises
        ------
        CalibrationError
            The file cannot be read, or a key is missing, unknown or wrong; the message names it.
        """
        return read_file(path, cls, _parse, CalibrationError)

    def write(self, path: str | Path, *, force: bool = True) -> None:
        """Write ``calibration.json``, whole or not at all.

        Raises
        ------
        OutputError
            The place cannot be written, or without `force` there is a file already.
        """
        if not force and Path(path).exists():
            raise OutputError(f"{path} exists already: choose another name, or add --force")
        write_atomically(Path(path), (json.dumps(self.model_dump(mode="json"), indent=1) + "\n").encode())

    def with_pattern(
        self,
        period_px: float | None = None,
        stripes: Literal["horizontal", "vertical"] | None = None,
        code: CodeChoice | None = None,
    ) -> "Calibration":
        """Return the calibration of the same rig under the pattern of `choose_pattern`."""
        return self.replace(pattern=choose_pattern(self, period_px, stripes, code))

    def responses(self) -> list[FloatArray]:
        """Return the light of the pattern's codes, (3, N) in 0..1; two where nobody knows whether it is undone."""
        compensated = None if self.pattern is None else self.pattern.compensated
        known = [] if self.response is None or compensated else [self.response]
        return [*known, _LINEAR] if compensated or (compensated is None and known) else known

    def projector_lag_rad(self) -> FloatArray | None:
        """Return by how much the projector's lateral colour delays R, G and B, (3,); None where none is known."""
        if self.color_shift_px is None or not self.has_geometry:
            return None
        geometry = self.geometry()
        return 2 * np.pi / geometry.pattern.period_px * self.color_shift_px.projector[:, geometry.phase_axis]

    def digest(self) -> str:
        """Return a SHA-256 of the contents, by which results name the calibration they were made with."""
        return hashlib.sha256(json.dumps(self.model_dump(mode="json"), sort_keys=True).encode()).hexdigest()

    def __repr__(self) -> str:
        lenses = (("camera", self.camera), ("projector", self.projector))
        parts = ["{} {}x{} px".format(name, *lens.size_px) for name, lens in lenses if lens is not None]
        if self.translation_mm is not None:
            parts.append(f"{np.linalg.norm(self.translation_mm):.0f} mm apart")
        if self.depth_range_mm is not None:
            parts.append("depth {:g} to {:g} mm".format(*self.depth_range_mm))
        if self.pattern is not None:
            parts.append(f"{self.pattern.stripes} stripes of {self.pattern.period_px:g} px, code {self.pattern.code}")
        if self.crosstalk_matrix is not None:
            parts.append("crosstalk measured")
        return f"<Calibration: {', '.join(parts) or 'nothing is known'}>"

    __str__ = __repr__

    def _repr_html_(self) -> str | None:
        return to_html(self)


def _parse(text: str) -> Any:
    """Return what JSON holds.

    Raises
    ------
    ValueError
        It is none.
    """
    if not text.lstrip().startswith("{"):
        raise ValueError("it is no JSON: those of OpenCV and Kalibr are converted by colorphase calibrate import")
    return json.loads(text)


def choose_pattern(
    known: Calibration | None,
    period_px: float | None,
    stripes: Literal["horizontal", "vertical"] | None,
    code: CodeChoice | None = None,
) -> Pattern:
    """Return the pattern that frames are taken with: what was named, else the calibration's, else the usual one.

    Cells of a pattern of which something was named are half a period wide, but by a geometry 4.5 camera px at least.

    Raises
    ------
    SettingsError
        There is no such pattern.
    """
    usual = Pattern(period_px=DEFAULT_PERIOD_PX, code=DEFAULT_CODE)
    before = known.pattern if known is not None and known.pattern is not None else usual
    chosen = (("period_px", period_px), ("stripes", stripes), ("code", code))
    named = {name: None if value == "none" else value for name, value in chosen if value is not None}
    if not named:
        return before
    values = before.model_dump() | named | {"cell_px": None}
    if values["code"] == "contrast2":
        values["cell_px"] = _cell_px(known, build(Pattern, values | {"code": None}, SettingsError, "pattern"))
    return build(Pattern, values, SettingsError, "pattern")


def _cell_px(known: Calibration | None, pattern: Pattern) -> float:
    cell_px = max(pattern.period_px / 2, _LEAST_CELL_PX)
    if known is None or not known.has_geometry:
        return cell_px
    geometry = replace(known.geometry(), pattern=pattern)
    depth_mm = geometry.working_distance_mm()
    return cell_px if depth_mm is None else max(cell_px, _LEAST_CELL_CAMERA_PX / geometry.camera_px_along(depth_mm))
