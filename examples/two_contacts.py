"""An arm with two contacts: its tip wipes a table while its forearm leans on a rail.

    python examples/two_contacts.py [figure.png]

Each contact has a multiplier of its own, and both are predicted with error bars.
"""

# %% A KUKA iiwa with its tip on a table and its fourth link on a cylindrical rail
import sys

import torch

import forcegp
from forcegp.constraints import project_state

figure = next((x for x in sys.argv[1:] if x.endswith(".png")), "two_contacts.png")
torch.manual_seed(0)
robot = forcegp.load_robot("kuka_iiwa")
q0 = torch.tensor([0.0, 0.7, 0.0, -1.5, 0.0, 0.9, 0.0], dtype=torch.float64)
elbow = forcegp.kinematics.point_position(robot, q0, "lbr_iiwa_link_4")
tip = forcegp.kinematics.point_position(robot, q0, "lbr_iiwa_link_7", (0.0, 0.0, 0.1))
rail = forcegp.constraints.Cylinder(
    (float(elbow[0]), 0.0, float(elbow[2]) - 0.1), (0.0, 1.0, 0.0), radius=0.1
)
contacts = [
    forcegp.SurfaceContact("table", "lbr_iiwa_link_7", (0.0, 0.0, 0.1), forcegp.Plane(offset=float(tip[2]))),
    forcegp.SurfaceContact("rail", "lbr_iiwa_link_4", (0.0, 0.0, 0.0), rail),
]
system = forcegp.ConstrainedSystem(robot, contacts, forcegp.constraints.Baumgarte())

# %% A log of the true arm, which has friction in its joints
friction = torch.tensor([3.0, 3.0, 2.0, 2.0, 0.2, 0.2, 0.02], dtype=torch.float64)
truth = system.with_robot(robot.replace(damping=robot.damping + friction))
q0, qd0 = project_state(system, q0, torch.zeros_like(q0))
rates = torch.arange(1.0, 8.0, dtype=torch.float64)


def torque(t: torch.Tensor, q: torch.Tensor, qd: torch.Tensor) -> torch.Tensor:
    """Computed torque: a swing of each joint about the start, and pressure on the table and the rail."""
    wanted = 100.0 * (q0 + 0.05 * torch.sin(rates * t) - q) - 20.0 * qd
    force = forcegp.dynamics.inverse_dynamics(robot, q, qd, wanted)
    return force - (system.equations(q, qd).A.mT @ torch.tensor([[40.0], [60.0]]).double())[..., 0]


arm = forcegp.AnalyticalModel(truth).nominal()
path = arm.rollout(q0, qd0, torque, 3.0, options=forcegp.rollout.RolloutOptions(0.005))
data = forcegp.Dataset(
    t=path.t,
    q=path.q,
    qd=path.qd,
    tau=path.tau,
    qdd=path.qdd + 0.1 * torch.randn_like(path.qdd),
    joint_names=robot.joint_names,
    contact={contact.name: path.active[:, i] for i, contact in enumerate(contacts)},
    contact_extras={"multiplier": {c.name: path.multiplier[:, i] for i, c in enumerate(contacts)}},
)

# %% Learn the friction from 40 samples of two seconds; predict both forces in the third
train, test = data[:400:10], data[400:]
model = forcegp.StructuredGP(system, "analytical", [forcegp.priors.JointFrictionPrior()], noise=0.1)
fit = model.fit(train)
force = fit.predict(test.q, test.qd, test.tau, "multiplier")
file = forcegp.AnalyticalModel(system).nominal().predict(test.q, test.qd, test.tau, "multiplier")
for i, name in enumerate(system.contact_names):
    true = test.multiplier[name]
    error, before = (force.mean[:, i] - true).abs(), (file.mean[:, i] - true).abs()
    inside = (error <= 2.0 * force.std[:, i]).double().mean()
    print(f"{name}: {true.mean():.1f} N on average, error {error.mean():.2f} N, of the robot file alone "
          f"{before.mean():.2f} N; within 2 sigma {inside:.0%}")  # fmt: skip
fit.plot(test, "multiplier")[0].figure.savefig(figure, dpi=150)
print(f"figure: {figure}")
