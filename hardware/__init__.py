"""The rig: trigger sources, cameras and projectors that are wired to this machine, and what pairs their frames."""

from typing import TYPE_CHECKING

from tikernels.lazy_names import lazily

if TYPE_CHECKING:
    from hardware.camera import CameraListing, list_cameras, open_camera
    from hardware.display import Display, list_displays
    from hardware.errors import BurstError, CameraError, ProjectorError, RigError, TriggerError
    from hardware.instruments import open_instruments
    from hardware.link import list_serial_ports
    from hardware.projector import open_projector
    from hardware.protocols import (
        Camera,
        CameraFrame,
        CameraLimits,
        FrameFormat,
        Identity,
        Projector,
        ProjectorStatus,
        SensorPart,
        Strobe,
        Trigger,
        TriggerStatus,
    )
    from hardware.pulses import Pulse, PulseTrain, TriggerLimits
    from hardware.rig import Burst, PairedFrame, Rejected, Rig
    from hardware.settings import CameraSettings, ProjectorSettings, RigSettings, TimingSettings, TriggerSettings
    from hardware.trigger import open_trigger

__all__ = [
    "Burst",
    "BurstError",
    "Camera",
    "CameraError",
    "CameraFrame",
    "CameraLimits",
    "CameraListing",
    "CameraSettings",
    "Display",
    "FrameFormat",
    "Identity",
    "PairedFrame",
    "Projector",
    "ProjectorError",
    "ProjectorSettings",
    "ProjectorStatus",
    "Pulse",
    "PulseTrain",
    "Rejected",
    "Rig",
    "RigError",
    "RigSettings",
    "SensorPart",
    "Strobe",
    "TimingSettings",
    "Trigger",
    "TriggerError",
    "TriggerLimits",
    "TriggerSettings",
    "TriggerStatus",
    "list_cameras",
    "list_displays",
    "list_serial_ports",
    "open_camera",
    "open_instruments",
    "open_projector",
    "open_trigger",
]
__getattr__, __dir__ = lazily(__name__)
