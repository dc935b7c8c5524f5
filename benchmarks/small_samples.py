"""Coverage by ±2σ after learning from few samples, over many replications.

    python benchmarks/small_samples.py --what friction --samples 60 12 --replications 200
    python benchmarks/small_samples.py --what joints --samples 60 240 --replications 50
    python benchmarks/small_samples.py --what correlated --samples 1000 --replications 20

`friction`: the tip of the KUKA is pressed on a plane with 20 to 40 N at random states, under Coulomb friction
μ = 0.12 that the robot file lacks. μ, ε and the viscous and dry friction are learned from noisy accelerations
(0.01 rad/s²), and λ is predicted at 30 other states. With `--joint-friction` the joints have a dry friction
of 1 N m too, and a prior on it. Bounds: .93 to .97 with 60 samples, at least .90 with 12.

`joints`: the joint forces of a double pendulum are drawn from the model's own kernel, and predicted at 30
other states from noisy accelerations (0.1 rad/s²). What is missing from .954 is the uncertainty of
hyperparameters.

`correlated`: a double pendulum with viscous and dry friction follows smooth motions (100 Hz, four segments).
Its torque has noise of 0.1 N m, an AR(1) process with coefficient 0.9, and its accelerations have white noise
of 0.1 rad/s². κ, the inverse autocorrelation time of the torque noise, is 1/19. Noise-free accelerations of
another motion are predicted from noise-free torques, and noisy ones from noisy torques. Bounds: the mean of κ
within 30 %, ±2σ hold .93 to .97.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

import forcegp
from forcegp.errors import NumericalError
from forcegp.forces.priors.contact import CoulombFriction, with_coulomb
from forcegp.forces.quantities import states
from forcegp.gp.kernels import Linear, SquaredExponential

COEFFICIENT, SMOOTHING, JOINT_FRICTION = 0.12, 0.004, 1.0
TESTS = 30


def pressed(system: forcegp.ConstrainedSystem, n: int, seed: int, dry: float) -> forcegp.Dataset:
    """Random states in which the tip is pressed on the plane and slides."""
    generator = torch.Generator().manual_seed(seed)
    name, nq = system.contact_names[0], system.robot.nq
    q, qd, tau = (s * torch.randn(n, nq, dtype=torch.float64, generator=generator) for s in (1.0, 0.3, 20.0))
    closed = torch.ones(n, 1, dtype=torch.bool)
    eom = system.equations(q, qd, closed)
    joints = -dry * torch.tanh(qd / 0.02)
    wanted = 20.0 + 20.0 * torch.rand(n, 1, dtype=torch.float64, generator=generator)
    tau = tau - (eom.A.mT @ (wanted - eom.multiplier(eom.Q_K + tau + joints))[..., None])[..., 0]
    at = states(system, q, qd, tau, closed)
    law = CoulombFriction(name, *torch.tensor([COEFFICIENT, SMOOTHING], dtype=torch.float64))
    Q_bar = with_coulomb(system, at, at.eom.Q_K + tau + joints, [law])
    noise = 0.01 * torch.randn(n, nq, dtype=torch.float64, generator=generator)
    return forcegp.Dataset(
        t=torch.arange(n, dtype=torch.float64),
        q=q,
        qd=qd,
        tau=tau,
        qdd=at.eom.acceleration(Q_bar) + noise,
        joint_names=system.robot.joint_names,
        contact={name: closed[:, 0]},
        contact_extras={"multiplier": {name: at.eom.multiplier(Q_bar)[:, 0]}},
    )


def friction(samples: int, seed: int, joint_friction: bool) -> Tensor:
    """Which multipliers are within ±2σ."""
    table = forcegp.SurfaceContact("table", "lbr_iiwa_link_7", (0.0, 0.0, 0.1), forcegp.Plane())
    system = forcegp.ConstrainedSystem(forcegp.load_robot("kuka_iiwa"), [table])
    name, dry = table.name, JOINT_FRICTION * joint_friction
    train, test = pressed(system, samples, 2 * seed, dry), pressed(system, TESTS, 2 * seed + 1, dry)
    priors = [forcegp.priors.JointFrictionPrior()] if joint_friction else []
    priors.append(forcegp.priors.SlidingFrictionPrior(name, Linear(), coupled=True))
    fit = forcegp.StructuredGP(
        system, "analytical", priors, noise=forcegp.Noise(acceleration=0.01, torque=None)
    ).fit(train)
    found = fit.predict(test.q, test.qd, test.tau, "multiplier")
    assert found.std is not None
    return (found.mean[:, 0] - test.multiplier[name]).abs() <= 2.0 * found.std[:, 0]


def joints(samples: int, seed: int) -> Tensor:
    """Which joint forces are within ±2σ."""
    system = forcegp.ConstrainedSystem(forcegp.load_robot("double_pendulum"))
    generator = torch.Generator().manual_seed(seed)
    n = samples + TESTS
    q, qd, tau = torch.randn(3, n, 2, dtype=torch.float64, generator=generator)
    x = torch.cat([q, qd], dim=-1) / 2.0  # length-scales of two standard deviations
    K = torch.exp(-0.5 * torch.cdist(x, x).square()) + 1e-9 * torch.eye(n, dtype=torch.float64)
    force = torch.linalg.cholesky(K) @ torch.randn(n, 2, dtype=torch.float64, generator=generator)
    eom = system.equations(q, qd)
    qdd = eom.acceleration(eom.Q_K + tau + force)
    noisy = qdd + 0.1 * torch.randn(n, 2, dtype=torch.float64, generator=generator)
    t = torch.arange(n, dtype=torch.float64)
    data = forcegp.Dataset(t, q, qd, tau, noisy, system.robot.joint_names)
    prior = forcegp.priors.JointForcePrior(SquaredExponential(("q", "qd")))
    fit = forcegp.StructuredGP(system, "analytical", [prior], noise=0.1).fit(data[:samples])
    test = data[samples:]
    found = fit.predict(test.q, test.qd, test.tau, "joint_force")
    assert found.std is not None
    return ((found.mean - (eom.Q_K + tau + force)[samples:]).abs() <= 2.0 * found.std).flatten()


def smooth(robot: forcegp.RobotModel, n: int, seed: int) -> forcegp.Dataset:
    """Sums of sines, new ones for each of four segments, with the torques that move a robot with friction."""
    generator = torch.Generator().manual_seed(seed)
    t, segment = torch.arange(n, dtype=torch.float64) * 0.01, torch.arange(n) * 4 // n
    w = 1.0 + 5.0 * torch.rand(4, 3, 2, generator=generator, dtype=torch.float64)[segment]
    phase = 6.3 * torch.rand(4, 3, 2, generator=generator, dtype=torch.float64)[segment]
    angle = w * t[:, None, None] + phase
    q, qd, qdd = (0.4 * x.sum(1) for x in (angle.sin(), w * angle.cos(), -w.square() * angle.sin()))
    tau = forcegp.dynamics.inverse_dynamics(robot, q, qd, qdd) + 0.3 * qd + 0.4 * torch.tanh(qd / 0.02)
    return forcegp.Dataset(t, q, qd, tau, qdd, robot.joint_names, segment=segment)


def noisy(data: forcegp.Dataset, seed: int) -> forcegp.Dataset:
    """The same data with correlated noise of the torque and white noise of the acceleration."""
    generator = torch.Generator().manual_seed(seed)
    e, white = torch.randn(2, *data.q.shape, generator=generator, dtype=torch.float64)
    for k in range(1, len(e)):
        e[k] = 0.9 * e[k - 1] + (1.0 - 0.9**2) ** 0.5 * e[k]
    return data.replace(tau=data.tau + 0.1 * e, qdd=data.qdd + 0.1 * white)


def correlated(samples: int, seed: int) -> dict[str, Tensor]:
    """Which noise-free and which noisy accelerations are within ±2σ, and the learned κ."""
    robot = forcegp.load_robot("double_pendulum")
    robot = robot.replace(damping=torch.zeros_like(robot.damping), friction=torch.zeros_like(robot.friction))
    train, clean = smooth(robot, samples, 2 * seed), smooth(robot, 10 * TESTS, 2 * seed + 1)
    system = forcegp.ConstrainedSystem(robot)
    fit = forcegp.StructuredGP(system, "analytical", noise=0.1).fit(noisy(train, 2 * seed))
    found = {"κ": torch.tensor([fit.problem.power])}
    for name, test in ("±2σ hold", clean), ("with noise", noisy(clean, 2 * seed + 1)):
        read = fit.predict(test.q, test.qd, test.tau, noise=test is not clean)
        assert read.std is not None
        found[name] = ((read.mean - test.qdd).abs() <= 2.0 * read.std).flatten()
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--what", choices=("friction", "joints", "correlated"), default="friction")
    parser.add_argument("--samples", type=int, nargs="+", default=[60, 12])
    parser.add_argument("--replications", type=int, default=200)
    parser.add_argument("--joint-friction", action="store_true")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    each: Callable[[int, int], dict[str, Tensor]] = {
        "friction": lambda n, seed: {"±2σ hold": friction(n, seed, given.joint_friction)},
        "joints": lambda n, seed: {"±2σ hold": joints(n, seed)},
        "correlated": correlated,
    }[given.what]
    result = {}
    for n in given.samples:
        found, refused = [], 0
        for seed in range(given.replications):
            try:
                found.append(each(n, seed))
            except NumericalError:  # double precision does not resolve the prediction
                refused += 1
        result[n] = {name: float(torch.cat([x[name] for x in found]).double().mean()) for name in found[0]}
        text = ", ".join(f"{name} {share:.3f}" for name, share in result[n].items())
        print(
            f"{given.what}, {n} samples: {text}, {refused} of {given.replications} refused",
            flush=True,
        )
    if given.json:
        given.json.write_text(json.dumps({given.what: result}))


if __name__ == "__main__":
    main()
