"""Height and tilt of a table, with error bars, from the path of a tip that slides on it.

    python examples/learn_a_surface.py [figure.png]

The scene says that the table is level at 55 mm; in truth it is 8 mm lower and tilted by 3 degrees.
"""

# %% Four seconds of sliding on the true table
import dataclasses
import math
import sys

import matplotlib.pyplot as plt
import torch

import forcegp
from forcegp.logs.surface_fit import fit_surface
from forcegp.simulate import SimulationConfig, simulate

figure = next((x for x in sys.argv[1:] if x.endswith(".png")), "learn_a_surface.png")
torch.manual_seed(0)
system = forcegp.load_scene("kuka_plane").system()
(table,) = system.contacts
tilt = math.radians(3.0)
true = forcegp.Plane(normal=(math.sin(tilt), 0.0, math.cos(tilt)), offset=0.047)
truth = dataclasses.replace(system, contacts=[dataclasses.replace(table, surface=true)])
data = simulate(truth, SimulationConfig(duration=4.0)).data
data = data.replace(q=data.q + 1e-4 * torch.randn_like(data.q))  # encoders are off by 0.1 mrad

# %% The plane through the path of the tip, as a line for the scene file
found = fit_surface(data, system, "table")
print(found.toml(), end="")
normal = torch.tensor(found.surface.normal, dtype=torch.float64)
angle = torch.rad2deg(torch.acos(normal @ torch.tensor(true.normal, dtype=torch.float64)))
bar = math.degrees(found.std["tilt"])
print(f"the learned normal is {angle:.4f} degrees off the true one, with an error bar of {bar:.4f} (1 sigma)")

# %% How far the tip is from the table that the scene claims, and from the one that was learned
learned = dataclasses.replace(system, contacts=[dataclasses.replace(table, surface=found.surface)])
fig, ax = plt.subplots(figsize=(7, 3), layout="constrained")
for name, one in {"claimed": system, "learned": learned}.items():
    distance = 1e3 * one.equations(data.q, data.qd).c[:, 0]
    print(f"distance of the tip from the {name} table: {distance.abs().mean():.3f} mm on average")
    ax.plot(data.t, distance, label=name)
ax.set(xlabel="time [s]", ylabel="distance of the tip [mm]")
ax.legend()
fig.savefig(figure, dpi=150)
print(f"figure: {figure}")
