"""
The chain of 2004, step by step
===============================

C. Je, S. W. Lee and R.-H. Park, *Color-phase analysis for sinusoidal structured light in rapid range imaging* (2004),
as functions of ``tikernels``: arrays in, arrays out. ``Decoder`` goes further.
"""

import numpy as np
from matplotlib.figure import Figure

import colorphase
import tikernels
from tikernels.phase import measure_frame

tikernels.init("cpu")
scene = colorphase.SimulationSettings(scene="bust")
truth = colorphase.simulate_frame(colorphase.simulated_rig(), scene)

# %%
# From the picture to linear light. Pixels with a mean below 5 % of full scale are too dark.

period_px = measure_frame(truth.image).period_px
light = (truth.image / 255).astype(np.float32)
mask = light.mean(axis=2) > 0.05

# %%
# The sections and equations are those of the paper.

light = tikernels.correct_crosstalk(light, scene.crosstalk_matrix)  # section 2.2
balanced = tikernels.balance_color(light, period_px, mask)  # section 3.1
phase, modulation, _ = tikernels.compute_wrapped_phase(balanced)  # equation 3.3
phase = tikernels.equalize_phase(phase, mask, harmonics=int(period_px / 2))  # section 3.2
phase = tikernels.smooth_phase(phase, mask)  # the "simple mean filter" of section 5
unwrapped = tikernels.unwrap_phase(phase, modulation, mask)  # section 4.1
unwrapped = tikernels.correct_fringe_order(unwrapped, np.isfinite(unwrapped))  # section 4.2

# %%
# Its error, modulo a cycle and about a common constant.

measured = np.isfinite(unwrapped) & truth.mask
difference = np.where(measured, unwrapped - truth.phase, np.nan)
constant = np.angle(np.nanmean(np.exp(1j * difference)))
error = np.angle(np.exp(1j * (difference - constant)))
share, rms = measured.sum() / truth.mask.sum(), np.sqrt(np.nanmean(error**2))
print(f"{share:.1%} of the lit pixels, phase error {rms:.3f} rad RMS")
n_cycles = np.ptp(unwrapped[measured]) / (2 * np.pi)
print(f"about a constant of {constant:+.3f} rad, {n_cycles:.0f} cycles in view")

figure = Figure(figsize=(10, 4), layout="compressed")
frame_axes, phase_axes, error_axes = figure.subplots(1, 3)
frame_axes.imshow(truth.image)
frame_axes.set(title="frame", xticks=[], yticks=[])
shown = ((phase_axes, phase, "wrapped phase, rad", np.pi), (error_axes, error, "error, rad", 0.2))
for axes, values, title, limit in shown:
    image = axes.imshow(values, cmap="RdBu_r", vmin=-limit, vmax=limit)
    axes.set(title=title, xticks=[], yticks=[])
    figure.colorbar(image, ax=axes, shrink=0.7)
figure.savefig("chain.png")
