"""Coverage of λ by ±2σ after the friction coefficient of the contact was learned from few samples.

    python benchmarks/friction_coverage.py --samples 60 12 --replications 200

Each replication presses the tip of the KUKA on a plane with 20 to 40 N at random states, under Coulomb friction
μ = 0.12 that the robot file lacks, learns μ, ε and the viscous and dry friction from noisy accelerations
(0.01 rad/s²), and predicts λ at 30 other states, without noise. Nothing else is unknown: what λ is uncertain by is
the friction alone. With `--joint-friction` the joints have a dry friction of 1 N m too, and a prior on it.

Bounds: .93 to .97 with 60 samples, at least .90 with 12.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import torch

import forcegp
from forcegp.forces.coulomb import CoulombFriction, with_coulomb
from forcegp.forces.quantities import states
from forcegp.gp.kernels import Linear

COEFFICIENT, SMOOTHING, JOINT_FRICTION = 0.12, 0.004, 1.0
BOUNDS = {60: (0.93, 0.97), 12: (0.90, 1.0)}


def pressed(system: forcegp.ConstrainedSystem, n: int, seed: int, dry: float) -> forcegp.Dataset:
    """Random states in which the tip is pressed on the plane and slides."""
    generator = torch.Generator().manual_seed(seed)
    name, nq = system.contact_names[0], system.robot.nq
    q, qd, tau = torch.randn(3, n, nq, dtype=torch.float64, generator=generator)
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


def coverage(samples: int, replications: int, joint_friction: bool) -> float:
    """Share of λ within ±2σ, over all replications and states."""
    system = forcegp.load_scene("kuka_plane").system()
    name, dry = system.contact_names[0], JOINT_FRICTION * joint_friction
    inside = []
    for seed in range(replications):
        train = pressed(system, samples, 2 * seed, dry)
        test = pressed(system, 30, 2 * seed + 1, dry)
        priors = [forcegp.JointFrictionPrior()] if joint_friction else []
        priors.append(forcegp.SlidingFrictionPrior(name, Linear(), coupled=True))
        fit = forcegp.StructuredGP(system, "analytical", priors, noise_std=0.01, torque_noise=None).fit(train)
        found = fit.predict(test.q, test.qd, test.tau, "multiplier")
        assert found.std is not None
        inside.append((found.mean[:, 0] - test.multiplier[name]).abs() <= 2.0 * found.std[:, 0])
    return float(torch.cat(inside).double().mean())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--samples", type=int, nargs="+", default=[60, 12])
    parser.add_argument("--replications", type=int, default=200)
    parser.add_argument("--joint-friction", action="store_true")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    found = {n: coverage(n, given.replications, given.joint_friction) for n in given.samples}
    for n, share in found.items():
        low, high = BOUNDS.get(n, (0.0, 1.0))
        print(f"{n} samples: ±2σ of λ hold {share:.3f}, bound {low} to {high}", flush=True)
    if given.json:
        given.json.write_text(json.dumps(found))


if __name__ == "__main__":
    main()
