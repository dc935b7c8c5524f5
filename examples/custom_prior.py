"""A force prior of your own in ten lines: a hose that pulls on the tip, as a function of where the tip is.

    python examples/custom_prior.py [figure.png]

The hose is an unknown Cartesian force at the tip. A prior that says so learns it from fewer samples than a
prior on all joint forces, which has to find the same force in seven places.
"""

# %% A log of a KUKA iiwa in free motion, on which a hose pulls with a force that the model does not know
import sys

import torch

import forcegp
from forcegp import dynamics, kinematics
from forcegp.gp.kernels import SquaredExponential

figure = next((x for x in sys.argv[1:] if x.endswith(".png")), "custom_prior.png")
torch.manual_seed(0)
TIP = ("lbr_iiwa_link_7", (0.0, 0.0, 0.1))
robot = forcegp.load_robot("kuka_iiwa")
system = forcegp.ConstrainedSystem(robot)
t = 0.01 * torch.arange(800, dtype=torch.float64)[:, None]
rates = 0.5 + 0.15 * torch.arange(7.0, dtype=torch.float64)
q, qd = 0.8 * torch.sin(rates * t), 0.8 * rates * torch.cos(rates * t)
qdd = -(rates**2) * q
tip, J = kinematics.point_position(robot, q, *TIP), kinematics.point_jacobian(robot, q, *TIP)
hose = -25.0 * (tip - torch.tensor([1.0, 0.0, 1.0], dtype=torch.float64))  # a spring from a reel at (1, 0, 1)
pulled = (hose[:, None] @ J)[:, 0]
tau = dynamics.inverse_dynamics(robot, q, qd, qdd) - pulled + 0.3 * torch.randn_like(q)  # torque sensors
qdd = qdd + 0.1 * torch.randn_like(qdd)
data = forcegp.Dataset(t=t[:, 0], q=q, qd=qd, tau=tau, qdd=qdd, joint_names=robot.joint_names)
train = data[::40]

# %% The prior: three components, which act through the Jacobian of the tip and depend on its position
pull = forcegp.priors.OperatorForcePrior(
    "hose",
    size=3,
    operator_function=lambda system, at: kinematics.point_jacobian(system.robot, at.q, *TIP).mT,
    feature_function=lambda system, at: {"tip": kinematics.point_position(system.robot, at.q, *TIP)},
    kernel=SquaredExponential(("tip",)),
)

# %% Beside the prior on all joint forces, fitted to the same 20 samples
fits = {
    name: forcegp.StructuredGP(system, "analytical", [prior], forcegp.Noise(0.1, torque=0.3)).fit(train)
    for name, prior in {"the hose": pull, "all joint forces": forcegp.priors.JointForcePrior()}.items()
}
for name, fit in fits.items():
    found = fit.predict(q, qd, tau, "joint_force").mean - system.equations(q, qd).Q_K - tau
    error = (found - pulled).square().mean().sqrt()
    print(f"prior on {name}: error of the joint forces {error:.2f} N m")
force = fits["the hose"].predict(q, qd, tau, "joint_force")
axes = force.plot(t[:, 0], measured=system.equations(q, qd).Q_K + tau + pulled, names=robot.joint_names)
axes[0].figure.savefig(figure, dpi=150)
print(f"figure: {figure}")
