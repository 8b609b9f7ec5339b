"""Shape from one colour photograph: the way in.

``import colorphase`` gives all public names: decoder, settings, calibration, stored results, meshes, simulation, live
decoding, the rig, and errors. Each is imported when it is first used. They live in the packages next to this file:
`pipeline`, with one room for each of these subjects, `tikernels`, where each stage of decoding is a function of its
own, and `hardware`.
"""

import sys
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING


def _refuse_namesakes() -> None:
    """Refuse a file of somebody else's that would be imported in place of one of the packages.

    Raises
    ------
    ImportError
        There is one; the message names it.
    """
    # The packages are next to this file, which in a wheel is `colorphase/__init__.py`.
    file = Path(__file__)
    folder = file.parent.parent if file.stem == "__init__" else file.parent
    for package in ("tikernels", "pipeline", "hardware"):
        if package in sys.modules:
            found = getattr(sys.modules[package], "__file__", None)
        else:
            spec = find_spec(package)
            found = None if spec is None else spec.origin
        own = folder / package
        if found is not None and own.is_dir() and not own.samefile(Path(found).parent):
            raise ImportError(f"{found} is in the way of colorphase's own package {package}: rename it")


_refuse_namesakes()

from pipeline import __version__ as __version__
from tikernels.lazy_names import lazily

if TYPE_CHECKING:
    from hardware.errors import BurstError, CameraError, ProjectorError, RigError, TriggerError
    from hardware.instruments import open_instruments
    from hardware.rig import Burst, PairedFrame, Rig
    from hardware.settings import RigSettings
    from pipeline.acquisition import LiveDecoder, LiveFrame, read_rig
    from pipeline.batch import Crop, DecodeProgress, DecodeSummary, decode_footage
    from pipeline.calibration import Calibration
    from pipeline.decoder import Decoder
    from pipeline.decoding import DecodedFrame, FrameFields, LightEstimate, RigState
    from pipeline.errors import (
        CalibrationError,
        ClusterError,
        DamageError,
        DecodeWarning,
        FootageError,
        OutputError,
        RenderError,
        SettingsError,
    )
    from pipeline.footage import Footage, StoredAs, open_footage, read_image
    from pipeline.output import Mesh, MeshOptions, ResultFrame, StoredResult, frame_mesh, read_mesh, write_mesh
    from pipeline.recording import Recorder
    from pipeline.settings import DecodeSettings
    from pipeline.simulation import SimulatedFrame, SimulationSettings, simulate_frame, simulated_rig
    from tikernels.errors import DeviceNotReady, Error, ShapeError, SlowStart
    from tikernels.raw.pixel_format import PixelFormat
    from tikernels.runtime import init, supported_archs
    from tikernels.unwrapping import UserUnwrapper

__all__ = [
    "Burst",
    "BurstError",
    "Calibration",
    "CalibrationError",
    "CameraError",
    "ClusterError",
    "Crop",
    "DamageError",
    "DecodeProgress",
    "DecodeSettings",
    "DecodeSummary",
    "DecodeWarning",
    "DecodedFrame",
    "Decoder",
    "DeviceNotReady",
    "Error",
    "Footage",
    "FootageError",
    "FrameFields",
    "LightEstimate",
    "LiveDecoder",
    "LiveFrame",
    "Mesh",
    "MeshOptions",
    "OutputError",
    "PairedFrame",
    "PixelFormat",
    "ProjectorError",
    "Recorder",
    "RenderError",
    "ResultFrame",
    "Rig",
    "RigError",
    "RigSettings",
    "RigState",
    "SettingsError",
    "ShapeError",
    "SimulatedFrame",
    "SimulationSettings",
    "SlowStart",
    "StoredAs",
    "StoredResult",
    "TriggerError",
    "UserUnwrapper",
    "decode_footage",
    "frame_mesh",
    "init",
    "open_footage",
    "open_instruments",
    "read_image",
    "read_mesh",
    "read_rig",
    "simulate_frame",
    "simulated_rig",
    "supported_archs",
    "write_mesh",
]
__getattr__, __dir__ = lazily(__name__)

if __name__ == "__main__":
    from pipeline.cli.start import main

    main()
