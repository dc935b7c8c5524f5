"""Learned parameters in the words of a robot: friction, offsets, drives, links, payload and contact friction.

Friction F of a joint in a band of speeds, and the offset o of its torque, are linear in the weights w of all
columns, at the training samples in motion, where −Q = −Q_D − Φ w resists the motion:

    F = ½ mean(−Q | q̇ > 0) − ½ mean(−Q | q̇ < 0),    −Q ≈ d q̇ + f sign q̇ + o.

Their standard deviations are those of sums of columns, which are nearly collinear.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.forces.measurements import Training
from forcegp.forces.posterior import ForcePosterior
from forcegp.forces.priors.constants import DrivePrior, PerRecording
from forcegp.forces.priors.contact import CoulombErrorPrior, SlidingFrictionPrior, coulomb_keys
from forcegp.forces.priors.inertial import InertialPrior, PayloadPrior
from forcegp.forces.quantities import States, affine_map
from forcegp.gp.sparse import SparsePosterior
from forcegp.identification import PARAMETER_NAMES
from forcegp.models.parameters import DETERMINED, LearnedParameter, is_identified
from forcegp.robot.inertia import inertial_parameters
from forcegp.robot.model import RobotModel

SAMPLES, FEWEST = 2000, 5
"""Maximum number of samples, and minimum number of samples of a joint in each direction of motion."""
REST_SHARE = 0.05
"""Speed, relative to the largest of a joint, below which it counts as at rest."""
BANDS = {"slow friction": (0.0, 0.25), "fast friction": (0.75, 1.0)}
"""Quantiles of the speeds of a joint in motion between which friction is averaged."""
MOMENTS = ("mass", "mass·x", "mass·y", "mass·z", "Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz")
"""Inertial parameters of a link about its origin [kg, kg m, kg m²]."""
CONTACT = {
    "viscous": ("viscous friction", "N s/m"),
    "dry": ("dry friction", "N"),
    "coulomb": ("friction coefficient", ""),
    "stribeck": ("Stribeck friction coefficient", ""),
    "torsion": ("torsional friction", "m"),
}
"""Names and units of the terms of contact friction."""


@dataclass(frozen=True)
class RobotParameter:
    """A learned parameter of a robot or a contact.

    Attributes:
        name: `slow friction`, `fast friction`, `torque offset`, `torque scale`, `torque constant`, `torque
            delay`, `drive inertia`, a change of a link or a payload, such as `link mass·x`, or a term of
            contact friction.
        of: name of the joint, the contact or the recording, or `""`. A link is named after the joint that
            moves it. A payload of a recording is the difference from that of the first one.
        value, std: value, including that of the robot file, and standard deviation (`None` if unknown).
        unit: SI unit.
        determined: whether the data reduce the standard deviation to less than half that of the prior.
        speed: mean speed at which friction acts [rad/s, m/s].
    """

    name: str
    of: str
    value: float
    std: float | None
    unit: str
    determined: bool
    speed: float | None = None


@torch.no_grad()
def robot_parameters(
    posterior: ForcePosterior,
    columns: Sequence[LearnedParameter],
    friction: Mapping[str, Tensor],
    training: Training,
    file: RobotModel,
    system: ConstrainedSystem,
) -> tuple[RobotParameter, ...]:
    """Return the learned parameters of a robot (see `StructuredFit.robot_parameters`).

    Args:
        posterior, columns: the posterior, and the parameters of its columns.
        friction: learned hyperparameters, with those of contact friction.
        training: the training samples.
        file, system: the robot of the file, and the identified robot with its contacts.
    """
    parameters = [*_of_robot(posterior, columns, file, system.robot)]
    if isinstance(posterior.latent, SparsePosterior) and training.samples:
        weights = _Weights.of(posterior.latent, is_identified(posterior.priors))
        states = [m.at(system) for m in training.evenly(SAMPLES).measurements]
        parameters = [*_of_joints(weights, posterior, system, states), *parameters]
        parameters += _of_contacts(weights, posterior, friction, system, states)
    return tuple(parameters)


@dataclass(frozen=True, eq=False)
class _Weights:
    """Posterior of the weights w, and the difference of their joint posterior mean from their mean."""

    latent: SparsePosterior
    apart: Tensor

    @classmethod
    def of(cls, latent: SparsePosterior, identified: bool) -> _Weights:
        return cls(latent, (latent.joint_weights - latent.weights) * float(identified))

    def estimate(self, K: Tensor, known: float = 0.0) -> tuple[float, float, bool]:
        """Return K w + known, its standard deviation, and whether the data determine it."""
        root = torch.linalg.solve_triangular(self.latent.L, K[:, None], upper=False)
        std = float((root.square().sum() + (K @ self.apart) ** 2).sqrt())
        return float(K @ self.latent.weights) + known, std, std < DETERMINED * float(K.norm())


def _of_joints(
    weights: _Weights, posterior: ForcePosterior, system: ConstrainedSystem, states: Sequence[States]
) -> Iterator[RobotParameter]:
    """Yield the friction of each joint that moves both ways, and the offset of its torque."""
    parts = weights.latent.basis.parts
    blocks = [posterior.rows(system, at, affine_map(system, at, "joint_friction")) for at in states]
    values = [[part.values(x)[0] for part, x in zip(parts, b.features, strict=True)] for b in blocks]
    qd, Q_D = torch.cat([at.qd for at in states]), torch.cat([block.target for block in blocks])

    def columns(j: int) -> Tensor:
        """Return Φ of joint j, `(n, size)`."""
        each = (zip(parts, b.operators, V, strict=True) for b, V in zip(blocks, values, strict=True))
        return torch.cat([torch.cat([p.rows(W[:, j : j + 1], V) for p, W, V in b], dim=-1) for b in each])

    for j, joint in enumerate(system.robot.joint_names):
        unit = "N m" if system.robot.joint_types[j] == "revolute" else "N"
        v, size = qd[:, j], qd[:, j].abs()
        moves = size > REST_SHARE * size.max()
        if not bool(system.robot.driven[j]) or not bool(moves.any()):
            continue
        # −Q = −Q_D − Φ w
        known, Phi = -Q_D[:, j], -columns(j)
        for name, band in BANDS.items():
            low, high = size[moves].quantile(torch.tensor(band).to(size))
            within = moves & (size >= low) & (size <= high)
            ahead, back = within & (v > 0.0), within & (v < 0.0)
            if min(int(ahead.sum()), int(back.sum())) >= FEWEST:
                K, known_force = (0.5 * (x[ahead].mean(0) - x[back].mean(0)) for x in (Phi, known))
                value, std, determined = weights.estimate(K, float(known_force))
                speed = 0.5 * float(size[ahead].mean() + size[back].mean())
                yield RobotParameter(name, joint, value, std, unit, determined, speed)
        P = torch.linalg.pinv(torch.stack([v, v.sign(), torch.ones_like(v)], dim=-1)[moves])[2]
        value, std, determined = weights.estimate(P @ Phi[moves], float(P @ known[moves]))
        yield RobotParameter("torque offset", joint, value, std, unit, determined)


def _of_robot(
    posterior: ForcePosterior, columns: Sequence[LearnedParameter], file: RobotModel, robot: RobotModel
) -> Iterator[RobotParameter]:
    """Yield drive inertia, changes of the links, the payload, and the scales and the delay of the torque."""
    learned = {each.name: each for each in columns}
    links = (inertial_parameters(each.mass, each.com, each.inertia) for each in (robot, file))
    change = torch.sub(*links).tolist()
    for prior in posterior.priors:
        for recording in prior.recordings if isinstance(prior, PerRecording) else ():
            for name, word in zip(PARAMETER_NAMES, MOMENTS, strict=True):
                start = f"{prior.name}.{name}_{recording} of "
                p = next((p for key, p in learned.items() if key.startswith(start)), None)
                if p is not None:
                    yield RobotParameter(f"payload {word}", recording, p.value, p.std, p.unit, p.determined)
        if not isinstance(prior, DrivePrior | InertialPrior | PayloadPrior):
            continue
        kind = "payload" if isinstance(prior, PayloadPrior) else "link"
        names = {name: f"{kind} {word}" for name, word in zip(PARAMETER_NAMES, MOMENTS, strict=True)}
        names |= {"scale": "torque scale", "drive": "drive inertia"}
        for j, joint in enumerate(robot.joint_names):
            # Values that the robot includes
            known = {"scale": 1.0, "drive": float(robot.armature[j])}
            known |= dict(zip(PARAMETER_NAMES, change[j], strict=True)) if kind == "link" else {}
            for name, words in names.items():
                p = learned.get(f"{prior.name}.{name} of {joint}")
                if p is not None:
                    value, determined = p.value + known.get(name, 0.0), p.determined
                    # Scales that are not identified stay nominal.
                    determined &= name != "scale" or p.value != 0.0
                    yield RobotParameter(words, joint, value, p.std, p.unit, determined)
                    if isinstance(prior, DrivePrior) and prior.nominal:
                        k, unit = prior.nominal[j], ("N m/A", "N/A")[robot.joint_types[j] != "revolute"]
                        yield RobotParameter("torque constant", joint, k * value, k * p.std, unit, determined)
        if isinstance(prior, InertialPrior) and prior.delay:
            yield RobotParameter("torque delay", "", prior.delay, None, "s", True)


def _of_contacts(
    weights: _Weights,
    posterior: ForcePosterior,
    friction: Mapping[str, Tensor],
    system: ConstrainedSystem,
    states: Sequence[States],
) -> Iterator[RobotParameter]:
    """Yield the terms of the friction at each contact, averaged over the samples in which it is closed."""
    basis = weights.latent.basis
    for p, prior in enumerate(posterior.priors):
        if not isinstance(prior, CoulombErrorPrior | SlidingFrictionPrior):
            continue
        part, contact = basis.parts[p], system.contact_names.index(prior.contact)
        values = [part.values(posterior.process.features(p, system, at))[0] for at in states]
        V = torch.cat([x[:, at.active[:, contact]] for x, at in zip(values, states, strict=True)], dim=1)
        if not V.shape[1]:
            continue
        K = V.new_zeros(len(V), basis.size)
        K[:, basis.of_process(p)] = part.rows(torch.eye(len(V)).to(V)[None], V.mean(1, keepdim=True))
        if isinstance(prior, CoulombErrorPrior):
            # μ (1 + δ), with the error δ of log μ
            mu = float(friction[coulomb_keys(prior.contact)[0]].exp())
            value, std, determined = weights.estimate(K[0], 1.0)
            yield RobotParameter("friction coefficient", prior.contact, mu * value, mu * std, "", determined)
            continue
        for term, row in zip(prior.terms, K, strict=True):
            name, unit = CONTACT[term]
            value, std, determined = weights.estimate(row)
            yield RobotParameter(name, prior.contact, value, std, unit, determined)
