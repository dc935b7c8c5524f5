"""Analytical parameters θ_A, which are the learnable parameters of a robot.

| quantity            | coordinates of each joint j                                         | number |
|---------------------|---------------------------------------------------------------------|--------|
| `inertia`           | log-Cholesky form of the pseudo-inertia of the link that j moves    | 10     |
| `mass`              | log m of that link                                                  | 1      |
| `com`               | centre of mass of that link [m]                                     | 3      |
| `offset`            | rotation vector and translation [m] of j's placement                | 6      |
| `damping`, `friction`, `stribeck`, `stribeck_velocity`, `friction_velocity`, `armature` | log | 1 each |

If the initial robot is physical, the robot is physical for all values of the coordinates.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import torch
from torch import Tensor, nn

from forcegp.batchlast import skew
from forcegp.errors import InertiaError, ModelError, check_name
from forcegp.robot.inertia import from_log_cholesky, from_pseudo_inertia, log_cholesky, pseudo_inertia
from forcegp.robot.model import RobotModel

POSITIVE = (
    "mass", "damping", "friction", "stribeck", "stribeck_velocity", "friction_velocity", "armature",
)  # fmt: skip
QUANTITIES = ("inertia", "com", "offset", *POSITIVE)
SMALLEST = 1e-3
"""Initial value of friction and drive parameters that are zero in the robot, since logarithms are learned."""


class AnalyticalParameters(nn.Module):
    """The learnable parameters of a robot. Calling the module returns the robot with these parameters.

    The state dict has one tensor per quantity, `coordinates.<quantity>`, with one row per joint. The tensors
    have the device and precision of the robot. To change these, start from `robot.to(...)`.

    Args:
        robot: a robot with the initial values and the parameters that are not learned.
        learn: joint names or `"all"` for each quantity, as in `{"mass": ["joint_7"], "damping": "all"}`. For
            inertia, mass and centre of mass, a joint name refers to the link that the joint moves.

    Example:
        >>> import torch, forcegp
        >>> robot = forcegp.load_robot("double_pendulum")
        >>> theta = AnalyticalParameters(robot, {"mass": [robot.joint_names[-1]]})
        >>> learned = theta()  # differentiable in theta.parameters()
        >>> learned.mass.requires_grad
        True

    Raises:
        UnknownNameError: a quantity or a joint does not exist.
        ModelError: no parameters are selected, or the inertia of a link is selected twice.
        InertiaError: `inertia` is learned for a link with unphysical inertia.
    """

    def __init__(self, robot: RobotModel, learn: Mapping[str, Sequence[str] | Literal["all"]]) -> None:
        super().__init__()
        self.start = robot
        self.joints = {quantity: _joints(robot, quantity, names) for quantity, names in learn.items()}
        _check(self.joints)
        self._rows = {
            quantity: torch.tensor([robot.joint_index(name) for name in names], device=robot.device)
            for quantity, names in self.joints.items()
        }
        self.coordinates = nn.ParameterDict({name: self._initial(name) for name in self.joints})

    def forward(self) -> RobotModel:
        """Return the robot with the learned parameters, which is differentiable in the coordinates."""
        fields: dict[str, Tensor] = {}
        for quantity, x in self.coordinates.items():
            for name, rows in self._fields(quantity, x).items():
                old = fields[name] if name in fields else getattr(self.start, name)
                fields[name] = old.index_copy(0, self._rows[quantity], rows)
        return self.start.replace(**fields)

    def reset(
        self, generator: torch.Generator, *, relative: float = 0.0, length: float = 0.0, angle: float = 0.0
    ) -> None:
        """Draw all coordinates uniformly from intervals around the initial robot.

        The half-widths are `relative` for logarithms (a factor of up to e^{±relative}), `length` for centres
        of mass and translations [m], and `angle` for rotations [rad].
        """
        for quantity, x in self.coordinates.items():
            half = torch.full_like(x, relative)
            if quantity == "com":
                half[:] = length
            elif quantity == "offset":
                half[:, :3], half[:, 3:] = angle, length
            elif quantity == "inertia":
                half[:, 4:] = length
            noise = 2.0 * torch.rand(x.shape, generator=generator, dtype=torch.float64) - 1.0
            x.data.copy_(self._initial(quantity).data + half * noise.to(x))

    def _initial(self, quantity: str) -> nn.Parameter:
        robot, rows = self.start, self._rows[quantity]
        if quantity == "inertia":
            parts = (x[rows] for x in (robot.mass, robot.com, robot.inertia))
            bodies = zip(self.joints[quantity], *parts, strict=True)
            return nn.Parameter(torch.stack([_log_cholesky(*body) for body in bodies]))
        if quantity == "com":
            return nn.Parameter(robot.com[rows].clone())
        if quantity == "offset":
            return nn.Parameter(torch.zeros(len(rows), 6, dtype=robot.dtype, device=robot.device))
        values = getattr(robot, quantity)[rows]
        if quantity == "mass" and bool((values <= 0.0).any()):
            name = self.joints[quantity][int(values.argmin())]
            raise InertiaError(f"the link of joint {name!r} has no mass to learn", expected="a positive mass")
        return nn.Parameter(torch.where(values > 0.0, values, torch.full_like(values, SMALLEST)).log())

    def _fields(self, quantity: str, x: Tensor) -> dict[str, Tensor]:
        if quantity == "inertia":
            parts = from_pseudo_inertia(from_log_cholesky(x))
            return dict(zip(("mass", "com", "inertia"), parts, strict=True))
        if quantity == "offset":
            rows = self._rows[quantity]
            turn = torch.linalg.matrix_exp(skew(x[:, :3].T).permute(2, 0, 1))
            return {
                "placement_rotation": self.start.placement_rotation[rows] @ turn,
                "placement_position": self.start.placement_position[rows] + x[:, 3:],
            }
        return {quantity: x if quantity == "com" else x.exp()}


def _joints(robot: RobotModel, quantity: str, names: Sequence[str] | Literal["all"]) -> tuple[str, ...]:
    check_name("quantity to learn", quantity, QUANTITIES)
    chosen = tuple(names) if names != "all" else robot.joint_names
    if names == "all" and quantity in ("mass", "inertia"):
        # Links between the joints of a body, such as a free base, have neither.
        empty = (robot.mass == 0.0) & (robot.inertia == 0.0).flatten(1).all(-1)
        chosen = tuple(name for name, none in zip(chosen, empty.tolist(), strict=True) if not none)
    for name in chosen:
        robot.joint_index(name)
    return tuple(dict.fromkeys(chosen))


def _check(joints: Mapping[str, tuple[str, ...]]) -> None:
    if not any(joints.values()):
        raise ModelError("no analytical parameter is selected", expected="joints for at least one quantity")
    for part in ("mass", "com"):
        twice = set(joints.get("inertia", ())) & set(joints.get(part, ()))
        if twice:
            text = f"{part} and inertia of the link of joint {min(twice)!r} are both selected"
            hint = f"inertia contains {part}: remove {part} for this joint"
            raise ModelError(text, expected="one of them", hint=hint)


def _log_cholesky(joint: str, mass: Tensor, com: Tensor, inertia: Tensor) -> Tensor:
    try:
        return log_cholesky(pseudo_inertia(mass, com, inertia))
    except InertiaError as error:
        text = f"the inertia of the link of joint {joint!r} is not physical, so it has no log-Cholesky form"
        hint = "learn its mass or com alone, or start from a robot with a physical inertia"
        raise InertiaError(text, expected=error.expected, got=error.got, hint=hint) from error
