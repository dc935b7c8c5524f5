"""A bucket hangs on the tip of an arm and is filled: its mass is followed sample by sample, with error bars.

    python examples/payload_followed_online.py [figure.png]

`update` adds samples to a sparse fit at a cost that does not depend on how many it has seen, and `forget`
lets old ones fade. After a jump the estimate lags by the memory of half a second; the error bars assume that
the mass is constant over it.
"""

# %% A slow motion of a double pendulum, on which the bucket pulls with its weight
import math
import sys

import matplotlib.pyplot as plt
import torch

import forcegp
from forcegp import dynamics, kinematics
from forcegp.gp.kernels import Constant

figure = next((x for x in sys.argv[1:] if x.endswith(".png")), "payload_followed_online.png")
torch.manual_seed(0)
system = forcegp.ConstrainedSystem(forcegp.load_robot("double_pendulum"))
DT, MEMORY = 0.02, 0.5
t = DT * torch.arange(500, dtype=torch.float64)
mass = torch.where(t < 5.0, 1.0, 2.5)  # 1.5 kg of water are poured in after five seconds


def weight(system: forcegp.ConstrainedSystem, at) -> torch.Tensor:
    """Generalized force of one kilogram at the tip, (n, 2, 1)."""
    return -9.81 * kinematics.point_jacobian(system.robot, at.q, "tip")[:, 2, :, None]


phase = t[:, None] * torch.tensor([0.8, 1.1], dtype=torch.float64)
q, qd, qdd = 0.8 + 0.4 * phase.sin(), 0.4 * phase.cos(), 0.0 * phase
J = kinematics.point_jacobian(system.robot, q, "tip")
tau = dynamics.inverse_dynamics(system.robot, q, qd, qdd) + 9.81 * mass[:, None] * J[:, 2]
tau = tau + 0.5 * torch.randn_like(tau)  # noise of the torque sensors
data = forcegp.Dataset(t=t, q=q, qd=qd, tau=tau, qdd=qdd, joint_names=system.robot.joint_names)

# %% The mass is an unknown constant f, and E(x) f with E from `weight` is what it does to the joints
prior = forcegp.priors.OperatorForcePrior(
    "mass", 1, weight, lambda system, at: {"one": torch.zeros_like(at.q[:, :1])}, Constant(group=1)
)
noise = forcegp.Noise(acceleration=0.01, torque=0.5)
model = forcegp.StructuredGP(system, "analytical", [prior], noise, inference="sparse")
fit = model.fit(data[:50], learn=[])

# %% Follow the log, ten samples at a time
found = []
for first in range(50, len(data), 10):
    now = data[first : first + 10]
    fit = fit.forget(math.exp(-10 * DT / MEMORY)).update(now)
    q, qd, tau = now.q[-1:], now.qd[-1:], now.tau[-1:]
    force = fit.predict(q, qd, tau, "joint_force")
    E = -9.81 * kinematics.point_jacobian(system.robot, q, "tip")[0, 2]
    known = (system.equations(q, qd).Q_K + tau)[0]
    std = (E @ force.covariance[0] @ E).sqrt() / (E @ E)
    found.append((float(now.t[-1]), float(E @ (force.mean[0] - known) / (E @ E)), float(std)))
when, kilograms, std = (torch.tensor(column) for column in zip(*found, strict=True))
for moment in (4.9, 5.5, 7.5, 9.9):
    i = int((when - moment).abs().argmin())
    true = mass[int(moment / DT)]
    print(f"t = {moment} s: {kilograms[i]:.2f} +- {2.0 * std[i]:.2f} kg, true {true:.2f} kg")

# %%
fig, ax = plt.subplots(figsize=(7, 3), layout="constrained")
ax.fill_between(when, kilograms - 2 * std, kilograms + 2 * std, alpha=0.3, label="±2σ")
ax.plot(when, kilograms, label="followed")
ax.plot(t, mass, "k--", label="true")
ax.set(xlabel="time [s]", ylabel="mass of the bucket [kg]")
ax.legend()
fig.savefig(figure, dpi=150)
print(f"figure: {figure}")
