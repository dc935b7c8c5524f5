"""Learn the friction of a free double pendulum; predict the force of a wire that its tip then slides on.

    python examples/double_pendulum_on_a_wire.py [figure.png]

The model learns forces, not accelerations. So what it has learned in free motion holds on the wire, too.
"""

# %% The known part: the robot file, and a bead at the tip that stays on a circular wire
import sys

import torch

import forcegp
from forcegp.constraints import project_state

figure = next((x for x in sys.argv[1:] if x.endswith(".png")), "double_pendulum_on_a_wire.png")
torch.manual_seed(0)
robot = forcegp.load_robot("double_pendulum")
circle = forcegp.constraints.Cylinder(center=(0.4, 0.0, -0.2), axis=(0.0, 1.0, 0.0), radius=1.2)
bead = forcegp.SurfaceContact("wire", frame="tip", point=(0.0, 0.0, 0.0), surface=circle)
free, wire = (
    forcegp.ConstrainedSystem(robot),
    forcegp.ConstrainedSystem(robot, [bead], forcegp.constraints.Baumgarte()),
)


# %% Logs of the true pendulum, whose joints have friction: 4 s free, 2 s on the wire
def torque(t: torch.Tensor, q: torch.Tensor, qd: torch.Tensor) -> torch.Tensor:
    return torch.cat([4.0 * torch.sin(3.0 * t), 2.0 * torch.sin(5.0 * t)], dim=-1)


def log(system: forcegp.ConstrainedSystem, duration: float) -> forcegp.Dataset:
    truth = system.with_robot(robot.replace(damping=robot.damping + 0.4, friction=robot.friction + 0.5))
    q0, qd0 = project_state(system, torch.tensor([0.5, -1.0]).double(), torch.zeros(2).double())
    options = forcegp.rollout.RolloutOptions(dt=0.01)
    path = forcegp.AnalyticalModel(truth).nominal().rollout(q0, qd0, torque, duration, options=options)
    forces = dict(zip(system.contact_names, path.multiplier.unbind(-1), strict=True))
    return forcegp.Dataset(
        t=path.t,
        q=path.q,
        qd=path.qd,
        tau=path.tau,
        qdd=path.qdd + 0.1 * torch.randn_like(path.qdd),
        joint_names=robot.joint_names,
        contact={name: torch.ones(len(path.t), dtype=torch.bool) for name in forces},
        contact_extras={"multiplier": forces} if forces else {},
    )


train, test = log(free, 4.0)[::10], log(wire, 2.0)

# %% A prior on the friction of each joint, fitted to 40 samples of free motion
fit = forcegp.StructuredGP(free, "analytical", [forcegp.priors.JointFrictionPrior()], noise=0.1).fit(train)

# %% The force of the wire, and whether the predicted accelerations keep the bead on it
force = fit.predict(test.q, test.qd, test.tau, "multiplier", system=wire)
file = forcegp.AnalyticalModel(wire).nominal().predict(test.q, test.qd, test.tau, "multiplier")
error, before = ((x.mean[:, 0] - test.multiplier["wire"]).abs() for x in (force, file))
eom, qdd = wire.equations(test.q, test.qd), fit.predict(test.q, test.qd, test.tau, system=wire).mean
print(f"mean error of the wire's force: {error.mean():.3f} N, of the robot file alone {before.mean():.3f} N")
print(f"within 2 sigma: {(error <= 2.0 * force.std[:, 0]).double().mean():.0%}")
print(f"largest |A qdd - b|: {((eom.A @ qdd[..., None])[..., 0] - eom.b).abs().max():.1e} m/s2")
fit.plot(test, "multiplier", system=wire)[0].figure.savefig(figure, dpi=150)
print(f"figure: {figure}")
