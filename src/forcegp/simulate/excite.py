"""Planning of collision-free motions, within limits, that best identify the unknown forces.

Joints follow uniform cubic B-splines that start and end at rest in the same position. A spline stays in the
convex hull of its control points. Bounds on the control points and on their differences therefore guarantee
the limits on position, velocity and acceleration at all times. From random starts within all limits, L-BFGS
minimises an information criterion (`control/information.py`) plus squared hinges for all limits and the
clearance. The result is verified at 1 kHz, and times of violations are added to the nodes of the hinges.
Finally, the motion is scaled towards its start until all limits are satisfied.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from scipy.interpolate import BSpline
from scipy.optimize import minimize
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.control.information import CRITERIA, Criterion, States, Unknowns, rigid_torque
from forcegp.data import Dataset
from forcegp.data.fields import DataHeader
from forcegp.errors import NumericalError, ParameterError, check_name
from forcegp.files import write_text
from forcegp.resources import one_thread
from forcegp.robot.model import RobotModel
from forcegp.robot.shapes import shapes_of
from forcegp.simulate.collisions import Collisions
from forcegp.types import Array

KNOT, NODE, FINE = 0.5, 0.1, 0.001
"""Time between control points, between nodes of the objective, and between verified times [s]."""
SINES, SLOWEST, QUICKEST = 6, 0.05, 0.6
"""Number of sine functions in a random start, and the range of their frequencies [Hz]."""
STEEP = 5.0
"""Initial weight of the squared hinges. It is doubled after each round that violates a limit."""
INSIDE = 0.97
"""Fraction of a limit above which its hinge is active."""
KEEP = 1.5
"""Distance, relative to the clearance, below which the hinge for the clearance is active."""
ROUNDS, STEPS, REPAIRS = 4, 150, 30
"""Number of verification rounds; number of evaluations in the first round and in later rounds."""
SHARES = (1.0, 0.98, 0.95, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1, 0.05)
"""Scales of a motion, which are tried in this order until all limits are satisfied."""
REGION = 300
"""Number of states in the default region."""
CHUNK = 3000
TOLERANCE = 1e-9

Progress = Callable[[int, int], None]


@dataclass(frozen=True, eq=False)
class Limits:
    """Limits of a motion, with shape `(nq,)`. Positions without a limit in the file are limited to ±π.

    Attributes:
        low, high: position limits [rad, m].
        velocity, acceleration, torque: maximum magnitudes for each joint.
    """

    low: Tensor
    high: Tensor
    velocity: Tensor
    acceleration: Tensor
    torque: Tensor

    @classmethod
    def of(
        cls,
        robot: RobotModel,
        *,
        velocity: Sequence[float] = (),
        acceleration: Sequence[float] = (),
        torque: Sequence[float] = (),
        share: float = 0.9,
    ) -> Limits:
        """Return the limits for a motion as a fraction of the limits of a robot.

        Args:
            robot: the robot, which defines the limits that are not given.
            velocity, acceleration, torque: one number for all joints, or one per joint. By default, velocity
                and torque limits are those in the file, and accelerations reach the velocity limit in 0.25 s.
            share: fraction of these limits, and of the position range about its middle, to use. The rest is
                reserved for the controller.

        Raises:
            ParameterError: a limit is missing or not positive. The message names the joint and the option.
        """
        if not 0.0 < share <= 1.0:
            text = "the share of the limits is out of range"
            raise ParameterError(text, expected="above 0, up to 1", got=share)
        speed = _given(robot, "velocity", velocity, robot.velocity_limit)
        effort = _given(robot, "torque", torque, robot.effort_limit)
        rate = _given(robot, "acceleration", acceleration, 4.0 * speed)
        low, high = robot.lower.clamp(min=-torch.pi), robot.upper.clamp(max=torch.pi)
        middle, half = 0.5 * (low + high), 0.5 * share * (high - low)
        return cls(middle - half, middle + half, share * speed, share * rate, share * effort)

    def shares(self, q: Tensor, qd: Tensor, qdd: Tensor, torque: Tensor) -> dict[str, Tensor]:
        """Return the signed fractions of the limits that a motion uses, `(n, nq)` each."""
        middle, half = 0.5 * (self.low + self.high), 0.5 * (self.high - self.low)
        return {
            "position": (q - middle) / half,
            "velocity": qd / self.velocity,
            "acceleration": qdd / self.acceleration,
            "torque": torque / self.torque,
        }


def _given(robot: RobotModel, name: str, values: Sequence[float], default: Tensor) -> Tensor:
    """Return the limits of all joints, which are the given values or those of the robot."""
    if len(values) not in (0, 1, robot.nq):
        text = f"limits of {name} do not match the robot"
        raise ParameterError(text, expected=f"1 or {robot.nq} numbers", got=values)
    limit = default.new_tensor(values).expand(robot.nq) if len(values) else default
    missing = [n for n, x in zip(robot.joint_names, limit.tolist(), strict=True) if not 0.0 < x < np.inf]
    if missing:
        raise ParameterError(
            f"no limit of {name} for {', '.join(missing)} of robot {robot.name!r}",
            expected="positive finite limits",
            got=[round(x, 4) for x in limit.tolist()],
            hint=f"give --{name}, as one number or one per joint, or add it to the robot file",
        )
    return limit


def random_states(robot: RobotModel, limits: Limits, count: int = REGION, seed: int = 0) -> States:
    """Draw states uniformly within the limits, and slow down the states that need too much torque."""
    share = torch.rand(3, count, robot.nq, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    q = limits.low + share[0] * (limits.high - limits.low)
    qd, qdd = (2.0 * share[1] - 1.0) * limits.velocity, (2.0 * share[2] - 1.0) * limits.acceleration
    for factor in (0.7, 0.7, 0.7, 0.5, 0.5, 0.0):
        beyond = (rigid_torque(robot, q, qd, qdd).abs() > limits.torque).any(-1)[:, None]
        qd, qdd = torch.where(beyond, factor * qd, qd), torch.where(beyond, factor * qdd, qdd)
    return q, qd, qdd


@dataclass(frozen=True, eq=False)
class Excitation:
    """A motion that excites a robot for identification.

    Attributes:
        motion: positions, velocities, accelerations, and the torque according to the robot file.
        limits: the limits of the motion.
        used: largest used fraction of each limit by name, verified at 1 kHz, and the clearance `clearance_m`.
        before, after: the unknowns before the motion is recorded, and the expected unknowns afterwards.
        criterion: the objective for each random start. The first start was selected.
    """

    motion: Dataset
    limits: Limits
    used: Mapping[str, float]
    before: Unknowns
    after: Unknowns
    criterion: tuple[float, ...]

    def write(self, path: str | Path) -> None:
        """Write the motion to CSV (columns t, q.<joint>, qd.…, qdd.… and tau.…) or to Parquet.

        Raises:
            DataError: the name does not end in `.csv` or `.parquet`.
            DestinationError: the path cannot be written.
        """
        if Path(path).suffix.lower() != ".csv":
            return self.motion.write(path)
        names = ("q", "qd", "qdd", "tau")
        head = ["t", *(f"{name}.{joint}" for name in names for joint in self.motion.joint_names)]
        rows = torch.cat([self.motion.t[:, None], *(getattr(self.motion, name) for name in names)], dim=1)
        text = io.StringIO()
        np.savetxt(text, rows.numpy(), fmt="%.9g", delimiter=",", header=",".join(head), comments="")
        write_text(path, text.getvalue())


class Spline:
    """Motions that start and end at rest in the position `start` `(nq,)`, defined by free control points."""

    def __init__(self, start: Array, seconds: float) -> None:
        self.start, self.seconds = start, seconds
        self.spans = max(4, round(seconds / KNOT))
        self.h, self.free = seconds / self.spans, self.spans - 3

    def at(self, t: Array) -> tuple[Array, Array, Array]:
        """Return the matrices `(n, free)` that map control points, relative to the start, to q, q̇ and q̈."""
        spline = BSpline(self.h * np.arange(-3, self.spans + 4), np.eye(self.free + 6), 3)
        q, qd, qdd = (spline(t, order)[:, 3:-3] for order in range(3))
        return q, qd, qdd

    def differences(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return the control points of the velocity and of the acceleration."""
        zero = x.new_zeros(3, x.shape[1])
        first = torch.cat([zero, x, zero]).diff(dim=0) / self.h
        return first, first.diff(dim=0) / self.h

    def random(self, limits: Limits, random: np.random.Generator) -> Array:
        """Draw control points `(free, nq)` of a sum of sine functions within the kinematic limits."""
        t = np.arange(1, self.free + 1)[:, None, None] * self.h
        shape = (1, len(self.start), SINES)
        w = 2.0 * np.pi * random.uniform(SLOWEST, QUICKEST, shape)
        phase = random.uniform(0.0, 2.0 * np.pi, shape)
        size = random.uniform(0.2, 1.0, shape)
        wave = (size * np.sin(w * t + phase)).sum(-1) / size.sum(-1)
        low, high = limits.low.numpy(), limits.high.numpy()
        target = np.clip(0.5 * (low + high) + random.uniform(0.3, 1.0) * (high - low) * wave, low, high)
        ramp = np.clip(np.minimum(t, self.seconds - t)[..., 0] / min(3.0, 0.25 * self.seconds), 0.0, 1.0)
        x = torch.from_numpy(ramp * (target - self.start))
        ratios = zip(self.differences(x), (limits.velocity, limits.acceleration), strict=True)
        largest = torch.stack([(y.abs() / limit).amax(0) for y, limit in ratios]).amax(0)
        return (x * INSIDE / largest.clamp(min=INSIDE)).numpy()


class Search:
    """Objective for a motion as a function of its control points.

    Args:
        spline, limits, collisions: the spline and limits of the motion, and the collisions to avoid.
        unknowns: the unknown forces to identify.
        criterion: the objective as a function of the information.
    """

    def __init__(
        self, spline: Spline, limits: Limits, unknowns: Unknowns, collisions: Collisions, criterion: Criterion
    ) -> None:
        self.spline, self.limits, self.unknowns = spline, limits, unknowns
        self.collisions, self.criterion = collisions, criterion
        self.steep, self.extra = STEEP, np.zeros(0)
        self.scale = self.scaled()
        self.nodes = np.linspace(0.0, spline.seconds, round(spline.seconds / NODE) + 1)
        self.look(np.zeros(0))

    def look(self, times: Array) -> None:
        """Apply the hinges at additional times as well."""
        self.extra = np.union1d(self.extra, times)
        every = np.concatenate([self.nodes, self.extra])
        self.matrices = [torch.from_numpy(m) for m in self.spline.at(every)]

    def states(self, x: Tensor) -> States:
        """Return positions, velocities and accelerations at the nodes and the additional times."""
        q, qd, qdd = (matrix @ x for matrix in self.matrices)
        return torch.from_numpy(self.spline.start) + q, qd, qdd

    def scaled(self) -> Tensor:
        """Return scales C `(nq, free, free)` for control points C_j w_j, so that hinges curve similarly in w.

        C Cᵀ = (4/r² + D₁ᵀD₁/v² + D₂ᵀD₂/a²)⁻¹ with difference operators D, range r, and limits v and a.
        """
        limits, eye = self.limits, torch.eye(self.spline.free, dtype=torch.float64)
        D1, D2 = self.spline.differences(eye)
        sizes = limits.high - limits.low, limits.velocity, limits.acceleration
        r, v, a = ((1.0 / x)[:, None, None] ** 2 for x in sizes)
        L = torch.linalg.cholesky(4.0 * r * eye + v * (D1.mT @ D1) + a * (D2.mT @ D2))
        return torch.linalg.solve_triangular(L, eye.expand_as(L), upper=False).mT

    def __call__(self, flat: Array) -> tuple[float, Array]:
        """Return the sum of the criterion and the hinges, and its gradient, at scaled control points w."""
        limits = self.limits
        w = torch.tensor(flat.reshape(len(self.spline.start), -1), requires_grad=True)
        x = (self.scale @ w[..., None])[..., 0].mT
        states = self.states(x)
        Y, Phi = self.unknowns.columns(*states)
        torque = rigid_torque(self.unknowns.robot, *states, Y)
        value = self.criterion(self.information(Phi, torque), self.unknowns)
        speed, rate = self.spline.differences(x)
        middle, half = 0.5 * (limits.low + limits.high), 0.5 * (limits.high - limits.low)
        place = torch.from_numpy(self.spline.start) + x - middle
        bounds = (place, half), (speed, limits.velocity), (rate, limits.acceleration), (torque, limits.torque)
        hinges = sum((y.abs() / (INSIDE * limit) - 1.0).clamp(min=0.0).square().sum() for y, limit in bounds)
        near, slope = self.collisions.penalty(states[0].detach().numpy(), KEEP * self.collisions.clearance)
        # The gradient of the clearance enters by its inner product with q.
        away = (states[0] - states[0].detach()) * torch.from_numpy(slope)
        objective = value + self.steep * (hinges + near + away.sum())
        objective.backward()
        return float(objective.detach()), w.grad.numpy().ravel()  # pyright: ignore[reportOptionalMemberAccess]

    def information(self, Phi: Tensor, torque: Tensor) -> Tensor:
        """Return the information, given Φ and the torque at the nodes and the additional times."""
        n = len(self.nodes)
        rate = torch.gradient(torque[:n], spacing=float(self.nodes[1]), dim=0)[0]
        return self.unknowns.information(Phi[:n], self.spline.seconds, rate)

    def flat(self, x: Array) -> Array:
        """Convert control points `(free, nq)` to scaled control points."""
        return torch.linalg.solve(self.scale, torch.from_numpy(x).mT[..., None]).numpy().ravel()

    def minimised(self, x: Array, steps: int) -> tuple[Array, float]:
        """Minimise the objective, and return the control points and the value of the objective."""
        options = {"maxfun": steps, "maxiter": steps, "maxcor": 20}
        minimum = minimize(self, self.flat(x), jac=True, method="L-BFGS-B", options=options)
        w = torch.from_numpy(minimum.x.reshape(len(self.spline.start), -1))
        return (self.scale @ w[..., None])[..., 0].mT.numpy(), float(minimum.fun)

    @torch.no_grad()
    def used(self, x: Array, step: float) -> tuple[dict[str, float], Array]:
        """Return the largest used fraction of each limit at multiples of `step`, and violation times."""
        t = np.linspace(0.0, self.spline.seconds, round(self.spline.seconds / step) + 1)
        worst: dict[str, float] = {}
        where, limits, near = [], self.limits, self.collisions
        for rows in np.split(t, range(CHUNK, len(t), CHUNK)):
            q, qd, qdd = (torch.from_numpy(m @ x) for m in self.spline.at(rows))
            q = q + torch.from_numpy(self.spline.start)
            shares = limits.shares(q, qd, qdd, rigid_torque(self.unknowns.robot, q, qd, qdd))
            shares["clearance"] = 1.0 + torch.from_numpy(near.depth(q.numpy()))[:, None] / near.clearance
            largest = {name: share.abs().amax(-1).numpy() for name, share in shares.items()}
            worst = {name: max(worst.get(name, 0.0), float(share.max())) for name, share in largest.items()}
            where.append(rows[np.max(list(largest.values()), axis=0) > 1.0 + TOLERANCE])
        return worst, np.concatenate(where)

    def shrunk(self, x: Array, step: float) -> tuple[Array, dict[str, float]]:
        """Return the motion scaled by the largest of `SHARES` that satisfies all limits.

        Raises:
            NumericalError: no scale satisfies all limits.
        """
        used: dict[str, float] = {}
        for share in SHARES:
            used, where = self.used(share * x, step)
            if not len(where):
                return share * x, used
        broken = ", ".join(name for name, value in used.items() if value > 1.0 + TOLERANCE)
        raise NumericalError(
            f"no motion from the start satisfies the limits of {broken}",
            expected="room for a small motion around the start, at rest and in motion",
            got={name: round(value, 3) for name, value in used.items()},
            hint="give another --start, wider limits, or less --clearance",
        )


def _start_of(
    start: Sequence[float] | None, robot: RobotModel, limits: Limits, collisions: Collisions
) -> Array:
    """Return the given start if it is valid, or the collision-free position closest to the middle."""
    low, high = limits.low.numpy(), limits.high.numpy()
    if start is None:
        middle = 0.5 * (low + high)
        tried = np.concatenate([middle[None], np.random.default_rng(0).uniform(low, high, (500, robot.nq))])
        still = torch.zeros(len(tried), robot.nq, dtype=torch.float64)
        torque = rigid_torque(robot, torch.from_numpy(tried), still, still)
        free = (collisions.depth(tried) == 0.0) & (torque.abs() < INSIDE * limits.torque).all(-1).numpy()
        if not free.any():
            text = "no collision-free position within the torque limits was found"
            hint = "give --start, smaller boxes, or less --clearance"
            raise ParameterError(text, expected=f"one of {len(tried)} positions within the limits", hint=hint)
        distance = np.abs((tried - middle) / (high - low)).sum(-1)
        return tried[np.where(free, distance, np.inf).argmin()]
    q = np.array(start, dtype=float)
    if q.shape != (robot.nq,) or not ((q >= low) & (q <= high)).all():
        text = "the start is not within the limits of the motion"
        expected = [(round(a, 4), round(b, 4)) for a, b in zip(low.tolist(), high.tolist(), strict=True)]
        hint = "give another --start, or a larger --share of the limits"
        raise ParameterError(text, expected=expected, got=q.tolist(), hint=hint)
    if near := collisions.pairs(q):
        pairs = ", ".join(f"{pair} ({1e3 * gap:.3g} mm)" for pair, gap in near.items())
        raise ParameterError(
            "the start is in collision",
            expected=f"parts at least {1e3 * collisions.clearance:.3g} mm apart",
            got=pairs,
            hint="give another --start, or less --clearance",
        )
    return q


def excite(
    system: ConstrainedSystem,
    seconds: float = 30.0,
    *,
    limits: Limits | None = None,
    unknowns: Unknowns | None = None,
    collisions: Collisions | None = None,
    start: Sequence[float] | None = None,
    criterion: str | Criterion = "A",
    rate: float = 1000.0,
    restarts: int = 2,
    seed: int = 0,
    progress: Progress | None = None,
) -> Excitation:
    """Plan the motion in free space that best identifies the unknown forces.

    Args:
        system: the robot, and contacts with the surfaces to avoid.
        seconds: duration [s].
        limits: limits of the motion. The default is `Limits.of(robot)`.
        unknowns: unknown forces before the motion. The default is all unknowns of `Unknowns.of`.
        collisions: collisions to avoid. The default is those of the robot's shapes and the contact surfaces.
        start: initial and final position, `(nq,)`. The default is a collision-free position near the middle.
        criterion: `"A"`, the standard deviation of the torque in the region of `unknowns`; `"V"`, the same
            for links, viscous and dry friction by least squares, including bias; `"D"`, the determinant of
            the covariance; or a function of the information.
        rate: sampling rate of the result [Hz].
        restarts: number of random starts to optimise. They are the best of four times as many.
        seed: random seed for the starts.
        progress: a function called with the number of completed rounds and the total number.

    Example:
        >>> import forcegp
        >>> from forcegp.simulate.excite import excite
        >>> system = forcegp.ConstrainedSystem(forcegp.load_robot("ur5"))
        >>> len(excite(system, 4.0, rate=100.0, restarts=1).motion)
        401

    Raises:
        ParameterError: limits are missing, the start is invalid, or an option is out of range.
        NumericalError: no motion from the start satisfies the limits.
        MissingDependencyError: MuJoCo is not installed.
    """
    if not (2.0 <= seconds <= 600.0 and 0.0 < rate <= 1e5 and restarts >= 1):
        expected = "2 to 600 seconds, a positive rate, and one restart or more"
        raise ParameterError("the motion is out of range", expected=expected, got=(seconds, rate, restarts))
    robot = system.robot.to("cpu", torch.float64)
    limits = limits or Limits.of(robot)
    collisions = collisions or Collisions(system, shapes_of(robot, elements=("collision", "visual")))
    with one_thread():
        if unknowns is None:
            region = random_states(robot, limits)
            unknowns = Unknowns.of(robot, limits.low, limits.high, limits.velocity, region)
        if isinstance(criterion, str):
            check_name("criterion", criterion, CRITERIA)
            criterion = CRITERIA[criterion]
        spline = Spline(_start_of(start, robot, limits, collisions), seconds)
        search = Search(spline, limits, unknowns, collisions, criterion)
        best = _searched(search, restarts, np.random.default_rng(seed), progress or (lambda *_: None))
        return _result(system, search, best, rate, seed)


Optimum = tuple[tuple[float, ...], Array, dict[str, float]]
"""Objectives of the optimised starts (best first), control points of the best, and used limits."""


def _searched(search: Search, restarts: int, random: np.random.Generator, progress: Progress) -> Optimum:
    """Optimise random starts."""
    rounds = restarts + ROUNDS
    drawn = (search.spline.random(search.limits, random) for _ in range(4 * restarts))
    starts = [search.shrunk(x, NODE)[0] for x in drawn]
    starts.sort(key=lambda x: search(search.flat(x))[0])
    best = []
    for k, x in enumerate(starts[:restarts]):
        best.append(search.minimised(x, STEPS))
        progress(k + 1, rounds)
    best.sort(key=lambda pair: pair[1])
    x = best[0][0]
    for k in range(ROUNDS):
        _, where = search.used(x, FINE)
        progress(restarts + k + 1, rounds)
        if not len(where) or k == ROUNDS - 1:
            break
        # One instant of each stretch of a node's length is enough.
        search.look(where[np.unique((where / (0.25 * NODE)).astype(int), return_index=True)[1]])
        search.steep *= 2.0
        x, _ = search.minimised(x, REPAIRS)
    x, used = search.shrunk(x, FINE)
    return tuple(value for _, value in best), x, used


@torch.no_grad()
def _result(system: ConstrainedSystem, search: Search, best: Optimum, rate: float, seed: int) -> Excitation:
    robot, spline, unknowns = search.unknowns.robot, search.spline, search.unknowns
    values, x, used = best
    t = np.linspace(0.0, spline.seconds, round(spline.seconds * rate) + 1)
    q, qd, qdd = (torch.from_numpy(m @ x) for m in spline.at(t))
    q = q + torch.from_numpy(spline.start)
    header = DataHeader(
        dt=float(t[1]),
        robot=robot.name,
        robot_fingerprint=system.robot.fingerprint,
        seed=seed,
        provenance=(f"planned by forcegp excite: {spline.seconds:g} s",),
        joint_names=robot.joint_names,
    )
    tau = rigid_torque(robot, q, qd, qdd)
    motion = Dataset(torch.from_numpy(t), q, qd, tau, qdd, robot.joint_names, header=header)
    states = search.states(torch.from_numpy(x))
    Y, Phi = unknowns.columns(*states)
    after = unknowns.after(search.information(Phi, rigid_torque(robot, *states, Y)))
    used = {n: x for n, x in used.items() if n != "clearance"} | {"clearance_m": search.collisions.clearance}
    return Excitation(motion, search.limits, used, unknowns, after, values)
