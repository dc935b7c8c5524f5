"""The plan of a motion: reference, posture, orientation and start, drawn before anything moves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from forcegp import kinematics
from forcegp.constraints import ConstrainedSystem
from forcegp.constraints.contact import SurfaceContact
from forcegp.control.motion import MotionConfig
from forcegp.control.placement import inverse_kinematics, tool_rotation
from forcegp.control.task_space import Target, task_rows
from forcegp.control.trajectory import Chart, Reference, draw_waypoints, straight_lines
from forcegp.robot.model import RobotModel

STARTS = 64
"""Random joint positions that inverse kinematics starts from, around the middle of the limits."""


@dataclass(frozen=True)
class Plan:
    """What the controller follows.

    Attributes:
        contacts: names of the tool's contacts, none in free space.
        frame, point: the tool point.
        reference: the motion of the tool point.
        targets: the controller's targets, `(n, …)`, one per sample.
        start: `(nq,)` joint positions at the first waypoint.
    """

    contacts: tuple[str, ...]
    frame: str
    point: Sequence[float]
    reference: Reference
    targets: Target
    start: Tensor

    def arrays(self) -> Target:
        """The targets as NumPy arrays `(n, …)`."""
        return Target(*(values.numpy() for values in self.targets))

    def press(self, eom: Any) -> Any:
        """Generalized force of a unit normal force on each of the tool's contacts `(*batch, nq)`, Σ Jᵀn/|n|.

        Args:
            eom: the equations of motion of a batch of states, or of one state in NumPy.
        """
        total = 0.0 * eom.Q_C
        for name in self.contacts:
            at = eom.contact_points[name]
            unit = at.normal / ((at.normal * at.normal).sum(-1) ** 0.5)[..., None]
            total = total + (at.jacobian.swapaxes(-1, -2) @ unit[..., None])[..., 0]
        return total


def make_plan(system: ConstrainedSystem, config: MotionConfig, generator: torch.Generator) -> Plan:
    """Draw a motion of the tool over the surface of the system's first contact, or in free space.

    The tool's axis points from the origin of its frame to the middle of the contacts that the frame carries.
    An arm with fewer than six joints follows the position alone.

    Args:
        system: robot and contacts.
        config: rectangle, times, forces.
        generator: source of the random numbers.

    Raises:
        NumericalError: the rectangle's centre or the first waypoint is out of reach.
    """
    robot = system.robot
    touching = [c for c in system.contacts if isinstance(c, SurfaceContact)]
    contact = touching[0] if touching else None
    frame, point = (contact.frame, contact.point) if contact else (config.frame, config.point)
    own = [c for c in touching if c.frame == frame]
    frame = robot.frame_names[-1] if frame is None else frame
    center = kinematics.as_point(robot, config.center)
    chart = Chart.about(center, contact.center_surface if contact else None)
    reference = _draw_reference(chart, config, generator)
    middle = torch.stack([kinematics.as_point(robot, x) for x in [c.point for c in own] or [point]]).mean(0)
    rotation = tool_rotation(chart.axes[2], _ahead(chart, config.tool_turn), _tool_axis(middle))
    draws = 2.0 * torch.rand(STARTS, robot.nq, dtype=torch.float64, generator=generator) - 1.0
    nearest = _middle_of_limits(robot)
    starts = nearest + (torch.linspace(0.0, math.pi, STARTS)[:, None] * draws).to(robot.dtype)
    home = inverse_kinematics(robot, frame, point, chart.center, rotation, starts, nearest)
    start = inverse_kinematics(robot, frame, point, reference.waypoints[0], rotation, home[None], home)
    postures = _draw_postures(robot, home, frame, point, len(reference.travel_time), config, generator)
    targets = Target(
        reference.position,
        reference.velocity,
        reference.acceleration,
        rotation.expand(config.steps, 3, 3),
        postures[reference.segment],
        _draw_push(reference, config, generator),
    )
    return Plan(tuple(c.name for c in own), frame, point, reference, targets, start)


def _ahead(chart: Chart, turn: float) -> Tensor:
    """The direction of u turned about the normal `(3,)`."""
    return math.cos(turn) * chart.axes[0] + math.sin(turn) * chart.axes[1]


def _middle_of_limits(robot: RobotModel) -> Tensor:
    """`(nq,)` joint positions furthest from their limits; zero where there are none."""
    return torch.nan_to_num(0.5 * (robot.lower + robot.upper), nan=0.0, posinf=0.0, neginf=0.0)


def _tool_axis(point: Tensor) -> Tensor:
    """The direction of the tool point in its frame, or the frame's z axis for a point at its origin."""
    if float(torch.linalg.vector_norm(point)) == 0.0:
        return torch.tensor([0.0, 0.0, 1.0], dtype=point.dtype)
    return torch.nn.functional.normalize(point, dim=-1)


def _draw_reference(chart: Chart, config: MotionConfig, generator: torch.Generator) -> Reference:
    lines = math.ceil(config.duration / config.travel_time)
    waypoints = draw_waypoints(
        lines + 1, config.size, config.lift_height, config.lift_probability, generator
    ).to(chart.center.dtype)
    t = torch.arange(config.steps, dtype=chart.center.dtype) * config.dt
    return straight_lines(chart, waypoints, t, config.travel_time, config.max_acceleration)


def _draw_postures(
    robot: RobotModel,
    home: Tensor,
    frame: str,
    point: Sequence[float],
    segments: int,
    config: MotionConfig,
    generator: torch.Generator,
) -> Tensor:
    """`(segments, nq)` postures off the home posture along the null space, where the elbow swings."""
    J = kinematics.frame_jacobian(robot, home, frame, point)[task_rows(robot.nq)]
    free = torch.linalg.svd(J)[2][len(J) :]
    swing = 2.0 * torch.rand(segments, len(free), dtype=torch.float64, generator=generator) - 1.0
    return home + config.elbow_swing * swing.to(robot.dtype) @ free


def _draw_push(reference: Reference, config: MotionConfig, generator: torch.Generator) -> Tensor:
    """`(n,)` force into the surface, one draw per line, zero on lines off the surface."""
    low, high = config.pressing_force
    draws = torch.rand(len(reference.travel_time), dtype=torch.float64, generator=generator)
    return (low + (high - low) * draws).to(reference.t.dtype)[reference.segment] * reference.on_surface
