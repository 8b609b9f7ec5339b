"""Calibrations of other programs: OpenCV's and Moreno and Taubin's files, Kalibr's camera chains, MATLAB's structures.

The first device is the camera and the second one the projector. All of them bring a point of the first into the frame
of the second; MATLAB multiplies rows, so that its matrices are the transposes, and counts pixels from 1.
"""

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipeline.calibration.model import Calibration, Pattern
from pipeline.errors import CalibrationError
from pipeline.limits import read_text
from pipeline.models import FloatArray, build

# Names of camera's and projector's matrix and coefficients, of OpenCV's sample and manual, and Moreno and Taubin's.
_OPENCV = (
    ("cameraMatrix1", "distCoeffs1", "cameraMatrix2", "distCoeffs2"),
    ("M1", "D1", "M2", "D2"),
    ("cam_K", "cam_kc", "proj_K", "proj_kc"),
)
# Matrices, and vectors, which OpenCV 5 stores as "nd-matrix"; their names and numbers.
_YAML_MATRIX = re.compile(
    r"^(\w+):\s*!!opencv-(?:nd-)?matrix\s(?:(?!\n\S).)*?data:\s*\[([^\]]*)\]", re.MULTILINE | re.DOTALL
)
_XML_MATRIX = re.compile(r"<(\w+) type_id=\"opencv-(?:nd-)?matrix\">(?:(?!</\1>).)*?<data>([^<]*)</data>", re.DOTALL)
# MATLAB's names of units, in mm.
_UNITS_MM = {"mm": 1.0, "millimeters": 1.0, "cm": 10.0, "centimeters": 10.0, "m": 1000.0, "meters": 1000.0, "in": 25.4}
_SKEW = "the pixels are skewed, which no lens here has: calibrate without skew"


@dataclass(frozen=True)
class _Lens:
    matrix: Any
    distortion: Any
    size_px: tuple[int, int] | None = None  # None: the file does not state it


@dataclass(frozen=True)
class _Rig:
    camera: _Lens
    projector: _Lens
    rotation: Any
    translation: FloatArray  # (3,) units
    unit_mm: float | None  # None: the file does not state it


def read_foreign(
    path: Path,
    pattern: Pattern,
    camera_px: tuple[int, int] | None,
    projector_px: tuple[int, int] | None,
    mm_per_unit: float | None,
) -> Calibration:
    """Read a rig's geometry from a file of OpenCV (YAML, XML), Kalibr (camchain.yaml) or MATLAB (toStruct, as JSON).

    Parameters
    ----------
    path : Path
        The file; a ``calibration.json`` is returned as it is.
    pattern : Pattern
        Pattern of the frames.
    camera_px, projector_px : (width, height), optional
        Sizes where the file states none.
    mm_per_unit : float, optional
        The unit of its lengths, where the file does not state it.

    Raises
    ------
    CalibrationError
        It is none of these, lacks something, or holds a lens of another model.
    """
    try:
        text = read_text(path)
        if text.lstrip().startswith("{"):
            values = json.loads(text)
            if "CameraParameters1" not in values:
                return Calibration.read(path)
            rig = _matlab(values)
        elif re.search(r"^cam0:", text, re.MULTILINE):
            rig = _kalibr(text)
        else:
            rig = _opencv(text)
    except OSError as error:
        raise CalibrationError(f"cannot read {path}: {error.strerror or error}") from None
    except (KeyError, IndexError, TypeError, AttributeError) as error:
        raise CalibrationError(f"{path} is not what it should be: {error} is missing or wrong") from None
    except (ValueError, RecursionError) as error:
        raise CalibrationError(f"{path} is not what it should be: {str(error).splitlines()[0]}") from None
    unit_mm = rig.unit_mm if mm_per_unit is None else mm_per_unit
    if unit_mm is None:
        raise CalibrationError(
            f"{path} does not state its unit: give --mm-per-unit, 1 for mm, 1000 for m, or a square's side in mm where "
            "squares were counted"
        )
    lenses: dict[str, Any] = {}
    for name, lens, given in (("camera", rig.camera, camera_px), ("projector", rig.projector, projector_px)):
        size_px = lens.size_px or given
        if size_px is None:
            raise CalibrationError(f"{path} does not state the {name}'s size: give --{name}-size")
        lenses[name] = {"size_px": size_px, "matrix": lens.matrix, "distortion": lens.distortion}
    values = {
        **lenses,
        "rotation": rig.rotation,
        "translation_mm": unit_mm * rig.translation,
        "pattern": pattern.model_dump(),
    }
    return build(Calibration, values, CalibrationError, str(path))


def _opencv(text: str) -> _Rig:
    """Read OpenCV's storage of matrices, YAML or XML; its own reader ends the program on some damaged files."""
    found = {}
    for pattern in (_YAML_MATRIX, _XML_MATRIX):
        for name, numbers in pattern.findall(text):
            found[name] = np.array(re.split(r"[\s,]+", numbers.strip(" \n,")), np.float64)
    if "camera_matrix" in found:
        raise ValueError("it holds one lens, and a rig has two and a step between them: calibrate them as a pair")
    names = next((names for names in _OPENCV if found.keys() >= {*names, "R", "T"}), None)
    if names is None:
        raise ValueError(f"it holds no calibration of OpenCV ({', '.join(_OPENCV[0])}, R, T), Kalibr or MATLAB")
    first, bent, second, other = (found[name] for name in names)
    lenses = _Lens(first.reshape(3, 3), bent), _Lens(second.reshape(3, 3), other)
    return _Rig(*lenses, found["R"].reshape(3, 3), found["T"], None)


def _kalibr(text: str) -> _Rig:
    """Read the few keys that matter of Kalibr's YAML, which PyYAML has written: two levels, lists in brackets."""
    devices: dict[str, dict[str, Any]] = {}
    # Long lists continue on the next line.
    for line in re.sub(r",\s*\n\s*", ", ", text).splitlines():
        if found := re.fullmatch(r"(cam\d+):\s*", line):
            key, device = "", devices.setdefault(found[1], {})
        elif devices and (found := re.fullmatch(r"\s+(\w+):\s*(.*)", line)):
            key = found[1]
            device[key] = json.loads(found[2]) if found[2].startswith("[") else found[2] or []
        elif devices and key and (found := re.fullmatch(r"\s*-\s*(\[.*\])", line)):
            device[key].append(json.loads(found[1]))
    lenses = []
    for name in ("cam0", "cam1"):
        device = devices[name]
        model = f"{device['camera_model']}-{device['distortion_model']}"
        if model != "pinhole-radtan":
            raise ValueError(f"{name} is {model}, and pinhole-radtan is read: calibrate with that")
        fx, fy, cx, cy = device["intrinsics"]
        matrix = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]
        lenses.append(_Lens(matrix, device["distortion_coeffs"], tuple(device["resolution"])))
    step = np.array(devices["cam1"]["T_cn_cnm1"], np.float64)
    return _Rig(lenses[0], lenses[1], step[:3, :3], step[:3, 3], 1000.0)


def _matlab(values: dict[str, Any]) -> _Rig:
    """Read `toStruct` of stereoParameters, written by jsonencode."""
    lenses, units = [], None
    for name in ("CameraParameters1", "CameraParameters2"):
        device = values[name]
        matrix = np.array(device["K"] if "K" in device else np.transpose(device["IntrinsicMatrix"]), np.float64)
        if matrix[0, 1] != 0:
            raise ValueError(_SKEW)
        matrix[:2, 2] -= 1
        k1, k2, *k3 = device["RadialDistortion"]
        height, width = device["ImageSize"]
        lenses.append(_Lens(matrix, [k1, k2, *device["TangentialDistortion"], *k3], (width, height)))
        units = device.get("WorldUnits")
    rotation = np.transpose(values["RotationOfCamera2"])
    translation = np.array(values["TranslationOfCamera2"], np.float64).ravel()
    return _Rig(lenses[0], lenses[1], rotation, translation, _UNITS_MM.get(str(units)))
