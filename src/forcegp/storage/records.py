"""Robot, constraints and stabilization as records of a JSON file."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from forcegp.constraints import (
    Constraint,
    Cylinder,
    Plane,
    PointConnection,
    Sphere,
    Surface,
    SurfaceContact,
)

Point = tuple[float, float, float]
POINTS = ("point", "other_point", "normal", "center", "axis")


class Record(BaseModel):
    """What every record shares: no other fields, finite numbers, no changes."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class RobotRecord(Record):
    """A `RobotModel` but for its tensors."""

    name: str
    joint_names: tuple[str, ...]
    joint_types: tuple[Literal["revolute", "prismatic"], ...]
    parents: tuple[int, ...]
    frame_names: tuple[str, ...]
    frame_parents: tuple[int, ...]
    remarks: tuple[str, ...]


class PlaneRecord(Record):
    """A plane."""

    type: Literal["plane"] = "plane"
    normal: Point
    offset: float

    def build(self) -> Surface:
        """The surface that is recorded."""
        return Plane(self.normal, self.offset)


class SphereRecord(Record):
    """A sphere."""

    type: Literal["sphere"] = "sphere"
    center: Point
    radius: float

    def build(self) -> Surface:
        """The surface that is recorded."""
        return Sphere(self.center, self.radius)


class CylinderRecord(Record):
    """A cylinder."""

    type: Literal["cylinder"] = "cylinder"
    center: Point
    axis: Point
    radius: float

    def build(self) -> Surface:
        """The surface that is recorded."""
        return Cylinder(self.center, self.axis, self.radius)


class SurfaceContactRecord(Record):
    """A point of the robot on a surface."""

    type: Literal["surface_contact"] = "surface_contact"
    name: str
    frame: str
    point: Point
    surface: Annotated[PlaneRecord | SphereRecord | CylinderRecord, Field(discriminator="type")]

    def build(self) -> Constraint:
        """The constraint that is recorded."""
        return SurfaceContact(self.name, self.frame, self.point, self.surface.build())


class PointConnectionRecord(Record):
    """A point of the robot tied to another point."""

    type: Literal["point_connection"] = "point_connection"
    name: str
    frame: str
    point: Point
    other_frame: str | None
    other_point: Point

    def build(self) -> Constraint:
        """The constraint that is recorded."""
        return PointConnection(self.name, self.frame, self.point, self.other_frame, self.other_point)


class UnsavedRecord(Record):
    """The place of a constraint that only Python code can describe."""

    type: Literal["unsaved"] = "unsaved"
    name: str
    described_by: str


class BaumgarteRecord(Record):
    """Constraint stabilization."""

    natural_frequency: float
    damping_ratio: float


class SystemRecord(Record):
    """A `ConstrainedSystem` but for the tensors of its robot."""

    robot: RobotRecord
    contacts: tuple[
        Annotated[SurfaceContactRecord | PointConnectionRecord | UnsavedRecord, Field(discriminator="type")],
        ...,
    ]
    baumgarte: BaumgarteRecord | None


def fields_of(value: Any, record: type[Record]) -> dict[str, Any]:
    """The attributes of a value that a record keeps."""
    names = [name for name in record.model_fields if name not in ("type", "surface")]
    kept = {name: getattr(value, name) for name in names}
    return kept | {name: tuple(map(float, kept[name])) for name in POINTS if name in kept}


def _surface_record(surface: Surface) -> PlaneRecord | SphereRecord | CylinderRecord | None:
    if type(surface) is Plane:
        return PlaneRecord(**fields_of(surface, PlaneRecord))
    if type(surface) is Sphere:
        return SphereRecord(**fields_of(surface, SphereRecord))
    return CylinderRecord(**fields_of(surface, CylinderRecord)) if type(surface) is Cylinder else None


def contact_record(contact: Constraint) -> SurfaceContactRecord | PointConnectionRecord | UnsavedRecord:
    """The record of a contact, or of its place where only Python code can describe it."""
    if type(contact) is PointConnection:
        return PointConnectionRecord(**fields_of(contact, PointConnectionRecord))
    if type(contact) is not SurfaceContact:
        return UnsavedRecord(name=contact.name, described_by=type(contact).__name__)
    surface = _surface_record(contact.surface)
    if surface is None:
        return UnsavedRecord(name=contact.name, described_by=type(contact.surface).__name__)
    return SurfaceContactRecord(**fields_of(contact, SurfaceContactRecord), surface=surface)
