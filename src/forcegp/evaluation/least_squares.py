"""Baseline predictors that any model should beat: the mean, the robot file alone, and least squares.

Least squares identifies a rigid robot with physically consistent inertial parameters, τ = M q̈ − Q_C − Q_G −
Q_D + Y(q, q̇, q̈) δπ + d q̇ + f tanh(q̇/v₀) + o + noise. Here, δπ corrects the inertial parameters of every
link, and d, f, o are the viscous friction, Coulomb friction and offset of every joint. A ridge penalty keeps
all unknowns close to the values in the robot file. All links are physically consistent, and the mass matrix
is therefore positive definite. This convex problem is solved by the interior-point method of `InertialPrior`.
In contact, the equations are projected onto the directions in which the constraint force has no component.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from forcegp import dynamics
from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset
from forcegp.forces.priors.inertial import InertialPrior
from forcegp.identification import MASS_SHARE, MOMENT_ARM, parameter_vector, regressor
from forcegp.robot.inertia import from_pseudo_inertia, pseudo_inertia
from forcegp.robot.model import RobotModel

CHUNK_STATES = 1000
"""Number of states processed at a time."""
MOST = 4000
"""Maximum number of evenly spaced samples, which gives a few hundred equations per unknown."""
WIDE = 10.0
"""Prior standard deviation of friction and offsets, relative to the largest torque at the joint."""
NOISE_PASSES = 3
"""Number of passes that re-estimate the noise."""
POINT = 1e-4
"""Fraction of the largest mass that is added at 0.1 m to links without spatial extent."""


@dataclass(frozen=True)
class LeastSquares:
    """An identified robot, and its `friction` `(3 nq,)`: viscous, Coulomb and offset terms of all joints."""

    system: ConstrainedSystem
    friction: Tensor

    @torch.no_grad()
    def predict(self, data: Dataset) -> Tensor:
        """Return the accelerations `(n, nq)` under the logged torques, subject to the constraint."""
        if len(data) > CHUNK_STATES:
            return torch.cat([self.predict(part) for part in data_chunks(data)])
        eom = self.system.equations(data.q, data.qd, data.active(self.system.contact_names))
        return eom.acceleration(eom.Q_K + data.tau - self.losses(data.qd))

    def losses(self, qd: Tensor) -> Tensor:
        """Return the torques `(n, nq)` due to the identified friction and offsets at velocities `(n, nq)`."""
        return (_friction_columns(self.system.robot, qd) @ self.friction[:, None])[..., 0]


def data_chunks(data: Dataset) -> Iterator[Dataset]:
    """Yield a data set in chunks of `CHUNK_STATES` samples, to limit memory use."""
    return (data[i : i + CHUNK_STATES] for i in range(0, len(data), CHUNK_STATES))


def identify_rigid(system: ConstrainedSystem, train: Dataset) -> LeastSquares:
    """Identify inertia, friction and offsets. Those that are not excited keep their values in the file."""
    rows = torch.linspace(0, len(train) - 1, min(len(train), MOST)).round().long()
    train, robot = train[rows.unique()], system.robot
    prior = _prior_std(robot, train)
    G, g, y2 = _normal_equations(system, train, prior)
    split = 10 * robot.nq
    x = torch.zeros_like(prior)
    noise, identified = (y2 / len(train)).sqrt(), robot
    for _ in range(NOISE_PASSES):
        weight = noise.clamp(min=1e-9) ** -2
        gram = torch.einsum("j,jkl->kl", weight, G) + torch.eye(len(prior)).to(prior)
        identified, x = _minimised(robot, gram, weight @ g, prior[:split])
        square_error = y2 - 2.0 * g @ x + torch.einsum("k,jkl,l->j", x, G, x)
        noise = (square_error.clamp(min=0.0) / len(train)).sqrt()
    return LeastSquares(system.with_robot(identified), x[split:] * prior[split:])


def _friction_columns(robot: RobotModel, qd: Tensor) -> Tensor:
    """Return Cᵀ (diag v, diag tanh(v/v₀), 1) `(n, nq, 3 nq)` for the speeds v = C q̇ of the drives."""
    v = robot.drive_motion(qd)
    columns = (v, torch.tanh(v / robot.friction_velocity), torch.ones_like(v))
    return torch.cat([robot.joint_torque(torch.diag_embed(x)).mT for x in columns], dim=-1)


def _prior_std(robot: RobotModel, train: Dataset) -> Tensor:
    """Return the prior standard deviation of every unknown, `(13 nq,)`."""
    mass = robot.mass.clamp(min=1e-3 * float(robot.mass.max()))
    shares = torch.tensor([MASS_SHARE, *[MOMENT_ARM] * 3, *[MOMENT_ARM**2] * 6]).to(mass)
    torque = WIDE * train.tau.abs().amax(0).clamp(min=1e-6)
    speed = train.qd.abs().amax(0).clamp(min=1e-3)
    return torch.cat([(mass[:, None] * shares).flatten(), torque / speed, torque, torque])


@torch.no_grad()
def _normal_equations(
    system: ConstrainedSystem, train: Dataset, prior: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return WᵀW `(nq, p, p)`, Wᵀy `(nq, p)` and yᵀy `(nq,)` by joint, for unknowns scaled by the prior."""
    p, nq = len(prior), train.nq
    G, g, y2 = prior.new_zeros(nq, p, p), prior.new_zeros(nq, p), prior.new_zeros(nq)
    for part in data_chunks(train):
        W, y = _rows(system, part)
        W = (W * prior).transpose(0, 1)
        G += W.mT @ W
        g += (W.mT @ y.mT[..., None])[..., 0]
        y2 += (y**2).sum(0)
    return G, g, y2


def _rows(system: ConstrainedSystem, data: Dataset) -> tuple[Tensor, Tensor]:
    """Return the regressor `(n, nq, 13 nq)` and the torque `(n, nq)` that the robot file does not explain."""
    eom = system.equations(data.q, data.qd, data.active(system.contact_names))
    Y = regressor(system.robot, data.q, data.qd, data.qdd)
    W = torch.cat([Y, _friction_columns(system.robot, data.qd)], dim=-1)
    y = data.tau + eom.Q_K - (eom.M @ data.qdd[..., None])[..., 0]
    if eom.A.shape[-2]:
        N = free_directions(system, data)
        W, y = N @ W, (N @ y[..., None])[..., 0]
    return W, y


def without_constraint(system: ConstrainedSystem, data: Dataset, torque: Tensor) -> Tensor:
    """Return the product of N and the torque, `(n, nq)`, computed in chunks."""
    parts = zip(data_chunks(data), torque.split(CHUNK_STATES), strict=True)
    return torch.cat([(free_directions(system, part) @ x[..., None])[..., 0] for part, x in parts])


def free_directions(system: ConstrainedSystem, data: Dataset) -> Tensor:
    """Return N = 1 − A⁺A `(n, nq, nq)` or `(nq, nq)`, which removes forces in the range of Aᵀ."""
    if not system.m:
        return torch.eye(data.nq).to(data.q)
    return system.equations(data.q, data.qd, data.active(system.contact_names)).N


def _minimised(robot: RobotModel, gram: Tensor, right: Tensor, prior: Tensor) -> tuple[RobotModel, Tensor]:
    """Minimise ½ xᵀ gram x − rightᵀ x over x = ((π − π₀)/S, friction) with physically consistent links."""
    sound, n = _with_extent(robot), len(prior)
    by_friction = torch.linalg.solve(gram[n:, n:], gram[n:, :n])
    # without friction, ½ δᵀ P δ − rᵀ δ
    P = gram[:n, :n] - gram[:n, n:] @ by_friction
    r = right[:n] - by_friction.mT @ right[n:]
    start = (parameter_vector(sound) - parameter_vector(robot)) / prior
    errors = InertialPrior(scales=tuple(prior.tolist()))
    identified, change = errors.updated(sound, torch.linalg.solve(P, r) - start, P)
    links = start + change
    return identified, torch.cat([links, torch.linalg.solve(gram[n:, n:], right[n:]) - by_friction @ links])


def _with_extent(robot: RobotModel) -> RobotModel:
    """Return the robot with mass added to links without spatial extent, so that all links are bodies."""
    J = pseudo_inertia(robot.mass, robot.com, robot.inertia)
    least = POINT * float(robot.mass.max()) * torch.tensor([MOMENT_ARM**2] * 3 + [1.0]).to(J)
    bad = torch.linalg.cholesky_ex(J - 1e-2 * torch.diag(least)).info != 0
    mass, com, inertia = from_pseudo_inertia(J + bad[:, None, None] * torch.diag(least))
    return robot.replace(mass=mass, com=com, inertia=inertia)


FEWEST_TRAINING = 20
"""Minimum number of samples for fitting a baseline."""


@dataclass(frozen=True)
class Baseline:
    """A trivial predictor of accelerations.

    Attributes:
        name: name of the predictor.
        predict: a function that returns the predicted accelerations `(n, nq)` for a data set.
        std: RMS error on the training data, which is used as the uncertainty, `(nq,)`.
    """

    name: str
    predict: Callable[[Dataset], Tensor]
    std: Tensor


def baselines(system: ConstrainedSystem, train: Dataset) -> list[Baseline]:
    """Return the mean, robot-file and least-squares baselines, for at least `FEWEST_TRAINING` samples."""
    mean, nothing = train.qdd.mean(0), train.qdd.new_zeros(3 * train.nq)
    identified = identify_rigid(system, train)

    def baseline(name: str, predict: Callable[[Dataset], Tensor]) -> Baseline:
        return Baseline(name, predict, ((predict(train) - train.qdd) ** 2).mean(0).sqrt())

    return [
        baseline("mean", lambda data: mean.expand_as(data.qdd)),
        baseline("robot file", LeastSquares(system, nothing).predict),
        baseline("least squares", identified.predict),
    ]


def as_torque(system: ConstrainedSystem, q: Tensor, error: Tensor) -> Tensor:
    """Return acceleration errors as torques M(q)(predicted − measured q̈), `(n, nq)` [N m, N]."""
    pairs = zip(q.split(CHUNK_STATES), error.split(CHUNK_STATES), strict=True)
    with torch.no_grad():
        parts = [dynamics.mass_matrix(system.robot, at) @ e[..., None] for at, e in pairs]
    return torch.cat(parts)[..., 0]
