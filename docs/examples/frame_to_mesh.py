"""One colour frame becomes a mesh in millimetres.

python docs/examples/frame_to_mesh.py

The frame is a simulated one; with a camera's, read the image from a file and the calibration from calibration.json.
"""

import numpy as np

import colorphase


def main() -> None:
    """Decode a frame, write `mesh.ply` into the current folder and say what is in it."""
    rig, scene = colorphase.simulated_rig(), colorphase.SimulationSettings(scene="ball")
    calibration = rig.replace(crosstalk_matrix=scene.crosstalk_matrix)
    decoder = colorphase.Decoder(colorphase.DecodeSettings(), calibration, arch="cpu")
    frame = decoder.decode(colorphase.simulate_frame(rig, scene).image)
    mesh = colorphase.frame_mesh(frame)
    colorphase.write_mesh(mesh, "mesh.ply")
    near, far = np.nanpercentile(frame.range_image, (1, 99))
    print(f"mesh.ply: {len(mesh.vertices)} points between {near:.0f} and {far:.0f} mm, {len(mesh.faces)} triangles")
    print(
        f"phase sigma {np.nanmedian(frame.phase_sigma):.4f} rad, depth sigma {np.nanmedian(frame.point_sigma):.3f} mm"
    )


if __name__ == "__main__":
    main()
