"""
How sure a depth is
===================

Every pixel has a standard deviation, ``point_sigma``. Here the truth is known, so that errors can be compared with it.
"""

import numpy as np
from matplotlib.figure import Figure

import colorphase

rig, scene = colorphase.simulated_rig(code="contrast"), colorphase.SimulationSettings(scene="portrait")
truth = colorphase.simulate_frame(rig, scene)
calibration = rig.replace(crosstalk_matrix=scene.crosstalk_matrix)
frame = colorphase.Decoder(calibration=calibration, arch="cpu").decode(truth.image)
frame.plot("texture").savefig("texture.png")
frame.plot("point_sigma").savefig("sigma.png")

# %%
# The depth errors divided by their standard deviations. A normal distribution has 68 % within one and 95 % within two.

measured = frame.mask & truth.mask
error = (frame.points[..., 2] - truth.points[..., 2])[measured]  # mm
ratio = error / frame.point_sigma[measured]
shares = [float(np.mean(np.abs(ratio) < k)) for k in (1, 2)]
print(f"median error {np.median(np.abs(error)):.3f} mm, {shares[0]:.0%} within one sigma, {shares[1]:.0%} within two")

figure = Figure(layout="compressed")
axes = figure.subplots()
axes.hist(ratio, bins=np.linspace(-5, 5, 101), density=True, label="measured")
x = np.linspace(-5, 5, 201)
axes.plot(x, np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi), label="normal distribution")
axes.set(xlabel="depth error / sigma", ylabel="density")
axes.legend()
figure.savefig("ratio.png")
