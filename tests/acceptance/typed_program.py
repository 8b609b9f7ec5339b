"""A program that uses the public names as its author would; `test_wheel.py` has a type checker read it."""

from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path

import numpy as np
import numpy.typing as npt

import colorphase
from colorphase import (
    Burst,
    BurstError,
    Calibration,
    CalibrationError,
    CameraError,
    ClusterError,
    Crop,
    DamageError,
    DecodedFrame,
    DecodeProgress,
    Decoder,
    DecodeSettings,
    DecodeSummary,
    DecodeWarning,
    DeviceNotReady,
    Error,
    Footage,
    FootageError,
    FrameFields,
    LightEstimate,
    LiveDecoder,
    LiveFrame,
    Mesh,
    MeshOptions,
    OutputError,
    PairedFrame,
    PixelFormat,
    ProjectorError,
    Recorder,
    RenderError,
    ResultFrame,
    Rig,
    RigError,
    RigSettings,
    RigState,
    SettingsError,
    ShapeError,
    SimulatedFrame,
    SimulationSettings,
    SlowStart,
    StoredAs,
    StoredResult,
    TriggerError,
    UserUnwrapper,
)

FAULTS: tuple[type[Error], ...] = (
    BurstError,
    CalibrationError,
    CameraError,
    ClusterError,
    DamageError,
    DeviceNotReady,
    FootageError,
    OutputError,
    ProjectorError,
    RenderError,
    RigError,
    SettingsError,
    ShapeError,
    TriggerError,
)
WARNINGS: tuple[type[UserWarning], ...] = (DecodeWarning, SlowStart)


class OwnUnwrapper:
    """Gives every pixel the order 0."""

    def unwrap(
        self, phase: npt.NDArray[np.float32], quality: npt.NDArray[np.float32]
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int32]]:
        """Return the phase as it is, and one region."""
        return phase, np.isfinite(phase).astype(np.int32)


def own() -> Decoder:
    """Return a decoder with an unwrapper of its user."""
    unwrapper: UserUnwrapper = OwnUnwrapper()
    return Decoder(DecodeSettings(), unwrapper=unwrapper)


def simulate(size_px: tuple[int, int]) -> SimulatedFrame:
    """Simulate a frame."""
    rig: Calibration = colorphase.simulated_rig(size_px, code="contrast")
    settings = SimulationSettings(scene="plane", crosstalk_matrix=np.eye(3), exposure=1.5, reflectance=(0.8, 0.8, 0.8))
    return colorphase.simulate_frame(rig, settings.replace(bits=12))


def decode(truth: SimulatedFrame, path: Path) -> float:
    """Decode it, and return the mean depth, mm."""
    print(colorphase.supported_archs(), colorphase.init("cpu"))
    settings = DecodeSettings(camera_period_px=12, noise=(1.5, 0.0), crosstalk_matrix=np.eye(3))
    calibration = truth.rig.replace(depth_range_mm=(700, 1100))
    decoder = Decoder(settings, calibration, arch="cpu", unwrapper=None)
    frame: DecodedFrame = decoder.decode(truth.image)
    frame = decoder.decode(truth.image, previous=frame)
    state: RigState = decoder.state
    light: LightEstimate | None = state.light
    if light is not None:
        print(light.crosstalk_matrix.shape)
    mesh: Mesh = colorphase.frame_mesh(frame)
    colorphase.write_mesh(mesh, path)
    again = colorphase.read_mesh(path, axes="y-up", unit="mm")
    points: npt.NDArray[np.float32] | None = frame.points
    assert points is not None and again.vertices.shape[1] == 3
    return float(points[frame.mask][:, 2].mean()) + float(frame.phase_sigma[frame.mask].mean())


def capture(path: Path) -> Iterator[tuple[int, tuple[int, ...]]]:
    """Fire bursts, record them, and yield every frame's pulse and shape."""
    settings: RigSettings = colorphase.read_rig(path)
    timing = settings.timing.replace(frames=3)
    settings = RigSettings(trigger=settings.trigger, timing=timing, camera=settings.camera)
    with (
        Rig(settings, lambda: colorphase.open_instruments(settings)) as rig,
        Recorder(path.with_suffix(".zarr"), PixelFormat("rgb", bits=8), rate_hz=Fraction(20)) as recorder,
    ):
        burst: Burst
        for burst in rig.bursts():
            paired: PairedFrame
            for paired in burst.frames:
                recorder.add(paired.image)
                yield paired.pulse, paired.image.shape


def describe(frame: FrameFields) -> str:
    """Say where any frame comes from, and how far its median pixel is."""
    depth: npt.NDArray[np.float32] = frame.range_image
    points: npt.NDArray[np.float32] | None = frame.points
    mask: npt.NDArray[np.bool_] = frame.mask
    known = mask.sum() if points is not None else 0
    return f"{frame.number} at {frame.time_s} s: {np.nanmedian(depth)} {frame.range_unit}, {known} points"


def read(path: Path, out: Path) -> list[str]:
    """Decode footage frame by frame, then into a store."""
    heard: list[DecodeProgress] = []
    footage: Footage
    with colorphase.open_footage(path) as footage:
        images: list[tuple[int, ...]] = [image.shape for image in footage.images(0, 2)]
        said = [describe(frame) for frame in own().decode_all(footage, on_bad="skip")]
    summary: DecodeSummary = colorphase.decode_footage(
        path, out, crop=Crop(0, 0, 64, 64), stored_as=StoredAs(bits=8), progress=heard.append
    )
    return [*said, str(images), f"{summary.n_frames} frames, {len(heard)} reports"]


def follow(path: Path, size_px: tuple[int, int]) -> None:
    """Decode live, and look at a result that is stored."""
    with LiveDecoder(size_px, DecodeSettings(), format=PixelFormat("rgb", channels="bgr")) as live:
        shown: LiveFrame | None = live.latest()
        print(shown, live.ended)
    stored = StoredResult(path)
    frames: list[ResultFrame] = stored[1:]
    depth = [float(np.nanmean(frame.range_image)) for frame in frames]
    mesh = colorphase.frame_mesh(stored[0], MeshOptions(max_triangles=1000))
    print(depth, len(stored), mesh.unit, describe(stored[0]))
    image = colorphase.read_image(path)
    print(image.shape)
