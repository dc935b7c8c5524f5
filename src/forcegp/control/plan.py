"""The plan of a motion: reference, posture, orientation and initial state, drawn before the simulation.

`MotionConfig` defines the path, speed, pressing force and control of the tool. Inverse kinematics computes
the joint positions for a pose of the tool.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from forcegp import kinematics
from forcegp.constraints import ConstrainedSystem, Equations
from forcegp.constraints.contact import SurfaceContact
from forcegp.control.task_space import (
    Gains,
    JointTarget,
    Target,
    control_torque,
    joint_torque,
    orientation_error,
    task_rows,
)
from forcegp.control.trajectory import Chart, Reference, draw_waypoints, straight_lines
from forcegp.errors import NumericalError, ParameterError
from forcegp.robot.model import RobotModel
from forcegp.robot.shapes import turn_z
from forcegp.types import JointVector, Rotation, Vector3

NOT_NEGATIVE = "a finite number, 0 or above"


def check_setting(name: str, valid: bool, expected: str, got: object) -> None:
    """Raise `ParameterError` unless a setting is valid."""
    if not valid:
        raise ParameterError(f"{name} is out of range", expected=expected, got=got)


@dataclass(frozen=True)
class MotionConfig:
    """A random motion of the tool over a surface or in free space. The defaults are the paper's task.

    Args:
        duration: duration of the motion [s].
        dt: sampling period of the motion and of the controller [s].
        center: centre of the rectangle of waypoints [m]. It is moved onto the surface if there is a contact.
        size: side lengths of the rectangle, ahead and across [m].
        travel_time: time between two waypoints [s].
        max_acceleration: maximum acceleration of the end-effector along a line [m/s²].
        lift_probability: probability that a waypoint is above the surface. With 0, the tool stays in contact.
        lift_height: range of heights for such a waypoint [m].
        pressing_force: range of the force on the surface [N], which is drawn for each line.
        elbow_swing: variation in the null-space posture between lines [rad].
        tool_turn: rotation of the tool about the surface normal, for better reachability [rad].
        gains: gains of the controller.
        torque_limit: torque limits, one per joint [N m]. `None` means the limits of the robot.
        frame, point: tool frame and point if there is no contact. The default is the last frame of the robot.

    Raises:
        ParameterError: a value is out of range. The message names it.
    """

    duration: float = 60.0
    dt: float = 1.0 / 240.0
    center: tuple[float, float, float] = (0.5, 0.0, 0.055)
    size: tuple[float, float] = (0.36, 0.6)
    travel_time: float = 1.0
    max_acceleration: float = 4.0
    lift_probability: float = 0.0
    lift_height: tuple[float, float] = (0.02, 0.1)
    pressing_force: tuple[float, float] = (10.0, 15.0)
    elbow_swing: float = 0.15
    tool_turn: float = 0.0
    gains: Gains = field(default_factory=Gains)
    torque_limit: tuple[float, ...] | None = None
    frame: str | None = None
    point: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        for name in ("duration", "dt", "travel_time", "max_acceleration"):
            self._check(name, 0.0 < getattr(self, name) < float("inf"), "a positive finite number")
        self._check("elbow_swing", 0.0 <= self.elbow_swing < float("inf"), NOT_NEGATIVE)
        self._check("tool_turn", abs(self.tool_turn) < float("inf"), "a finite angle")
        for name in ("lift_height", "pressing_force"):
            low, high = getattr(self, name)
            self._check(name, 0.0 <= low <= high < float("inf"), "two finite numbers, 0 <= low <= high")
        self._check("size", all(0.0 <= side < float("inf") for side in self.size), "two lengths")
        self._check("lift_probability", 0.0 <= self.lift_probability <= 1.0, "a number between 0 and 1")
        self._check("duration", self.duration >= self.dt, f"at least one step of {self.dt} s")

    def _check(self, name: str, valid: bool, expected: str) -> None:
        check_setting(name, valid, expected, getattr(self, name))

    @property
    def steps(self) -> int:
        """Number of samples."""
        return round(self.duration / self.dt)


POSE_TOLERANCE = 1e-10
"""Largest error in a component of a reached pose (metres, or the sine of an angle)."""
ITERATIONS = 150
"""Maximum number of steps from each start. Successful starts need about thirty."""
MAX_STEP = 0.3
"""Largest rotation of a joint in one step [rad], within the range of the linear model of the pose."""
DAMPING = 0.1
"""Damping of the least-squares steps relative to the squared error. It vanishes as the pose is reached."""
LEANING = 0.1
"""Fraction of the way to the preferred joint positions that a step covers in the null space of the pose."""


def inverse_kinematics(
    robot: RobotModel,
    frame: str,
    point: Sequence[float],
    position: Vector3,
    rotation: Rotation,
    starts: Tensor,
    near: JointVector,
) -> JointVector:
    """Find joint positions `(nq,)` at which a point in a frame has a given pose, by damped least squares.

    Each step is Jᵀ(J Jᵀ + μ I)⁻¹ e. The first half of the steps also move towards `near` `(nq,)` in the null
    space of J. Of the solutions from all `starts` `(k, nq)`, the closest to `near` is returned. The pose in
    the world is given by `position` `(3,)` [m] and `rotation` `(3, 3)`. With fewer than six joints, only the
    position is matched.

    Raises:
        NumericalError: the pose is not reached from any start within the joint limits.
    """
    index, x = robot.frame_index(frame), kinematics.as_point(robot, point)
    q = starts.clamp(robot.lower, robot.upper)
    for k in range(ITERATIONS):
        error, J, _ = _pose_error(robot, q, index, x, position, rotation)
        # Leaning against a joint limit would prevent convergence to the pose, so the last steps do not lean.
        leaning = LEANING * (near - q) if k < ITERATIONS // 2 else torch.zeros_like(q)
        q = q + _damped_step(J, error, leaning).clamp(-MAX_STEP, MAX_STEP)
        q = q.clamp(robot.lower, robot.upper)
    error, _, aligned = _pose_error(robot, q, index, x, position, rotation)
    reached = q[(error.abs().amax(-1) < POSE_TOLERANCE) & aligned]
    if len(reached) == 0:
        raise NumericalError(
            f"no joint positions place {frame} of robot {robot.name!r} at the pose",
            expected=f"tool point at {[round(v, 4) for v in position.tolist()]} m, normal to the surface",
            got=f"{len(starts)} unsuccessful starts",
            hint="move the rectangle into the workspace of the robot",
        )
    return reached[(reached - near).abs().sum(-1).argmin()]


def _pose_error(
    robot: RobotModel, q: Tensor, index: int, x: Tensor, position: Tensor, rotation: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the error of pose `(k, 6)` or position `(k, 3)`, its Jacobian, and whether the axes agree.

    The orientation error is the sine of an angle, which also vanishes at half a turn. In that case, the trace
    of the relative rotation is −1 instead of 3.
    """
    poses = kinematics.link_poses(robot, q)
    reached, origin = kinematics.pose_of_frame(robot, poses, index)
    shift = position - (origin + reached @ x) - robot.base_position
    error = torch.cat([orientation_error(reached, rotation.expand_as(reached)), shift], dim=-1)
    J, rows = kinematics.jacobian_of_poses(robot, poses, index, x), task_rows(robot.nq)
    asked_for = rows.start > 0 or (reached * rotation).sum((-2, -1)) > 1.0
    aligned = torch.as_tensor(asked_for).expand(len(q))
    return error[..., rows], J[..., rows, :], aligned


def _damped_step(J: Tensor, error: Tensor, leaning: Tensor) -> Tensor:
    """Return the step Jᵀ(J Jᵀ + μ I)⁻¹(e − J l) + l."""
    damping = DAMPING * (error * error).sum(-1) + torch.finfo(error.dtype).eps
    missing = (error - (J @ leaning[..., None])[..., 0])[..., None]
    damped = damping[..., None, None] * torch.eye(min(J.shape[-2:]), dtype=J.dtype)
    if J.shape[-1] < J.shape[-2]:
        return leaning + torch.linalg.solve(J.mT @ J + damped, J.mT @ missing)[..., 0]
    return leaning + (J.mT @ torch.linalg.solve(J @ J.mT + damped, missing))[..., 0]


def tool_rotation(normal: Vector3, ahead: Vector3, tool_axis: Vector3) -> Rotation:
    """Return the axes `(3, 3)` of a frame in which `tool_axis` points into the surface.

    Half a turn about the side axis turns the tool down. `normal` is the unit normal out of the surface, and
    `ahead` is a unit tangent, both `(3,)`.
    """
    down = torch.stack([-ahead, torch.linalg.cross(normal, ahead), -normal], dim=-1)
    return down @ torch.from_numpy(turn_z(tool_axis.double().numpy()).T).to(down)


STARTS = 64
"""Number of random initial joint positions for inverse kinematics, around the middle of the limits."""


@dataclass(frozen=True)
class Plan:
    """Reference for the controller.

    Attributes:
        contacts: names of the tool's contacts (none in free space).
        frame, point: the frame and point of the tool.
        reference: the motion of the tool point.
        targets: the targets of the controller, one per sample, `(n, …)`.
        start: the joint positions at the first waypoint, `(nq,)`.
    """

    contacts: tuple[str, ...]
    frame: str
    point: Sequence[float]
    reference: Reference
    targets: Target | JointTarget
    start: Tensor

    def command(self, eom: Equations, q: Tensor, qd: Tensor, k: int | Tensor, gains: Gains) -> Tensor:
        """Return the motor torque before limits, `(*batch, nq)` [N m], for the targets of samples k."""
        target = type(self.targets)(*(values[k] for values in self.targets))
        if isinstance(target, JointTarget):
            return joint_torque(eom, q, qd, target, gains)
        tool = eom.point_motion(self.frame, self.point)
        return control_torque(tool, eom, q, qd, target, self.press(eom), gains)

    def press(self, eom: Equations) -> Tensor:
        """Return the sum of the generalized unit normal forces on the tool, Σ Jᵀn/|n|, `(*batch, nq)`."""
        total = 0.0 * eom.Q_C
        for name in self.contacts:
            at = eom.contact_points[name]
            total = total + (at.jacobian.mT @ at.unit_normal[..., None])[..., 0]
        return total


def make_plan(system: ConstrainedSystem, config: MotionConfig, generator: torch.Generator) -> Plan:
    """Draw a motion of the tool over the surface of the system's first contact, or in free space.

    The tool axis points from the origin of the tool frame to the centre of the frame's contacts. An arm with
    fewer than six joints follows only the position.

    Raises:
        NumericalError: the centre of the rectangle or the first waypoint is out of reach.
    """
    robot = system.robot
    touching = [c for c in system.contacts if isinstance(c, SurfaceContact)]
    contact = touching[0] if touching else None
    frame, point = (contact.frame, contact.point) if contact else (config.frame, config.point)
    carried = [c for c in touching if c.frame == frame]
    frame = robot.frame_names[-1] if frame is None else frame
    center = kinematics.as_point(robot, config.center)
    chart = Chart.about(center, contact.center_surface if contact else None)
    count = math.ceil(config.duration / config.travel_time) + 1
    waypoints = draw_waypoints(count, config.size, config.lift_height, config.lift_probability, generator)
    t = torch.arange(config.steps, dtype=robot.dtype) * config.dt
    lines = waypoints.to(robot.dtype), t, config.travel_time, config.max_acceleration
    reference = straight_lines(chart, *lines)
    points = [c.point for c in carried] or [point]
    middle = torch.stack([kinematics.as_point(robot, x) for x in points]).mean(0)
    u, v, normal = chart.axes
    ahead = math.cos(config.tool_turn) * u + math.sin(config.tool_turn) * v
    rotation = tool_rotation(normal, ahead, _tool_axis(middle))
    draws = 2.0 * torch.rand(STARTS, robot.nq, dtype=torch.float64, generator=generator) - 1.0
    # Joint positions furthest from the limits; zero for joints without limits.
    nearest = torch.nan_to_num(0.5 * (robot.lower + robot.upper), nan=0.0, posinf=0.0, neginf=0.0)
    starts = nearest + (torch.linspace(0.0, math.pi, STARTS)[:, None] * draws).to(robot.dtype)
    home = inverse_kinematics(robot, frame, point, chart.center, rotation, starts, nearest)
    start = inverse_kinematics(robot, frame, point, reference.waypoints[0], rotation, home[None], home)
    # The elbow swings along the null space of the tool's Jacobian.
    J = kinematics.frame_jacobian(robot, home, frame, point)[task_rows(robot.nq)]
    free = torch.linalg.svd(J)[2][len(J) :]
    swing = 2.0 * torch.rand(count - 1, len(free), dtype=torch.float64, generator=generator) - 1.0
    postures = home + config.elbow_swing * swing.to(robot.dtype) @ free
    targets = Target(
        reference.position,
        reference.velocity,
        reference.acceleration,
        rotation.expand(config.steps, 3, 3),
        postures[reference.segment],
        _draw_push(reference, config, generator),
    )
    return Plan(tuple(c.name for c in carried), frame, point, reference, targets, start)


def joint_plan(system: ConstrainedSystem, config: MotionConfig, t: Tensor, motion: JointTarget) -> Plan:
    """Return a plan that follows a joint motion `(n, nq)` at times t `(n,)`, interpolated linearly."""
    robot = system.robot
    touching = [c for c in system.contacts if isinstance(c, SurfaceContact)]
    frame, point = (touching[0].frame, touching[0].point) if touching else (config.frame, config.point)
    frame = robot.frame_names[-1] if frame is None else frame
    steps = torch.arange(config.steps, dtype=t.dtype) * config.dt
    after = torch.searchsorted(t - t[0], steps).clamp(1, len(t) - 1)
    share = ((steps - (t[after - 1] - t[0])) / (t[after] - t[after - 1])).clamp(0.0, 1.0)[:, None]
    targets = JointTarget(*(x[after - 1] + share * (x[after] - x[after - 1]) for x in motion))
    poses = kinematics.link_poses(robot, targets.q)
    moving = kinematics.link_motion(robot, poses, targets.qd)
    tool = kinematics.point_motion(robot, poses, moving, targets.qd, frame, point)
    acceleration = ((tool.jacobian @ targets.qdd[..., None])[..., 0] + tool.bias)[:, 3:]
    none = torch.zeros(config.steps, dtype=torch.int64)
    path = tool.position, tool.twist[:, 3:], acceleration
    reference = Reference(steps, *path, none, none.bool(), tool.position[[0, -1]], steps[-1:], 0)
    return Plan((), frame, point, reference, targets, targets.q[0])


def _tool_axis(point: Tensor) -> Tensor:
    """Return the direction of the tool point in its frame, or the z axis if the point is at the origin."""
    if float(torch.linalg.vector_norm(point)) == 0.0:
        return torch.tensor([0.0, 0.0, 1.0], dtype=point.dtype)
    return torch.nn.functional.normalize(point, dim=-1)


def _draw_push(reference: Reference, config: MotionConfig, generator: torch.Generator) -> Tensor:
    """Draw the force into the surface `(n,)`, with one value per line and zero for lines off the surface."""
    low, high = config.pressing_force
    draws = torch.rand(len(reference.travel_time), dtype=torch.float64, generator=generator)
    return (low + (high - low) * draws).to(reference.t.dtype)[reference.segment] * reference.on_surface
