"""Robot, constraints and stabilization as records of a JSON file; surfaces are described as in scenes."""

from __future__ import annotations

from typing import Annotated, Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field

from forcegp.constraints import Constraint, PointConnection, SurfaceContact, SurfaceSchema

Point = tuple[float, float, float]
POINTS = ("point", "other_point")
SURFACES = get_args(get_args(SurfaceSchema)[0])
"""The surfaces that can be saved."""


class Record(BaseModel):
    """Base of all records: frozen; unknown fields and numbers that are not finite are errors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class RobotRecord(Record):
    """A `RobotModel` without its tensors."""

    name: str
    joint_names: tuple[str, ...]
    joint_types: tuple[Literal["revolute", "prismatic"], ...]
    parents: tuple[int, ...]
    frame_names: tuple[str, ...]
    frame_parents: tuple[int, ...]
    remarks: tuple[str, ...]


class SurfaceContactRecord(Record):
    """A point of the robot on a surface."""

    type: Literal["surface_contact"] = "surface_contact"
    name: str
    frame: str
    point: Point
    surface: SurfaceSchema
    radius: float = 0.0

    def build(self) -> Constraint:
        """The constraint."""
        return SurfaceContact(self.name, self.frame, self.point, self.surface, radius=self.radius)


class PointConnectionRecord(Record):
    """A point of the robot tied to another point."""

    type: Literal["point_connection"] = "point_connection"
    name: str
    frame: str
    point: Point
    other_frame: str | None
    other_point: Point

    def build(self) -> Constraint:
        """The constraint."""
        return PointConnection(self.name, self.frame, self.point, self.other_frame, self.other_point)


class UnsavedRecord(Record):
    """Placeholder of a constraint that is defined in Python code."""

    type: Literal["unsaved"] = "unsaved"
    name: str
    described_by: str


class BaumgarteRecord(Record):
    """Constraint stabilization."""

    natural_frequency: float
    damping_ratio: float


class SystemRecord(Record):
    """A `ConstrainedSystem` without the tensors of its robot."""

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


def contact_record(contact: Constraint) -> SurfaceContactRecord | PointConnectionRecord | UnsavedRecord:
    """The record of a contact, or a placeholder if it is defined in Python code."""
    if type(contact) is PointConnection:
        return PointConnectionRecord(**fields_of(contact, PointConnectionRecord))
    if type(contact) is not SurfaceContact:
        return UnsavedRecord(name=contact.name, described_by=type(contact).__name__)
    if type(contact.surface) not in SURFACES:
        return UnsavedRecord(name=contact.name, described_by=type(contact.surface).__name__)
    return SurfaceContactRecord(**fields_of(contact, SurfaceContactRecord), surface=contact.surface)  # pyright: ignore[reportArgumentType]
