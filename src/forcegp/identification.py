"""Identification of inertial parameters π. Inverse dynamics is linear in π: τ = Y(q, q̇, q̈) π.

Sources: Atkeson, An, Hollerbach, *Estimation of inertial parameters of manipulator loads and links* (IJRR
1986); Gautier, *Numerical calculation of the base inertial parameters of robots* (J. Robotic Systems 1991).
Only the r base parameters β = B π affect the motion, so only they can be identified.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.linalg import qr, solve_triangular
from torch import Tensor

from forcegp.batchlast import apply, batch_first, batch_last, cross, dot
from forcegp.dynamics import accelerations
from forcegp.errors import DataError
from forcegp.kinematics import common_states, link_motion, link_poses
from forcegp.robot.inertia import inertial_parameters
from forcegp.robot.model import RobotModel
from forcegp.types import JointVector

Regressor = Float[Tensor, "*batch nq p"]
RANK = 1e-9
"""Relative pivot of the scaled regressor below which a direction is considered not to affect the motion."""
STATES = 100
"""Number of random states used to determine the rank."""
MASS_SHARE, MOMENT_ARM = 0.3, 0.1
"""Assumed relative error in the mass m of a link, and error in its centre of mass [m], in a robot file. The
standard deviations of m, m c and the inertia are 0.3 m, m · 0.1 m and m · (0.1 m)²."""
PARAMETER_NAMES = ("m", "mcx", "mcy", "mcz", "Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz")


def regressor(robot: RobotModel, q: JointVector, qd: JointVector, qdd: JointVector) -> Regressor:
    """Return Y `(*batch, nq, 10 nq)` such that Y π = M q̈ − Q_C − Q_G, excluding the armature.

    The parameters π are those of `parameter_vector`. Column k of link i contains the forces caused by a unit
    parameter π_k of that link. Only the kinematics and the gravity vector of the robot are used.

    Example:
        >>> import torch, forcegp
        >>> robot = forcegp.load_robot("double_pendulum")
        >>> q = torch.zeros(5, 2, dtype=torch.float64)
        >>> Y = regressor(robot, q, q, q)
        >>> Y.shape
        torch.Size([5, 2, 20])

    Raises:
        ShapeError: an argument has the wrong shape for the robot.
    """
    q, qd, qdd = common_states(robot, q=q, qd=qd, qdd=qdd)
    poses = link_poses(robot, q)
    motion = link_motion(robot, poses, qd)
    alpha, spatial = accelerations(robot, poses, motion, batch_last(qdd, 1))
    # p̈ − g of the origin p of each link
    speed = motion.velocity + cross(motion.omega, poses.p)
    lifted = spatial + cross(alpha, poses.p) + cross(motion.omega, speed)
    # link i and its ancestor j, with the motion [s; v] of link i for q̇_j = 1, in the axes of link i
    i, j = robot.ancestors.nonzero().unbind(-1)
    s, p = poses.angular[:, j], poses.p[:, i]
    still = poses.R[:, :, i].transpose(0, 1)
    s, v = apply(still, s), apply(still, poses.linear[:, j] + cross(s, p))
    w, alpha, a = (apply(still, x[:, i]) for x in (motion.omega, alpha, lifted))
    # f = m a + α × h + ω × (ω × h) and n = h × a + I α + ω × (I ω), with h = m c: vᵀf + sᵀn for unit π_k
    u = cross(s, w)
    moment = cross(v, alpha) + cross(cross(v, w), w) + cross(a, s)
    E = [[s[k] * alpha[l] + u[k] * w[l] for l in range(3)] for k in range(3)]
    pairs = ((k, l) for k in range(3) for l in range(k, 3))
    inertia = (E[k][k] if k == l else E[k][l] + E[l][k] for k, l in pairs)
    parts = torch.stack([dot(v, a), *moment, *inertia], dim=1)
    Y = parts.new_zeros(robot.nq, robot.nq, *parts.shape[1:]).index_put((j, i), parts)
    return batch_first(Y.flatten(1, 2), poses.batch)


def parameter_vector(robot: RobotModel) -> Float[Tensor, " p"]:
    """Return π `(10 nq,)`, which lists m, m c and the inertia about the link origin, link by link."""
    return inertial_parameters(robot.mass, robot.com, robot.inertia).flatten()


@dataclass(frozen=True)
class BaseParameters:
    """The combinations β = B π of inertial parameters that affect the motion.

    Attributes:
        columns: indices of the r independent parameters in π, one per combination.
        combination: matrix B `(r, 10 nq)`, whose submatrix in these columns is the identity.
        names: names of the combinations, such as `"Izz[joint_1] + 3 more"`.
    """

    columns: tuple[int, ...]
    combination: np.ndarray
    names: tuple[str, ...]

    @property
    def rank(self) -> int:
        """Number r of base parameters."""
        return len(self.columns)

    def of(self, robot: RobotModel) -> np.ndarray:
        """Return the base parameters β `(r,)` of a robot with the same kinematics."""
        return self.combination @ parameter_vector(robot).detach().cpu().numpy()


def base_parameters(robot: RobotModel) -> BaseParameters:
    """Compute the base parameters by rank-revealing QR of the regressor at random states (Gautier 1991).

    The computation runs on the CPU and uses only the kinematics and the gravity vector of the robot.

    Example:
        >>> import torch, forcegp
        >>> robot = forcegp.load_robot("double_pendulum")
        >>> base = base_parameters(robot)
        >>> base.rank, base.names[0]
        (6, 'mcx[shoulder]')
    """
    # Rounding of kinematic parameters to single precision breaks symmetries, so the rank appears higher.
    tolerance = max(RANK, 100.0 * torch.finfo(robot.dtype).eps)
    robot = robot.to("cpu", torch.float64)
    random = np.random.default_rng(0)
    states = (torch.as_tensor(random.uniform(-r, r, (STATES, robot.nq))) for r in (np.pi, 2.0, 4.0))
    Y = regressor(robot, *states).detach().flatten(0, 1).numpy()
    scale = np.linalg.norm(Y, axis=0)
    acting = np.flatnonzero(scale > tolerance * scale.max())
    factors: Any = qr(Y[:, acting] / scale[acting], mode="r", pivoting=True)
    R, pivots = factors
    size = np.abs(np.diag(R))
    rank = int((size > tolerance * size[0]).sum())
    # Y = Y_b B: the dependent columns are combinations of the independent ones.
    K = solve_triangular(R[:rank, :rank], R[:rank, rank:])
    lead, rest = acting[pivots[:rank]], acting[pivots[rank:]]
    B = np.zeros((rank, Y.shape[1]))
    B[np.arange(rank), lead] = 1.0
    B[:, rest] = K * scale[rest] / scale[lead][:, None]
    order = np.argsort(lead)
    B, lead = B[order], lead[order]
    columns = tuple(lead.tolist())
    return BaseParameters(columns, B, tuple(_name(robot, i, x) for i, x in zip(columns, B, strict=True)))


def _name(robot: RobotModel, column: int, row: np.ndarray) -> str:
    others = int((np.abs(row) > 1e-8 * np.abs(row).max()).sum()) - 1
    name = f"{PARAMETER_NAMES[column % 10]}[{robot.joint_names[column // 10]}]"
    return f"{name} + {others} more" if others else name


@dataclass(frozen=True)
class Identification:
    """Least-squares estimate of the base parameters from a log.

    Attributes:
        base: definition of the base parameters.
        value, standard_error: `(r,)` estimate of β and the standard error of this estimate.
        covariance: `(r, r)` covariance of the estimate.
        damping, friction: `(nq,)` viscous and Coulomb friction coefficients; `None` if not requested.
        noise_std: `(nq,)` standard deviation of the torque residual [N m, N].
        condition: condition number of the scaled problem; above about 100, excitation is insufficient.
    """

    base: BaseParameters
    value: np.ndarray
    standard_error: np.ndarray
    covariance: np.ndarray
    damping: np.ndarray | None
    friction: np.ndarray | None
    noise_std: np.ndarray
    condition: float


def identify(
    robot: RobotModel,
    q: JointVector,
    qd: JointVector,
    qdd: JointVector,
    tau: JointVector,
    *,
    friction: bool = False,
) -> Identification:
    """Identify the base parameters from a log of free motion by weighted linear least squares.

    τ − armature q̈ = Y_b β (+ d q̇ + f_c tanh(q̇/v_0)) + ε is solved first with equal weights, and then with
    each joint weighted by its inverse residual noise. Accelerations are treated as exact.

    Args:
        robot: source of the kinematics, gravity, drive inertia and v_0.
        q, qd, qdd: `(n, nq)` positions, velocities and accelerations.
        tau: `(n, nq)` measured joint force, excluding friction unless `friction` is true [N m, N].
        friction: whether to identify viscous and Coulomb friction as well.

    Example:
        >>> import forcegp, torch
        >>> robot = forcegp.load_robot("double_pendulum")
        >>> q, qd, tau = torch.randn(3, 20, 2, dtype=torch.float64)
        >>> qdd = forcegp.dynamics.forward_dynamics(robot, q, qd, tau - 0.5 * qd)
        >>> identify(robot, q, qd, qdd, tau, friction=True).damping.shape
        (2,)

    Raises:
        ShapeError: an argument has the wrong shape for the robot.
        DataError: a value is not finite, there are too few samples, or the excitation is insufficient.
    """
    robot.check_state(q=q, qd=qd, qdd=qdd, tau=tau)
    if not all(bool(torch.isfinite(x).all()) for x in (q, qd, qdd, tau)):
        raise DataError("the log has a value that is not finite", expected="finite q, qd, qdd and tau")
    base = base_parameters(robot)
    robot = robot.to("cpu", torch.float64)
    q, qd, qdd, tau = (x.detach().to("cpu", torch.float64) for x in (q, qd, qdd, tau))
    W = regressor(robot, q, qd, qdd)[..., list(base.columns)]
    if friction:
        v = robot.drive_motion(qd)
        columns = (torch.diag_embed(x) for x in (v, torch.tanh(v / robot.friction_velocity)))
        W = torch.cat([W, *(robot.joint_torque(x).mT for x in columns)], dim=-1)
    W, y = W.detach().numpy(), (tau - qdd @ robot.drive_inertia).detach().numpy()
    n, nq, unknowns = W.shape
    if n * nq <= unknowns or n < 2:
        text = "too few samples to identify the robot"
        raise DataError(text, expected=f"more than {unknowns // nq + 1}", got=n)
    freedom = n - unknowns / nq
    x, _, _ = _least_squares(W, y, np.ones(nq))
    # A noise-free log leaves no residuals from which weights can be computed.
    floor = 1e-12 * np.abs(y).max() + 1e-300
    first = np.sqrt(((y - W @ x) ** 2).sum(axis=0) / freedom)
    x, covariance, condition = _least_squares(W, y, 1.0 / np.maximum(first, floor))
    noise = np.sqrt(((y - W @ x) ** 2).sum(axis=0) / freedom)
    r = base.rank
    extra = x[r:].reshape(2, nq) if friction else (None, None)
    covariance = covariance[:r, :r]
    error = np.sqrt(np.diag(covariance))
    return Identification(base, x[:r], error, covariance, extra[0], extra[1], noise, condition)


def _least_squares(W: np.ndarray, y: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the weighted solution, its covariance, and the condition number for columns of unit norm."""
    A = (W * weights[:, None]).reshape(-1, W.shape[-1])
    b = (y * weights).ravel()
    scale = np.linalg.norm(A, axis=0)
    if scale.min() <= RANK * scale.max():
        raise DataError("the motion does not excite all parameters", expected="motion of every joint")
    Q, R = np.linalg.qr(A / scale)
    singular = np.linalg.svd(R, compute_uv=False)
    if singular[-1] <= RANK * singular[0]:
        raise DataError(
            "the motion does not excite all parameters",
            expected="motion that moves every joint, fast and slow, through many poses",
            got=f"condition number {singular[0] / max(singular[-1], 1e-300):.3g}",
        )
    x = solve_triangular(R, Q.T @ b)
    variance = ((b - (A / scale) @ x) ** 2).sum() / (len(b) - len(x))
    inverse = solve_triangular(R, np.eye(len(x)))
    covariance = variance * (inverse @ inverse.T) / np.outer(scale, scale)
    return x / scale, covariance, float(singular[0] / singular[-1])
