"""Criteria for a good model: non-gravitational torque, open-loop motion, and response to a torque.

The torque error is M(q)(predicted − measured q̈), with the mass matrix of the robot file for all predictors,
since a predictor's own mass matrix would hide its errors. The explained fraction of the non-gravitational
torque is R² = 1 − Σ (N M Δq̈)² / Σ (N (τ − τ_g))². Here, τ_g is gravity plus a constant, fitted to the
torques, and N = 1 − A⁺A removes constraint forces.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from forcegp import dynamics
from forcegp.checks.explain import significant
from forcegp.checks.fit import cross_validate
from forcegp.checks.hypotheses import PARAMETER_Z, problem_of, robot_columns
from forcegp.checks.log import evenly, log_of
from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset
from forcegp.evaluation.least_squares import data_chunks, free_directions
from forcegp.identification import regressor
from forcegp.models.analytical import AnalyticalModel
from forcegp.models.base import FittedModel
from forcegp.robot.model import RobotModel
from forcegp.rollout.comparison import Comparison, compare
from forcegp.rollout.forward import RolloutOptions

HORIZONS = (0.1, 0.3, 1.0)
"""Times at which open-loop motions are compared [s]."""
STARTS, FEWEST_STARTS = 12, 3
"""Maximum and minimum number of evenly spaced starting points of these motions."""
FAINT = 0.1
"""Joints are scored if their non-gravitational torque, or motion, exceeds this fraction of the largest."""
RESPONSE_SAMPLES, FEWEST_FREE = 500, 20
"""Maximum and minimum number of states at which a torque is added."""
GRAVITY_SAMPLES, RIDGE = 4000, 1e-9
"""Maximum number of samples for fitting gravity; relative ridge for undetermined directions."""


PAYLOAD_SAMPLES, FEWEST_PAYLOAD = 1600, 200
"""Maximum and minimum number of samples in free motion from which a change of the payload is estimated."""


@dataclass(frozen=True)
class PayloadChange:
    """Mass on the last link that the model lacks (negative: has in excess) and its standard error [kg]."""

    mass: float
    std: float


@dataclass(frozen=True)
class Motion:
    """Accuracy of open-loop motion that starts from logged states under the logged torques.

    Attributes:
        horizons: times after the start [s].
        starts: number of starting points.
        model, robot_file: RMS error of the joint positions relative to their change since the start, as the
            median over the moving joints, or `None` after a divergence.
    """

    horizons: tuple[float, ...]
    starts: int
    model: tuple[float | None, ...]
    robot_file: tuple[float | None, ...]


@torch.no_grad()
def beyond_gravity(system: ConstrainedSystem, data: Dataset) -> tuple[Tensor, float]:
    """Return N (τ − τ_g) `(n, nq)`, and the fraction R² of the torque that gravity alone explains."""
    scale = data.tau.std(0).clamp(min=1e-9)

    def rows(part: Dataset) -> tuple[Tensor, Tensor]:
        still = torch.zeros_like(part.q)
        Y = regressor(system.robot, part.q, still, still)
        ones = torch.eye(data.nq).to(data.q).expand(len(part), -1, -1)
        every = torch.cat([Y, ones, part.tau[..., None]], dim=-1)
        x = (free_directions(system, part) @ every / scale[:, None]).double()
        return x[..., :-1], x[..., -1]

    some = torch.linspace(0, len(data) - 1, min(len(data), GRAVITY_SAMPLES)).round().long().unique()
    W, y = rows(data[some])
    A = W.flatten(0, 1)
    gram, least = A.mT @ A, RIDGE * A.square().sum() / A.shape[-1]
    theta = torch.linalg.solve(gram + least * torch.eye(len(gram)).to(gram), A.mT @ y.flatten())
    parts = [(y, y - W @ theta) for W, y in map(rows, data_chunks(data))]
    y, rest = map(torch.cat, zip(*parts, strict=True))
    whole = (y - y.mean(0)).square().sum().clamp(min=1e-300)
    return rest * scale, float(1.0 - rest.square().sum() / whole)


def explained(error: Tensor, rest: Tensor) -> tuple[float | None, ...]:
    """Return R² of each joint from errors and non-gravitational torques `(n, nq)`, or `None` if `FAINT`."""
    residual, whole = (error**2).sum(0), (rest**2).sum(0)
    shares, seen = (1.0 - residual / whole).tolist(), (whole > FAINT**2 * whole.max()).tolist()
    return tuple(share if clear else None for share, clear in zip(shares, seen, strict=True))


@torch.no_grad()
def torque_response(model: FittedModel, robot: RobotModel, data: Dataset) -> tuple[float, ...] | None:
    """Return the fraction of an added torque that takes effect at each joint, or `None` without free motion.

    The fraction is 1 for a model with the inertia of `robot`, and 0 if the model cancels the torque. A tenth
    of the standard deviation of the logged torque is added to one joint at a time, at states in free motion.
    The effective torque is M(q), the mass matrix of `robot`, times the change in the predicted acceleration.
    """
    closed, nq = data.active(model.system.contact_names), data.nq
    free = (~closed.any(-1)).nonzero()[:, 0]
    if len(free) < FEWEST_FREE:
        return None
    count = min(len(free), max(RESPONSE_SAMPLES // nq, FEWEST_FREE))
    rows = free[torch.linspace(0, len(free) - 1, count).round().long().unique()]
    data, n, joints = data[rows], len(rows), torch.arange(nq)
    step = 0.1 * data.tau.std(0).clamp(min=1e-9)
    added = torch.cat([torch.zeros(1, nq).to(step), torch.diag(step)])[:, None]
    q, qd, tau = (x.expand(nq + 1, n, nq).flatten(0, 1) for x in (data.q, data.qd, data.tau + added))
    active = closed[rows].expand(nq + 1, n, -1).flatten(0, 1)
    qdd = model.predict(q, qd, tau, active=active, covariance=False).mean.unflatten(0, (nq + 1, n))
    acts = (dynamics.mass_matrix(robot, data.q) @ (qdd[1:] - qdd[0])[..., None])[..., 0]
    acting = model.system.robot.true_torque(torch.diag(step)).diagonal()
    return tuple((acts[joints, :, joints].mean(-1) / acting).tolist())


@torch.no_grad()
def payload_change(model: FittedModel, error: Tensor, data: Dataset) -> PayloadChange | None:
    """Return a change of the payload since the training if one is found in free motion, given errors of q̈.

    With M and the regressor Y of the last link of the model, M (q̈ − q̈_model) = −Y δ. As in `forcegp.check`,
    friction and offsets are nuisances, δ must lower the held-out error, and its mass must be significant.
    """
    free = (~data.active(model.system.contact_names).any(-1)).nonzero()[:, 0].numpy(force=True)
    if len(free) < FEWEST_PAYLOAD or data.nq < 2:
        return None
    system, log, rows = ConstrainedSystem(model.system.robot), log_of(data), evenly(free, PAYLOAD_SAMPLES)
    M = dynamics.mass_matrix(system.robot, *log.tensors(rows, "q"))
    r = -(M @ error.detach().cpu().double()[rows][..., None])[..., 0].numpy()
    problem = replace(problem_of(system, log, rows), r=r)
    columns, prior = robot_columns(system, log, rows, "payload")
    null, fit = cross_validate(problem), cross_validate(problem, columns, prior)
    change = PayloadChange(float(fit.theta[0]), float(fit.spread[0]))
    clear = abs(change.mass) > PARAMETER_Z * change.std
    return change if clear and significant(fit.shares, null.shares, data.nq) else None


@torch.no_grad()
def open_loop(model: FittedModel, system: ConstrainedSystem, data: Dataset) -> Motion | None:
    """Simulate a model and the robot file in open loop; return `None` for short or unordered data."""
    if model.force_field() is None or not data.header.ordered or len(data) < 2:
        return None
    dt = data.header.dt or float((data.t[1:] - data.t[:-1]).median())
    closed = data.active(system.contact_names)
    switches = torch.nn.functional.pad((closed[1:] != closed[:-1]).any(-1).long().cumsum(0), (1, 0))
    for count in range(len(HORIZONS), 0, -1):
        steps = round(HORIZONS[count - 1] / dt)
        first = torch.arange(max(len(data) - steps, 0), device=data.device)
        last = first + steps
        even = ((data.t[last] - data.t[first]) - steps * dt).abs() < 0.5 * dt
        even &= (data.segment[last] == data.segment[first]) & (switches[last] == switches[first])
        first = first[even]
        if steps > 0 and len(first) >= FEWEST_STARTS:
            starts = first[torch.linspace(0, len(first) - 1, min(STARTS, len(first))).round().long().unique()]
            models = {"model": model, "robot file": AnalyticalModel(system).nominal()}
            options = RolloutOptions(on_divergence="keep")
            comparison = compare(models, data, steps * dt, starts, system=system, options=options)
            shares = (_shares(comparison, name, HORIZONS[:count]) for name in models)
            return Motion(HORIZONS[:count], len(starts), *shares)
    return None


def _shares(comparison: Comparison, name: str, horizons: tuple[float, ...]) -> tuple[float | None, ...]:
    """Return the error relative to the change in the joint positions at each horizon."""
    shares: list[float | None] = []
    for horizon in horizons:
        step = int((comparison.t - horizon).abs().argmin())
        q = comparison.predicted[name].q
        moved = (comparison.q[:, step] - comparison.q[:, 0]).square().mean(0).sqrt()
        if q.shape[1] <= step or not bool(moved.max() > 0.0):
            shares.append(None)
            continue
        error = (q[:, step] - comparison.q[:, step]).square().mean(0).sqrt()
        share = float((error / moved)[moved > FAINT * moved.max()].median())
        shares.append(share if math.isfinite(share) else None)
    return tuple(shares)
