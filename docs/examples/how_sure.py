"""
How sure a depth is
===================

Every pixel has a standard deviation, ``point_sigma``. Here the truth is known, so that errors can be compared with it.
"""

import numpy as np
from matplotlib.figure import Figure

import colorphase

rig, scene = colorphase.simulated_rig(code="contrast"), colorphase.SimulationSettings(scene="bust")
truth = colorphase.simulate_frame(rig, scene)
calibration = rig.replace(crosstalk_matrix=scene.crosstalk_matrix)
frame = colorphase.Decoder(calibration=calibration, arch="cpu").decode(truth.image)
frame.plot("texture").savefig("texture.png")
frame.plot("point_sigma").savefig("sigma.png")

# %%
# The depth errors divided by their standard deviations. A normal distribution has 68 % within one and 95 % within two.

measured = frame.mask & truth.mask
ratio = ((frame.points - truth.points)[..., 2] / frame.point_sigma)[measured]
within = [np.mean(np.abs(ratio) < k) for k in (1, 2)]
print(f"{within[0]:.0%} of the errors within one sigma, {within[1]:.0%} within two")

figure = Figure(layout="compressed")
axes = figure.subplots()
axes.hist(ratio, bins=np.linspace(-5, 5, 101), density=True, label="measured")
x = np.linspace(-5, 5, 201)
axes.plot(x, np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi), label="normal distribution")
axes.set(xlabel="depth error / sigma", ylabel="density")
axes.legend()
figure.savefig("ratio.png")

# %%
# Sigma describes noise. It does not contain a constant that all phases of a surface share, as of skin before a grey
# wall. ``constant_sigma`` estimates it for the whole frame.

print(f"median phase sigma {np.median(frame.phase_sigma[measured]):.4f} rad")
print(f"sigma of the constant {frame.constant_sigma:.4f} rad")
