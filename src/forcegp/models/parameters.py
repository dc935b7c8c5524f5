"""Learned parameters of a fit: weights of columns with their standard deviations, in SI units.

A term has the force Σ_c θ_c φ_c(x) with columns φ_c in SI units. Basis functions of the posterior are
s_c φ_c/r_c with the root mean square r_c of a column and its scale s_c, so θ_c = s_c w_c/r_c with w ~
N(A⁻¹v, A⁻¹).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from forcegp.forces.posterior import ForcePosterior
from forcegp.forces.priors.base import ForcePrior
from forcegp.forces.priors.constants import DrivePrior, PerRecording
from forcegp.forces.priors.inertial import InertialPrior, PayloadPrior
from forcegp.forces.term import FORCE, JointTerm
from forcegp.gp.kernels import Constant, Linear, sub
from forcegp.gp.sparse import SparsePosterior
from forcegp.identification import PARAMETER_NAMES
from forcegp.robot.model import RobotModel

DETERMINED = 0.5
"""Standard deviation relative to that of the prior, below which a parameter is determined by the data."""
SCALE = ".scale of "
"""Text between the name of a prior and that of a joint whose torque has a scale."""
INERTIAL = ("kg", "kg m", "kg m", "kg m", *6 * ("kg m²",))


@dataclass(frozen=True)
class LearnedParameter:
    """A learned parameter of a term.

    Attributes:
        name: name of the prior, the parameter, and the joint, if any.
        value, std: value used for predictions, which is zero if the robot includes the parameter, and root
            mean square deviation of the posterior from it.
        unit: SI unit.
        determined: whether the data reduce the standard deviation to less than half that of the prior.
    """

    name: str
    value: float
    std: float
    unit: str
    determined: bool


def is_identified(priors: Sequence[ForcePrior]) -> bool:
    """Return whether instruments identified the inertia, which differs from its posterior mean then."""
    return any(isinstance(prior, InertialPrior) and prior.is_error and bool(prior.drives) for prior in priors)


@torch.no_grad()
def learned_parameters(
    posterior: ForcePosterior, hyperparameters: Mapping[str, Tensor], robot: RobotModel
) -> tuple[LearnedParameter, ...]:
    """Return the parameters of all terms with finitely many columns (see `StructuredFit.parameters`)."""
    latent = posterior.latent
    if not isinstance(latent, SparsePosterior):
        return ()
    inverse = torch.linalg.solve_triangular(latent.L, torch.eye(len(latent.L)).to(latent.L), upper=False)
    apart = latent.joint_weights - latent.weights if is_identified(posterior.priors) else 0.0
    deviation, parameters = (inverse.square().sum(0) + apart**2).sqrt(), []
    for p, part in enumerate(latent.basis.parts):
        if part.split.rest is None:
            columns = latent.basis.of_process(p)
            shape = part.components, -1
            rows = latent.weights[columns].view(shape), deviation[columns].view(shape)
            parameters += _of_prior(posterior, hyperparameters, robot, p, *rows)
    return tuple(parameters)


def _of_prior(
    posterior: ForcePosterior,
    hyperparameters: Mapping[str, Tensor],
    robot: RobotModel,
    p: int,
    w: Tensor,
    std: Tensor,
) -> Iterator[LearnedParameter]:
    prior = posterior.priors[p]
    params = sub(hyperparameters, prior.prefix)
    if isinstance(prior, JointTerm) and isinstance(prior.kernel, Linear):
        scale = posterior.process.scales[p].std
        names = [*scale, *(["offset"] if w.shape[-1] > len(scale) else [])]
        root = torch.stack([x.reshape(-1).expand(robot.nq) for x in scale.values()], dim=-1)
        unit = prior.kernel.slope_std(params).expand(robot.nq, -1) / root
        if len(names) > len(scale):
            unit = torch.cat([unit, prior.kernel.bias_std(params)[:, None]], dim=-1)
        for j, joint in enumerate(robot.joint_names):
            if not robot.driven[j]:
                continue
            kind = int(robot.joint_types[j] != "revolute")
            for c, name in enumerate(names):
                stated = (pair[kind] for start, pair in prior.units.items() if name.startswith(start))
                units = next(stated, f"{FORCE[kind]} per unit of {name}")
                yield _parameter(f"{prior.name}.{name} of {joint}", w[j, c], std[j, c], unit[j, c], units)
    if isinstance(prior, DrivePrior) and isinstance(prior.kernel, Constant):
        for k, joint in enumerate(robot.joint_names):
            unit = prior.std * prior.kernel.std(params).expand(robot.nq)[k]
            mean, deviation = w[k, 0], std[k, 0]
            if prior.is_error and robot.torque_scale is not None:
                mean = (robot.torque_scale[k] - 1.0) / unit
                deviation = deviation.clamp(min=prior.spread[k] / float(unit))
            yield _parameter(f"{prior.name}.scale of {joint}", mean, deviation, unit, "")
    if isinstance(prior, PerRecording) and isinstance(prior.prior, PayloadPrior):
        assert isinstance(prior.kernel, Constant)
        places, payload = (*prior.recordings, ""), prior.prior
        units = payload.units(w).repeat_interleave(len(places)) * prior.kernel.std(params)
        least = torch.zeros_like(units).view(-1, len(places))
        if prior.spread:
            least[:, :-1] = least.new_tensor(prior.spread).mT
        joint = robot.joint_names[payload.link(robot)]
        deviation = torch.maximum(std[:, 0], least.flatten() / units)
        for k, unit in enumerate(units):
            index, place = divmod(k, len(places))
            name = f"{PARAMETER_NAMES[index]}_{places[place]}" if places[place] else PARAMETER_NAMES[index]
            text = f"{prior.name}.{name} of {joint}"
            yield _parameter(text, w[k, 0], deviation[k], unit, INERTIAL[index])
    if isinstance(prior, PayloadPrior | InertialPrior) and isinstance(prior.kernel, Constant):
        links = robot.nq * len(PARAMETER_NAMES)
        sizes = prior.units(w) if isinstance(prior, PayloadPrior) else prior.scale(robot)
        spread = next((p.spread for p in posterior.priors if isinstance(p, DrivePrior)), ())
        if isinstance(prior, InertialPrior) and prior.per_gain and spread:
            # What instruments find depends on the scales of the torques, with the errors of these.
            of_scales = (std.new_tensor(prior.per_gain) * std.new_tensor(spread)).norm(dim=-1)
            std = torch.maximum(std, (of_scales / (sizes * prior.kernel.std(params)))[:, None])
        for k, unit in enumerate(sizes * prior.kernel.std(params)):
            if not unit > 0.0:
                continue  # a link without mass, or a joint without a drive
            link, index = divmod(k, len(PARAMETER_NAMES))
            name, units = PARAMETER_NAMES[index], INERTIAL[index]
            if isinstance(prior, PayloadPrior):
                link = prior.link(robot)
            elif k >= links:
                link, name, units = k - links, "drive", "kg m²"
            name = f"{prior.name}.{name} of {robot.joint_names[link]}"
            yield _parameter(name, w[k, 0], std[k, 0], unit, units)


def _parameter(name: str, w: Tensor, std: Tensor, unit: Tensor, text: str) -> LearnedParameter:
    return LearnedParameter(name, float(w * unit), float(std * unit), text, float(std) < DETERMINED)
