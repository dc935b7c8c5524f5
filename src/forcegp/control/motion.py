"""The settings of a motion: where the tool goes, how fast, how hard it presses, and how it is controlled."""

from __future__ import annotations

from dataclasses import dataclass, field

from forcegp.control.task_space import Gains
from forcegp.errors import ParameterError


@dataclass(frozen=True)
class MotionConfig:
    """A random motion of the tool over a surface, or in free space; the defaults are the paper's task.

    Args:
        duration: length of the motion [s].
        dt: sampling period of the motion and of the controller [s].
        center: centre of the rectangle, moved onto the surface if there is a contact [m].
        size: side lengths of the rectangle, ahead and across [m].
        travel_time: time between two waypoints [s].
        max_acceleration: of the end-effector along a line [m/s²].
        lift_probability: probability that a waypoint lies above the surface; 0 stays in contact.
        lift_height: range of heights of such a waypoint [m].
        pressing_force: range of the force that presses on the surface, drawn for each line [N].
        elbow_swing: how far the posture in the null space varies from line to line [rad].
        tool_turn: turn of the tool about the surface's normal, for arms that reach better so [rad].
        gains: gains of the controller.
        torque_limit: one per joint, or `None` for the robot's own limits [N m].
        frame, point: the tool where there is no contact; by default the last frame of the robot.

    Raises:
        ParameterError: a value is out of range; the message names it.
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
        self._check_not_negative("elbow_swing")
        self._check("tool_turn", abs(self.tool_turn) < float("inf"), "a finite angle")
        for name in ("lift_height", "pressing_force"):
            low, high = getattr(self, name)
            self._check(name, 0.0 <= low <= high < float("inf"), "two finite numbers, 0 <= low <= high")
        self._check("size", all(0.0 <= side < float("inf") for side in self.size), "two lengths")
        self._check("lift_probability", 0.0 <= self.lift_probability <= 1.0, "a number between 0 and 1")
        self._check("duration", self.duration >= self.dt, f"at least one step of {self.dt} s")

    @property
    def steps(self) -> int:
        """Number of samples."""
        return round(self.duration / self.dt)

    def _check_not_negative(self, *names: str) -> None:
        for name in names:
            self._check(name, 0.0 <= getattr(self, name) < float("inf"), "a finite number, 0 or above")

    def _check(self, name: str, valid: bool, expected: str) -> None:
        if not valid:
            raise ParameterError(f"{name} is out of range", expected=expected, got=getattr(self, name))
