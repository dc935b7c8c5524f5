"""External wrench on a robot frame, estimated from the equations of motion with learned forces.

An unknown wrench w acts at a frame with Jacobian J:

    M q̈ = Q̄ + Aᵀλ + Jᵀ w,   Q̄ ~ N(E Q̄, S).

S is the posterior covariance of the learned forces, including torque noise.

- **From accelerations** (`least_squares`): r = M q̈ − E Q̄ = Jᵀ w + e with Cov(e) = S + M Σ_q̈ Mᵀ and a prior
  w ~ N(0, W), solved by generalized least squares: C = (J Cov(e)⁻¹ Jᵀ + W⁻¹)⁻¹, E w = C J Cov(e)⁻¹ r.
  Directions that have no effect on the joints retain the prior covariance.
- **From momenta** (`observe`), without accelerations: p = M q̇ satisfies ṗ = Q̄ − Q_C + ½ ∂(q̇ᵀM q̇)/∂q + Jᵀ
  w. A Kalman filter estimates p, w, and the error of the learned forces, which has the correlation time of
  the torque residuals in the training log. The observer of De Luca and Mattone (*Sensorless robot collision
  detection and hybrid force/motion control*, ICRA 2005) is the steady-state filter without force errors.
- **With an unknown lever arm** (`over_levers`): a moment about the point is the product of a force and a
  distance. The estimate is a mixture over priors whose moments have different scales, weighted by their
  evidence at the sample. The evidence resolves directions that have little effect on the joints.

The wrench is exerted by the environment on the robot. The multipliers of closed contacts are also unknown.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from forcegp import dynamics, kinematics
from forcegp.errors import ParameterError, check_name
from forcegp.robot.model import RobotModel

Array = NDArray[np.float64]

FORCES, MOMENTS = ("fx", "fy", "fz"), ("mx", "my", "mz")
"""Components of a wrench; moments are taken about the point."""
AXES = (*FORCES, *MOMENTS)
FORCE_STD, MOMENT_STD = 30.0, 5.0
"""Prior standard deviations of each force [N] and moment [N m], which are large for pushes by hand."""
FORCE_CHANGE, MOMENT_CHANGE = 10.0, 1.0
"""Standard deviations of the changes in force and moment within one second, for the momentum filter."""
LEVERS = (1.0, 0.3, 0.1)
"""Scales of moments relative to the prior, with equal prior probabilities."""
MULTIPLIER_STD = 1e4
"""Prior standard deviation of the multipliers of declared contacts, chosen to be large [N]."""
ROWS = {name: row for row, name in enumerate((*MOMENTS, *FORCES))}
"""Row of each component in `frame_jacobian`, in which rotations come first."""


@dataclass(frozen=True)
class WrenchFrame:
    """A frame at which an unknown wrench acts, and the components of the wrench to estimate.

    Args:
        frame: frame of the robot.
        reference: axes of the components, either `"world"` or `"local"` (the axes of the frame).
        axes: components in `AXES` to estimate, in the given order; all others are zero.
        point: point of application of the force and reference point of moments, in frame coordinates [m].
        prior_std: prior standard deviations of forces [N] and moments [N m].
        change: standard deviations of the change in a force [N] and a moment [N m] within one second, for the
            momentum filter. Larger values make the filter faster and noisier.

    Example:
        >>> WrenchFrame("tool", axes=("fx", "fz")).prior.tolist()
        [30.0, 30.0]

    Raises:
        UnknownNameError: the reference or a component does not exist.
        ParameterError: there are no components, a component is repeated, the point is not finite, or a
            standard deviation is not positive and finite.
    """

    frame: str
    reference: str = "world"
    axes: tuple[str, ...] = AXES
    point: tuple[float, float, float] = (0.0, 0.0, 0.0)
    prior_std: tuple[float, float] = (FORCE_STD, MOMENT_STD)
    change: tuple[float, float] = (FORCE_CHANGE, MOMENT_CHANGE)

    def __post_init__(self) -> None:
        check_name("reference of a wrench", self.reference, ("world", "local"))
        for axis in self.axes:
            check_name("component of a wrench", axis, AXES)
        if not self.axes or len(set(self.axes)) < len(self.axes):
            raise ParameterError("invalid components of a wrench", expected="some of AXES", got=self.axes)
        if len(self.point) != 3 or not all(map(math.isfinite, self.point)):
            text = "invalid point of application of a wrench"
            raise ParameterError(text, expected="three finite coordinates [m]", got=self.point)
        for name, pair in (("prior_std", self.prior_std), ("change", self.change)):
            if len(pair) != 2 or not all(0.0 < std < math.inf for std in pair):
                raise ParameterError(
                    f"invalid {name} of a wrench",
                    expected="two positive standard deviations, of forces [N] and moments [N m]",
                    got=pair,
                )

    @property
    def prior(self) -> Tensor:
        """Prior standard deviation of each component `(k,)` [N, N m]."""
        return self._each(self.prior_std)

    @property
    def changes(self) -> Tensor:
        """Standard deviation of the change in each component within one second `(k,)` [N, N m]."""
        return self._each(self.change)

    def _each(self, pair: tuple[float, float]) -> Tensor:
        force, moment = pair
        return torch.tensor([force if axis in FORCES else moment for axis in self.axes], dtype=torch.float64)

    @property
    def levers(self) -> list[Tensor]:
        """Factors `(k,)` on `prior` for each value in `LEVERS`; all 1 unless there are forces and moments."""
        both = len({axis in FORCES for axis in self.axes}) == 2
        return [self._each((1.0, lever)) for lever in (LEVERS if both else (1.0,))]

    def jacobian(self, robot: RobotModel, q: Tensor) -> Tensor:
        """Return J `(*batch, k, nq)` at q `(*batch, nq)`, such that the joint force is Jᵀ w.

        Raises:
            UnknownNameError: the frame does not exist.
        """
        J = kinematics.frame_jacobian(robot, q, self.frame, self.point)
        if self.reference == "local":
            # w = diag(R, R) w_local
            R, _ = kinematics.frame_pose(robot, q, self.frame)
            J = torch.cat([R.mT @ J[..., :3, :], R.mT @ J[..., 3:, :]], dim=-2)
        return J[..., [ROWS[axis] for axis in self.axes], :]


def least_squares(J: Tensor, r: Tensor, S: Tensor, prior: Tensor) -> tuple[Tensor, Tensor]:
    """Solve r = Jᵀ w + e with e ~ N(0, S) and w ~ N(0, diag prior²) by generalized least squares.

    Args:
        J: `(n, k, nq)` Jacobians.
        r: `(n, nq)` residual joint force.
        S: `(n, nq, nq)` covariance of r if w = 0.
        prior: `(k,)` or `(n, k)` standard deviations.

    Returns:
        Mean `(n, k)` and covariance `(n, k, k)` of w.
    """
    # With S = L Lᵀ and w = diag(prior) v: V = (B Bᵀ + 1)⁻¹ with B = diag(prior) J L⁻ᵀ, E v = V B L⁻¹ r
    L = torch.linalg.cholesky(S)
    B = torch.linalg.solve_triangular(L, J.mT * prior[..., None, :], upper=False).mT
    e = torch.linalg.solve_triangular(L, r[..., None], upper=False)
    V = torch.cholesky_inverse(torch.linalg.cholesky(B @ B.mT + torch.eye(J.shape[-2]).to(B)))
    mean = (V @ (B @ e))[..., 0] * prior
    return mean, V * prior[..., :, None] * prior[..., None, :]


def over_levers(
    mean: Tensor, covariance: Tensor, prior: Tensor, levers: Sequence[Tensor]
) -> tuple[Tensor, Tensor]:
    """Convert an estimate for w ~ N(0, diag prior²) to one for a mixture of W_s = diag (s prior)², s ≤ 1.

    C_s⁻¹ = C⁻¹ + W_s⁻¹ − W⁻¹, m_s = C_s C⁻¹ m, and the evidence is ∝ (|C_s| / |W_s|)^½ exp(½ m_sᵀ C_s⁻¹ m_s).

    Args:
        mean, covariance: m `(n, k)` and C `(n, k, k)` for W = diag prior².
        prior: `(k,)` standard deviations.
        levers: scales s `(k,)` of each prior; all priors are equally probable.

    Returns:
        Mean `(n, k)` and covariance `(n, k, k)` of the mixture.
    """
    # In units of the prior
    precision = torch.cholesky_inverse(torch.linalg.cholesky(covariance / (prior[:, None] * prior[None, :])))
    v = (precision @ (mean / prior)[..., None])[..., 0]
    logs, means, covariances = [], [], []
    for s in levers:
        L = torch.linalg.cholesky(precision + torch.diag(s**-2 - 1.0))
        C = torch.cholesky_inverse(L)
        m = (C @ v[..., None])[..., 0]
        logs.append(0.5 * (m * v).sum(-1) - L.diagonal(dim1=-2, dim2=-1).log().sum(-1) - s.log().sum())
        means.append(m)
        covariances.append(C)
    weight = torch.softmax(torch.stack(logs), dim=0)[..., None]
    m, C = torch.stack(means), torch.stack(covariances)
    mixed = (weight * m).sum(0)
    apart = m - mixed
    spread = (weight[..., None] * (C + apart[..., :, None] * apart[..., None, :])).sum(0)
    return mixed * prior, spread * prior[:, None] * prior[None, :]


def momentum_force(robot: RobotModel, q: Tensor, qd: Tensor) -> tuple[Tensor, Tensor]:
    """Return M `(n, nq, nq)`, and the contribution ½ ∂(q̇ᵀM q̇)/∂q = Ṁ q̇ + Q_C `(n, nq)` of inertia to ṗ."""
    with torch.enable_grad():
        x = q.detach().clone().requires_grad_()
        M = dynamics.mass_matrix(robot, x)
        energy = 0.5 * (qd[..., None, :] @ M @ qd[..., None]).sum()
        (slope,) = torch.autograd.grad(energy, x)
    return M.detach(), slope


@dataclass(frozen=True)
class MomentumLog:
    """Inputs to the momentum filter, as arrays over n samples in time order.

    Attributes:
        t: `(n,)` time [s].
        p, p_noise: momentum M q̇ `(n, nq)`, and the covariance `(n, nq, nq)` of its noise.
        u: `(n, nq)` mean of ṗ if there is no wrench.
        J: `(n, k, nq)` Jacobians of the unknown components.
        prior, change: `(k,)` standard deviations of the components and of their changes within one second.
        factor: `(n, nq, nq)` lower Cholesky factor of S.
        correlation: `(nq,)` integral of the autocorrelation of the force error over all lags [s].
    """

    t: Array
    p: Array
    p_noise: Array
    u: Array
    J: Array
    prior: Array
    change: Array
    factor: Array
    correlation: Array


def observe(log: MomentumLog) -> tuple[Array, Array]:
    """Return the causally filtered mean `(n, k)` and covariance `(n, k, k)` of the wrench along a trajectory.

    The state is x = (p, w, η). The wrench w is an Ornstein-Uhlenbeck process with prior variance W that
    changes by about `change` within one second. The learned forces have the error S½ η, where η has unit
    variance. In a step h, p⁺ = p + h (u + Jᵀ w + S½ η), w⁺ = φ w + √(1 − φ²) W½ ε and η⁺ = ψ η + √(1 − ψ²) ε.
    Here φ = exp(−h change²/2 W), and ψ = (c − h)/(c + h) preserves the low-frequency spectral density c of η.
    """
    n, nq = log.p.shape
    k = len(log.prior)
    w, eta = slice(nq, nq + k), slice(nq + k, None)
    x, P = np.zeros(2 * nq + k), np.zeros((2 * nq + k, 2 * nq + k))
    x[:nq], P[:nq, :nq] = log.p[0], log.p_noise[0]
    P[w, w], P[eta, eta] = np.diag(log.prior**2), np.eye(nq)
    means, covariances = np.empty((n, k)), np.empty((n, k, k))
    means[0], covariances[0] = x[w], P[w, w]
    for i in range(1, n):
        h = log.t[i] - log.t[i - 1]
        phi = np.exp(-0.5 * h * (log.change / log.prior) ** 2)
        psi = np.maximum((log.correlation - h) / (log.correlation + h), 0.0)
        decay = np.concatenate([np.ones(nq), phi, psi])
        F = np.diag(decay)
        F[:nq, w], F[:nq, eta] = h * log.J[i - 1].T, h * log.factor[i - 1]
        x = F @ x
        x[:nq] += 0.5 * h * (log.u[i - 1] + log.u[i])
        P = F @ P @ F.T
        added = np.concatenate([np.zeros(nq), (1.0 - phi**2) * log.prior**2, 1.0 - psi**2])
        P[np.diag_indices_from(P)] += added
        # y = p + noise
        K = np.linalg.solve(P[:nq, :nq] + log.p_noise[i], P[:nq]).T
        x = x + K @ (log.p[i] - x[:nq])
        P = P - K @ P[:nq]
        P = 0.5 * (P + P.T)
        means[i], covariances[i] = x[w], P[w, w]
    return means, covariances
