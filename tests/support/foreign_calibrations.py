"""A simulated rig's calibration as other programs write it: OpenCV, Kalibr, MATLAB."""

import cv2
import numpy as np

from pipeline.simulation import simulated_rig

CAMERA_PX, PROJECTOR_PX = (64, 48), (1024, 768)


def rig(camera=(-0.2, 0.05, 1e-3, -1e-3, 0.01), projector=(0.1, -0.05, 1e-3, 2e-3, 0.0)):
    return simulated_rig(CAMERA_PX, tilt_deg=3, period_px=16, camera_distortion=camera, projector_distortion=projector)


def opencv(
    path,
    truth,
    names=("cameraMatrix1", "distCoeffs1", "cameraMatrix2", "distCoeffs2"),
    unit_mm=1.0,
    vectors=np.atleast_2d,
):
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    lenses = (truth.camera.matrix, truth.camera.distortion, truth.projector.matrix, truth.projector.distortion)
    for name, values in zip(names, lenses, strict=True):
        storage.write(name, vectors(values))
    storage.write("R", np.asarray(truth.rotation))
    storage.write("T", np.asarray(truth.translation_mm / unit_mm)[:, None])
    storage.release()


def kalibr(truth, model="radtan"):
    """Return what PyYAML writes of it: lists in one line of 80 characters, or continued on the next."""
    step = np.vstack([np.column_stack([truth.rotation, truth.translation_mm / 1000]), [0, 0, 0, 1]])
    lines = []
    for name, lens in (("cam0", truth.camera), ("cam1", truth.projector)):
        lines += [f"{name}:"]
        if name == "cam1":
            lines += ["  T_cn_cnm1:", *(f"  - {list(map(float, row))}".replace(", ", ",\n    ", 1) for row in step)]
        m = lens.matrix
        intrinsics = [float(value) for value in (m[0, 0], m[1, 1], m[0, 2], m[1, 2])]
        lines += [
            "  cam_overlaps: [1]",
            "  camera_model: pinhole",
            f"  distortion_coeffs: {list(map(float, lens.distortion[:4]))}",
            f"  distortion_model: {model}",
            f"  intrinsics: {intrinsics}",
            f"  resolution: {list(lens.size_px)}",
            f"  rostopic: /{name}/image_raw",
        ]
    return "\n".join(lines) + "\n"


def matlab(truth, units="millimeters"):
    def device(lens):
        matrix = lens.matrix.copy()
        matrix[:2, 2] += 1
        k1, k2, p1, p2, k3 = lens.distortion
        return {
            "RadialDistortion": [k1, k2, k3] if k3 else [k1, k2],
            "TangentialDistortion": [p1, p2],
            "ImageSize": lens.size_px[::-1],
            "WorldUnits": units,
            "IntrinsicMatrix": matrix.T.tolist(),
        }

    return {
        "CameraParameters1": device(truth.camera),
        "CameraParameters2": device(truth.projector),
        "RotationOfCamera2": truth.rotation.T.tolist(),
        "TranslationOfCamera2": truth.translation_mm.tolist(),
    }
