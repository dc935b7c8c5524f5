"""Telling joint friction and contact friction apart (the open question of remark 3.3).

Both are unknown to the model and known to the simulator. Three ways are compared: learning both from
motion in contact alone; the paper's two stages, joint friction from free motion first and then the
contact's with the hyperparameters of the joints held; and both kinds of data at once.

    python benchmarks/separation.py --json result.json
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

import forcegp
from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset, split_by_stretches
from forcegp.forces.measurements import Observation
from forcegp.forces.posterior import force_correlation
from forcegp.forces.priors.contact import ContactForcePrior
from forcegp.forces.priors.joint import AnalyticalMean, JointForcePrior
from forcegp.forces.quantities import States, states
from forcegp.gp.kernels import Linear, SquaredExponential
from forcegp.models.structured_fit import StructuredFit
from forcegp.models.structured_gp import StructuredGP
from forcegp.simulate import SimulationConfig, simulate

FREE_HEIGHT = 0.25
"""Height above the surface at which the free motion is made [m]."""


@dataclass(frozen=True)
class Separation:
    """What one way recovers on held-out motion in contact.

    Attributes:
        way: `contact`, `two_stages` or `both`.
        joint_error: mean absolute error of the joint friction, relative to its mean absolute value.
        contact_error: the same of the contact's generalized friction Q_z.
        acceleration_error: mean absolute error of q̈ against noise-free values [rad/s²].
        correlation: mean posterior correlation of Q and Q_z over the held-out states in contact, −1 where
            only their sum is known.
        correlation_free: the same over held-out states in free motion, where no Q_z acts: 0 unless the
            model lets the contact's friction act without contact.
    """

    way: str
    joint_error: float
    contact_error: float
    acceleration_error: float
    correlation: float
    correlation_free: float


def free_motion(system: ConstrainedSystem, config: SimulationConfig) -> Dataset:
    """A run of the same arm above the surface, as data of the system with all contacts open."""
    first = system.contacts[0]
    x, y, z = config.center
    above = dataclasses.replace(
        config,
        center=(x, y, z + FREE_HEIGHT),
        frame=getattr(first, "frame", None),
        point=tuple(getattr(first, "point", (0.0, 0.0, 0.0))),
    )
    data = simulate(ConstrainedSystem(system.robot), above).data
    opened = {name: torch.zeros(len(data), dtype=torch.bool) for name in system.contact_names}
    header = data.header.model_copy(update={"contact_names": system.contact_names})
    return data.replace(contact=opened, header=header)


def unfitted(system: ConstrainedSystem, noise_std: float) -> StructuredGP:
    """A model of both frictions, with everything else known."""
    contact = system.contact_names[0]
    joint = JointForcePrior(Linear() + SquaredExponential(), inputs=("qd",))
    friction = ContactForcePrior(contact, Linear(("velocity",)) + SquaredExponential())
    known = AnalyticalMean(("bias", "gravity", "actuation"))
    return StructuredGP(system, known, [joint, friction], noise_std)


def fit_ways(
    system: ConstrainedSystem, contact: Dataset, free: Dataset, noise_std: float
) -> dict[str, StructuredFit]:
    """The three ways of learning, by name, from training data in contact and in free motion."""
    model, both = unfitted(system, noise_std), [Observation(free), Observation(contact)]
    joint, friction = (prior.name for prior in model.force_priors)
    first = model.fit([Observation(free)], learn=[joint])
    return {
        "contact": model.fit(contact),
        "two_stages": model.fit(both, learn=[friction], after=first),
        "both": model.fit(both),
    }


@torch.no_grad()
def judge(way: str, model: StructuredFit, test: Dataset, free: Dataset) -> Separation:
    """Errors of a way on held-out data, where the simulator's forces are known.

    Args:
        way: its name.
        model: fitted.
        test: held-out samples in contact.
        free: held-out samples in free motion.
    """
    system = model.system
    active, at = test.active(system.contact_names), _states(system, test)
    state = (test.q, test.qd, test.tau)
    known = at.eom.Q_C + at.eom.Q_G + test.tau
    joint = model.predict(*state, "joint_force", active=active, covariance=False).mean - known
    contact = model.predict(*state, "contact_friction", active=active, covariance=False).mean
    qdd = model.predict(*state, active=active, covariance=False).mean
    return Separation(
        way,
        _relative(joint, at.eom.Q_D),
        _relative(contact, test.Q_z),
        float((qdd - test.qdd_clean).abs().mean()),
        float(force_correlation(model.posterior, system, at).mean()),
        float(force_correlation(model.posterior, system, _states(system, free)).mean()),
    )


def _states(system: ConstrainedSystem, data: Dataset) -> States:
    return states(system, data.q, data.qd, data.tau, data.active(system.contact_names))


def _relative(found: Tensor, truth: Tensor) -> float:
    return float((found - truth).abs().mean() / truth.abs().mean())


def separate(
    system: ConstrainedSystem, config: SimulationConfig, samples: int = 100, test_samples: int = 300
) -> list[Separation]:
    """Simulate motion in contact and in free space, learn in three ways, and compare.

    Args:
        system: robot with a contact whose friction is unknown.
        config: of both runs.
        samples: training samples of each kind.
        test_samples: held-out samples of each kind, about.
    """
    contact, free = simulate(system, config).data, free_motion(system, config)
    split = split_by_stretches(contact, samples, seed=config.seed)
    held = split_by_stretches(free, samples, seed=config.seed)
    test, test_free = _spread(contact, split.test, test_samples), _spread(free, held.test, test_samples)
    ways = fit_ways(system, contact[split.train], free[held.train], config.noise_std)
    return [judge(way, model, test, test_free) for way, model in ways.items()]


def _spread(data: Dataset, rows: Tensor, most: int) -> Dataset:
    """About `most` of some rows, evenly spread."""
    return data[rows[:: max(1, len(rows) // most)]]


def main() -> None:
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--samples", type=int, default=100)
    parser.add_argument("--duration", type=float, default=30.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    scene = forcegp.load_scene("kuka_plane")
    config = dataclasses.replace(scene.simulation, duration=options.duration, seed=options.seed)
    found = [dataclasses.asdict(way) for way in separate(scene.system(), config, options.samples)]
    print(json.dumps(found, indent=2))
    if options.json is not None:
        options.json.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
