"""The frozen description of a robot as a tree of rigid links and joints with one degree of freedom.

Joint `i` moves link `i`. The joint frame has the pose `placement` in the frame of the parent link. The link
frame is the joint frame after the motion of the joint. All inertial parameters of link `i` are expressed in
the axes of link frame `i`, and its inertia is about the centre of mass. Links connected by fixed joints are
merged. Their frames remain available by name.
"""

from __future__ import annotations

import dataclasses
import hashlib
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import torch
from torch import Tensor

from forcegp.errors import ParameterError, ShapeError, UnsupportedRobotError, check_name
from forcegp.notebook import html_table

JointType = Literal["revolute", "prismatic"]
BASE = -1
"""Joint index that denotes the fixed base."""


@dataclass(frozen=True, eq=False)
class RobotModel:
    """A robot arm with `nq` joints and `nf` named frames. All constants are in SI units and radians.

    Args:
        name: name of the robot.
        joint_names: names of the moving joints, with parents before children.
        joint_types: `"revolute"` or `"prismatic"` for each joint. Continuous joints are revolute.
        parents: index of the parent joint of each joint, or −1 for the base.
        placement_rotation: orientation of each joint frame in the parent link frame at q = 0, `(nq, 3, 3)`.
        placement_position: position of each joint frame in the parent link frame, `(nq, 3)` [m].
        axis: unit axis of each joint in the joint frame, `(nq, 3)`.
        mass: mass of each link, `(nq,)` [kg].
        com: centre of mass in the link frame, `(nq, 3)` [m].
        inertia: rotational inertia about the centre of mass in link axes, `(nq, 3, 3)` [kg m²].
        damping: viscous joint friction, `(nq,)` [N m s/rad, N s/m].
        friction: Coulomb joint friction, `(nq,)` [N m, N].
        stribeck: static friction in excess of the Coulomb level, `(nq,)` [N m, N].
        stribeck_velocity: speed over which this excess decays, `(nq,)` [rad/s, m/s].
        friction_velocity: speed scale on which Coulomb friction changes sign, `(nq,)` [rad/s, m/s].
        armature: inertia of the drive, reflected to the joint, `(nq,)` [kg m², kg].
        lower, upper: joint limits, `(nq,)` [rad, m], infinite if absent.
        velocity_limit, effort_limit: limits, `(nq,)` [rad/s, m/s], [N m, N], infinite if absent.
        frame_names: names of all links and fixed frames in the file.
        frame_parents: index of the joint that moves each frame, or −1 for the base.
        frame_rotation, frame_position: pose in the link frame of that joint, `(nf, 3, 3)`, `(nf, 3)` [m].
        base_rotation, base_position: pose of the base in the world, `(3, 3)`, `(3,)` [m].
        gravity: gravitational acceleration in the world, `(3,)` [m/s²].
        remarks: notes on questionable properties of the file, one sentence each.
        coupling: matrix C `(nq, nq)` for drives that move with several joints, at the speeds C q̇; `None` if
            each joint has its own drive. Damping, friction and armature are those of the drives.
        undriven: names of joints without a drive, which are those of a free base.
        torque_scale: torque of each drive over its nominal one, `(nq,)`; `None` if torques are measured.
        drag: quadratic and cubic damping, `(nq, 2)` [N m s²/rad², N m s³/rad³; N s²/m², N s³/m³]; `None` for
            linear damping.
        bristle: stiffness of dry friction with memory (LuGre), 0 without memory, `(nq,)` [N m/rad, N/m];
            `None` for no memory. It is read from and written to files, while equations of motion have the
            friction of a joint that keeps sliding, as above.
    """

    name: str
    joint_names: tuple[str, ...]
    joint_types: tuple[JointType, ...]
    parents: tuple[int, ...]
    placement_rotation: Tensor
    placement_position: Tensor
    axis: Tensor
    mass: Tensor
    com: Tensor
    inertia: Tensor
    damping: Tensor
    friction: Tensor
    stribeck: Tensor
    stribeck_velocity: Tensor
    friction_velocity: Tensor
    armature: Tensor
    lower: Tensor
    upper: Tensor
    velocity_limit: Tensor
    effort_limit: Tensor
    frame_names: tuple[str, ...]
    frame_parents: tuple[int, ...]
    frame_rotation: Tensor
    frame_position: Tensor
    base_rotation: Tensor
    base_position: Tensor
    gravity: Tensor
    remarks: tuple[str, ...] = ()
    coupling: Tensor | None = None
    torque_scale: Tensor | None = None
    undriven: tuple[str, ...] = ()
    drag: Tensor | None = None
    bristle: Tensor | None = None

    def __repr__(self) -> str:
        """Return a one-line summary without the values of the tensors."""
        moving = self.joint_types.count("prismatic")
        kinds = f", {moving} of them prismatic" if moving else ""
        mass = float(self.mass.detach().sum())
        kind = str(self.dtype).removeprefix("torch.")
        return f"<RobotModel {self.name!r}: {self.nq} joints{kinds}; {mass:.4g} kg; {kind} on {self.device}>"

    def _repr_html_(self) -> str:
        """Return an HTML table of the joints for notebooks."""
        head = ("joint", "type", "parent", "lower", "upper", "mass [kg]", "damping", "friction")
        numbers = torch.stack([self.lower, self.upper, self.mass, self.damping, self.friction], dim=1)
        parents = ["base" if parent == BASE else self.joint_names[parent] for parent in self.parents]
        columns = self.joint_names, self.joint_types, parents, *numbers.detach().T.tolist()
        return html_table(repr(self).strip("<>"), head, list(zip(*columns, strict=True)), self.remarks)

    @cached_property
    def nq(self) -> int:
        """Number of joints."""
        return len(self.joint_names)

    @property
    def dtype(self) -> torch.dtype:
        """Floating-point type of all constants."""
        return self.axis.dtype

    @property
    def device(self) -> torch.device:
        """Device of all constants."""
        return self.axis.device

    @cached_property
    def levels(self) -> tuple[tuple[int, ...], ...]:
        """Joints at each depth of the tree, starting with the children of the base."""
        depth: list[int] = []
        for parent in self.parents:
            depth.append(0 if parent == BASE else depth[parent] + 1)
        levels = range(max(depth, default=-1) + 1)
        return tuple(tuple(i for i, d in enumerate(depth) if d == level) for level in levels)

    @cached_property
    def ancestors(self) -> Tensor:
        """Matrix E `(nq, nq)` with E[i, j] = 1 if joint j moves link i, and 0 otherwise."""
        E = torch.eye(self.nq, dtype=self.dtype, device=self.device)
        for i, parent in enumerate(self.parents):
            if parent != BASE:
                E[i] += E[parent]
        return E

    @cached_property
    def revolute(self) -> Tensor:
        """Vector `(nq,)` that is 1 for revolute joints and 0 for prismatic joints."""
        flags = [float(kind == "revolute") for kind in self.joint_types]
        return torch.tensor(flags, dtype=self.dtype, device=self.device)

    @cached_property
    def driven(self) -> Tensor:
        """Mask `(nq,)` of the joints with a drive, which those of a free base do not have."""
        flags = [joint not in self.undriven for joint in self.joint_names]
        return torch.tensor(flags, device=self.device)

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 hash of joint names, kinematics and inertial parameters. Equal robots have equal hashes."""
        digest = hashlib.sha256(repr((self.joint_names, self.joint_types, self.parents)).encode())
        for name, value in self.tensors.items():
            digest.update(name.encode())
            digest.update(value.detach().to("cpu", torch.float64).contiguous().numpy().tobytes())
        return digest.hexdigest()[:16]

    @property
    def learned(self) -> tuple[str, ...]:
        """Names of the constants that require a gradient."""
        return tuple(name for name, x in self.tensors.items() if x.requires_grad)

    @property
    def tensors(self) -> dict[str, Tensor]:
        """All constants that are tensors, keyed by name."""
        values = ((field.name, getattr(self, field.name)) for field in dataclasses.fields(self))
        return {name: value for name, value in values if isinstance(value, Tensor)}

    @property
    def drive_inertia(self) -> Tensor:
        """Inertia Cᵀ diag(a) C `(nq, nq)` of all drives [kg m², kg]."""
        inertia = torch.diag(self.armature)
        return inertia if self.coupling is None else self.coupling.mT @ inertia @ self.coupling

    def drive_motion(self, x: Tensor) -> Tensor:
        """Convert positions, velocities or accelerations `(..., nq)` of joints to those of drives, C x."""
        return x if self.coupling is None else x @ self.coupling.mT

    def joint_motion(self, x: Tensor) -> Tensor:
        """Convert positions, velocities or accelerations `(..., nq)` of drives to those of joints, C⁻¹ x."""
        return x if self.coupling is None else x @ torch.linalg.inv(self.coupling).mT

    def joint_torque(self, tau: Tensor) -> Tensor:
        """Convert torques `(..., nq)` of drives to those of joints, Cᵀ τ, as τᵀ C q̇ is their power."""
        return tau if self.coupling is None else tau @ self.coupling

    def drive_torque(self, tau: Tensor) -> Tensor:
        """Convert torques `(..., nq)` of joints to those of drives, C⁻ᵀ τ."""
        return tau if self.coupling is None else tau @ torch.linalg.inv(self.coupling)

    def true_torque(self, tau: Tensor) -> Tensor:
        """Convert nominal torques `(..., nq)` of joints to those that act on them."""
        scale = self.torque_scale
        return tau if scale is None else self.joint_torque(scale * self.drive_torque(tau))

    def check_own_drives(self, what: str) -> None:
        """Raise `UnsupportedRobotError` if drives are coupled, which `what` does not support."""
        if self.coupling is not None:
            text = f"{what} does not support the coupled drives of robot {self.name!r}"
            raise UnsupportedRobotError(text, expected="one drive for each joint", got=self.coupling.tolist())

    def frame_index(self, frame: str) -> int:
        """Return the index of a named frame; raise an `UnknownNameError` that suggests the closest name."""
        check_name(f"frame of robot {self.name!r}", frame, self.frame_names)
        return self.frame_names.index(frame)

    def joint_index(self, joint: str) -> int:
        """Return the index of a named joint; raise an `UnknownNameError` that suggests the closest name."""
        check_name(f"joint of robot {self.name!r}", joint, self.joint_names)
        return self.joint_names.index(joint)

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> RobotModel:
        """Return the same robot with its constants on a different device or in a different precision."""
        return self.replace(**{name: x.to(device=device, dtype=dtype) for name, x in self.tensors.items()})

    def replace(self, **fields: object) -> RobotModel:
        """Return a robot with the given fields changed, as in `robot.replace(mass=mass)`.

        Raises:
            UnknownNameError: a field does not exist.
            ShapeError: a tensor has a different shape from the one it replaces.
            ParameterError: gravity or a mass is not finite.
        """
        names = [field.name for field in dataclasses.fields(self)]
        for name, value in fields.items():
            check_name("robot field", name, names)
            old = getattr(self, name)
            if isinstance(old, Tensor) and isinstance(value, Tensor) and value.shape != old.shape:
                text = f"robot field {name!r} has the wrong shape"
                raise ShapeError(text, expected=tuple(old.shape), got=tuple(value.shape))
            if name in ("gravity", "mass") and not bool(torch.isfinite(torch.as_tensor(value)).all()):
                raise ParameterError(f"robot field {name!r} is not finite", got=value)
        return dataclasses.replace(self, **fields)  # pyright: ignore[reportArgumentType]

    def check_state(self, **states: Tensor) -> None:
        """Raise `ShapeError` unless arguments have last dimension `nq` and the robot's dtype and device."""
        for name, value in states.items():
            if not isinstance(value, Tensor):
                raise ShapeError(
                    f"{name} is not a tensor",
                    expected=f"a tensor of shape (*batch, {self.nq})",
                    got=type(value).__name__,
                    hint=f"call torch.tensor({name}, dtype={self.dtype})",
                )
            if value.ndim == 0 or value.shape[-1] != self.nq:
                text = f"{name} has the wrong shape for robot {self.name!r}"
                expected = f"shape (*batch, {self.nq}) for joints {', '.join(self.joint_names)}"
                raise ShapeError(text, expected=expected, got=tuple(value.shape))
            if value.dtype != self.dtype or value.device != self.device:
                raise ShapeError(
                    f"{name} is not in the precision or on the device of robot {self.name!r}",
                    expected=f"{self.dtype} on {self.device}",
                    got=f"{value.dtype} on {value.device}",
                    hint=f"convert {name}, or the robot with robot.to(device, dtype)",
                )
