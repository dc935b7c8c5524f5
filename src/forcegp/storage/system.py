"""Storage of a constrained system as JSON and tensors, so that a saved model is self-contained.

The robot is saved as the tensors of `RobotModel`, bit for bit. Constraints that the user defines in Python
(an `ImplicitSurface` or a subclass of `Constraint`) cannot be saved. The file contains placeholders for them.
When it is read, the caller supplies a system with these constraints.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, Literal, get_args

import torch
from pydantic import BeforeValidator, Field
from torch import Tensor

from forcegp.constraints import (
    Baumgarte,
    ConstrainedSystem,
    Constraint,
    PointConnection,
    SurfaceContact,
    SurfaceSchema,
)
from forcegp.errors import ModelError
from forcegp.files import Record, validated
from forcegp.robot.model import RobotModel

SURFACES = get_args(get_args(SurfaceSchema)[0])
"""Classes of surfaces that can be saved."""


def _floats(value: object) -> object:
    """Convert the elements of arrays and tensors to numbers."""
    if isinstance(value, str) or not isinstance(value, Iterable):
        return value
    return tuple(x.item() if hasattr(x, "item") else x for x in value)


Point = Annotated[tuple[float, float, float], BeforeValidator(_floats)]


class RobotRecord(Record):
    """A `RobotModel` without its tensors."""

    name: str
    joint_names: tuple[str, ...]
    joint_types: tuple[Literal["revolute", "prismatic"], ...]
    parents: tuple[int, ...]
    frame_names: tuple[str, ...]
    frame_parents: tuple[int, ...]
    remarks: tuple[str, ...]
    undriven: tuple[str, ...] = ()


class ContactFields(Record):
    """A point on the robot, or a ball of the given `radius` around it, that may touch a surface."""

    name: str
    frame: str
    point: Point = (0.0, 0.0, 0.0)
    surface: SurfaceSchema
    radius: float = 0.0
    stick_speed: float | None = None

    def build(self) -> Constraint:
        """Return the constraint."""
        further = {"radius": self.radius, "stick_speed": self.stick_speed}
        return SurfaceContact(self.name, self.frame, self.point, self.surface, **further)


class ConnectionFields(Record):
    """Two coincident points. The second is fixed in the world if `other_frame` is `None`."""

    name: str
    frame: str
    point: Point = (0.0, 0.0, 0.0)
    other_frame: str | None = None
    other_point: Point = (0.0, 0.0, 0.0)

    def build(self) -> Constraint:
        """Return the constraint."""
        return PointConnection(self.name, self.frame, self.point, self.other_frame, self.other_point)


class SurfaceContactRecord(ContactFields):
    """A `SurfaceContact`."""

    type: Literal["surface_contact"] = "surface_contact"


class PointConnectionRecord(ConnectionFields):
    """A `PointConnection`."""

    type: Literal["point_connection"] = "point_connection"


class UnsavedRecord(Record):
    """Placeholder for a constraint that is defined in Python code."""

    type: Literal["unsaved"] = "unsaved"
    name: str
    described_by: str


ConstraintRecord = SurfaceContactRecord | PointConnectionRecord | UnsavedRecord


class SystemRecord(Record):
    """A `ConstrainedSystem` without the tensors of its robot."""

    robot: RobotRecord
    contacts: tuple[Annotated[ConstraintRecord, Field(discriminator="type")], ...]
    baumgarte: Baumgarte | None


def _record(contact: Constraint) -> ConstraintRecord:
    """Return the record of a constraint, or a placeholder if the constraint is defined in Python code."""
    if type(contact) is PointConnection:
        return PointConnectionRecord.model_validate(contact)
    described = contact.surface if type(contact) is SurfaceContact else contact
    if type(described) not in SURFACES:
        return UnsavedRecord(name=contact.name, described_by=type(described).__name__)
    return SurfaceContactRecord.model_validate(contact)


PREFIX = "system."
"""Prefix of the names of the robot's tensors."""
SHAPES: dict[str, tuple[str | int, ...]] = {
    "placement_rotation": ("nq", 3, 3),
    "placement_position": ("nq", 3),
    "axis": ("nq", 3),
    "com": ("nq", 3),
    "inertia": ("nq", 3, 3),
    "frame_rotation": ("nf", 3, 3),
    "frame_position": ("nf", 3),
    "base_rotation": (3, 3),
    "base_position": (3,),
    "gravity": (3,),
    "coupling": ("nq", "nq"),
    "drag": ("nq", 2),
}
"""Shapes of the robot tensors that do not consist of one number per joint."""
MAY_BE_INFINITE = ("lower", "upper", "velocity_limit", "effort_limit")


def pack_system(system: ConstrainedSystem) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Return a system as a JSON object, and CPU copies of its robot's tensors, named `system.<field>`."""
    robot, contacts = RobotRecord.model_validate(system.robot), tuple(map(_record, system.contacts))
    record = SystemRecord(robot=robot, contacts=contacts, baumgarte=system.baumgarte)
    live = system.robot.tensors.items()
    tensors = {PREFIX + name: x.detach().to("cpu", copy=True).contiguous() for name, x in live}
    return record.model_dump(mode="json"), tensors


def unpack_system(
    json: Mapping[str, Any],
    tensors: Mapping[str, Tensor],
    source: str,
    fallback: ConstrainedSystem | None = None,
) -> ConstrainedSystem:
    """Restore a system from `pack_system`. Constraints that cannot be saved are taken from `fallback`.

    Raises:
        ModelError: a field or tensor is missing or invalid, or `fallback` lacks an unsaved constraint.
    """
    record = validated(SystemRecord, dict(json), source, ModelError, ("system",))
    robot = _robot(record.robot, tensors, source)
    with ModelError.within(f"{source}: field 'system'"):
        contacts = tuple(_constraint(contact, fallback) for contact in record.contacts)
        return ConstrainedSystem(robot, contacts, record.baumgarte)


def _constraint(record: ConstraintRecord, fallback: ConstrainedSystem | None) -> Constraint:
    if not isinstance(record, UnsavedRecord):
        return record.build()
    if fallback is None:
        text = f"contact {record.name!r} is a {record.described_by} defined in Python, which is not saved"
        raise ModelError(text, hint="pass the original system: load_model(path, system=…)")
    return fallback.contact(record.name)


def _robot(record: RobotRecord, tensors: Mapping[str, Tensor], source: str) -> RobotModel:
    sizes = {"nq": len(record.joint_names), "nf": len(record.frame_names)}
    joints = {"joint_types": sizes["nq"], "parents": sizes["nq"], "frame_parents": sizes["nf"]}
    for name, length in joints.items():
        if len(getattr(record, name)) != length:
            text = f"{source}: field 'system.robot.{name}' has the wrong length"
            raise ModelError(text, expected=length, got=len(getattr(record, name)))
    # Parents come before their children, and frames belong to joints that exist.
    limits = {"parents": range(sizes["nq"]), "frame_parents": [sizes["nq"]] * sizes["nf"]}
    for name, limit in limits.items():
        for i, (parent, below) in enumerate(zip(getattr(record, name), limit, strict=True)):
            if not -1 <= parent < below:
                text = f"{source}: field 'system.robot.{name}.{i}' does not name a joint"
                raise ModelError(text, got=parent)
    axis = tensors.get(PREFIX + "axis")
    dtype = axis.dtype if axis is not None and axis.is_floating_point() else torch.float64
    arrays = {}
    for field in dataclasses.fields(RobotModel):
        absent = field.default is None and PREFIX + field.name not in tensors
        if field.name not in type(record).model_fields and not absent:
            shape = tuple(sizes.get(str(n), n) for n in SHAPES.get(field.name, ("nq",)))
            finite = field.name not in MAY_BE_INFINITE
            arrays[field.name] = take(tensors, PREFIX + field.name, shape, dtype, source, finite=finite)
    return RobotModel(**{name: getattr(record, name) for name in type(record).model_fields}, **arrays)


def take(
    tensors: Mapping[str, Tensor],
    name: str,
    shape: tuple[int | str, ...] | None,
    dtype: torch.dtype,
    source: str,
    *,
    finite: bool = True,
) -> Tensor:
    """Return a saved tensor; raise `ModelError` unless it is finite and has the given shape (`None`: any)."""
    if name not in tensors:
        raise ModelError(f"{source}: tensor {name!r} is missing")
    value = tensors[name]
    if (shape is not None and tuple(value.shape) != tuple(shape)) or value.dtype != dtype:
        text, got = f"{source}: tensor {name!r} does not fit", f"{value.dtype} of shape {tuple(value.shape)}"
        raise ModelError(text, expected=f"{dtype} of shape {shape if shape is not None else 'any'}", got=got)
    if bool(value.isnan().any()) or (finite and not bool(torch.isfinite(value).all())):
        raise ModelError(f"{source}: tensor {name!r} contains values that are not finite")
    return value


def take_robot(tensors: Mapping[str, Tensor], prefix: str, like: RobotModel, source: str) -> RobotModel:
    """Return a robot built from tensors `<prefix><field>`, checked by `take`, with other fields copied."""
    fields: dict[str, Tensor | None] = {}
    optional = {field.name for field in dataclasses.fields(RobotModel) if field.default is None}
    for name, value in like.tensors.items():
        if name in optional and prefix + name not in tensors:
            fields[name] = None
            continue
        shape, finite = tuple(value.shape), name not in MAY_BE_INFINITE
        fields[name] = take(tensors, prefix + name, shape, value.dtype, source, finite=finite)
    return like.replace(**fields)
