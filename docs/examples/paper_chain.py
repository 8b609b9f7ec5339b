"""The chain of Je, Lee and Park (2004), written with the public stages of `tikernels`.

python docs/examples/paper_chain.py

It measures a simulated bust from one colour frame, beside the truth. The decoder (`colorphase.Decoder`) goes further;
docs/accuracy.md says what each of its steps buys.
"""

import numpy as np
import numpy.typing as npt

import colorphase
import tikernels
from tikernels.phase import measure_frame

# Pixels whose mean of the three channels is below this share of full scale are too dark to be relied on.
MIN_INTENSITY = 0.05


def unwrap_frame(image: npt.NDArray[np.uint8], crosstalk_matrix: npt.ArrayLike) -> npt.NDArray[np.float32]:
    """Return the unwrapped phase of a frame with horizontal stripes, (H, W) float32, rad; NaN where it is dark."""
    period_px = measure_frame(image).period_px
    if period_px is None:
        raise ValueError("no fringe stands out of this frame")
    light = (image / 255).astype(np.float32)
    mask = light.mean(axis=2) > MIN_INTENSITY
    light = tikernels.correct_crosstalk(light, crosstalk_matrix)  # section 2.2
    balanced = tikernels.balance_color(light, period_px, mask)  # section 3.1
    phase, modulation, _ = tikernels.compute_wrapped_phase(balanced)  # equation 3.3
    phase = tikernels.equalize_phase(phase, mask, harmonics=int(period_px / 2))  # section 3.2
    phase = tikernels.smooth_phase(phase, mask)  # the "simple mean filter" of section 5
    unwrapped = tikernels.unwrap_phase(phase, modulation, mask)  # section 4.1
    return tikernels.correct_fringe_order(unwrapped, np.isfinite(unwrapped))  # section 4.2


def main() -> None:
    """Simulate a frame, unwrap it and print how far the phase is from the truth."""
    tikernels.init("cpu")
    settings = colorphase.SimulationSettings(scene="bust")
    truth = colorphase.simulate_frame(colorphase.simulated_rig(), settings)
    unwrapped = unwrap_frame(truth.image, settings.crosstalk_matrix)
    measured = np.isfinite(unwrapped) & truth.mask
    error = np.exp(1j * (unwrapped - truth.phase)[measured])  # modulo a cycle
    constant = np.angle(error.mean())
    rms = np.sqrt((np.angle(error * np.exp(-1j * constant)) ** 2).mean())
    print(f"{measured.sum() / truth.mask.sum():.1%} of the lit pixels, phase error {rms:.3f} rad RMS")
    print(f"about a constant of {constant:+.3f} rad, {np.ptp(unwrapped[measured]) / (2 * np.pi):.0f} cycles in view")


if __name__ == "__main__":
    main()
