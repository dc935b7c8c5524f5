"""The tables of a mapping file, as they are validated."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from forcegp.scene.sections import Section

PerJoint = float | dict[str, float]
"""One number for all joints, or one for each by name."""


class TimeSection(Section):
    """`[time]`: the clock."""

    column: str
    stream: str | None = None
    unit: Literal["s", "ms", "us", "ns", "min"] = "s"
    start: float | None = None
    stop: float | None = None
    segment: str | None = None
    period: float | None = Field(default=None, gt=0.0)
    gap: float | None = Field(default=None, gt=0.0)
    missing: Literal["error", "drop"] = "error"
    held: Literal["keep", "drop"] = "keep"


class QuantitySection(Section):
    """`[position]`, `[velocity]`, `[acceleration]`: the columns of a joint vector, and how they are meant."""

    column: str | None = None
    columns: dict[str, str] = Field(default_factory=dict)
    stream: str | None = None
    unit: str
    sign: PerJoint = 1.0
    offset: PerJoint = 0.0
    side: Literal["joint", "motor"] = "joint"
    gear_ratio: PerJoint | None = None


class TorqueSection(QuantitySection):
    """`[torque]`: a torque, or a current with the torque constant of the motor [N m/A]."""

    torque_constant: PerJoint | None = None


class WrenchSection(Section):
    """`[wrench]`: a force-torque sensor."""

    force: tuple[str, str, str]
    torque: tuple[str, str, str] | None = None
    stream: str | None = None
    frame: str
    axes: Literal["frame", "world"] = "frame"
    force_unit: Literal["N", "kN", "mN", "kgf"] = "N"
    torque_unit: Literal["Nm", "mNm", "Ncm", "kNm"] = "Nm"
    acts_on: Literal["robot", "environment"] = "robot"
    offset: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    tool_mass: float = Field(default=0.0, ge=0.0)
    tool_com: tuple[float, float, float] = (0.0, 0.0, 0.0)


class ContactSection(Section):
    """`[contact.<name>]`: where it is known from whether a contact of the scene is closed."""

    source: Literal["column", "wrench", "multiplier", "distance", "always", "never"]
    column: str | None = None
    stream: str | None = None
    threshold: float | None = Field(default=None, gt=0.0)
    release: float | None = Field(default=None, gt=0.0)
    shortest: float = Field(default=0.05, ge=0.0)


class DerivativesSection(Section):
    """`[derivatives]`: how velocities and accelerations that the log lacks are computed."""

    method: Literal["savitzky_golay", "smoother"] = "savitzky_golay"
    source: Literal["position", "velocity"] | None = None
    window: int = Field(default=11, ge=3, le=10001)
    order: int = Field(default=3, ge=2, le=9)
    filter_torque: bool = True
    impact_margin: float | None = Field(default=None, ge=0.0)


class MappingSections(Section):
    """All tables of a mapping file."""

    time: TimeSection
    joints: dict[str, str] = Field(default_factory=dict)
    position: QuantitySection
    velocity: QuantitySection | None = None
    acceleration: QuantitySection | None = None
    torque: TorqueSection
    wrench: WrenchSection | None = None
    contact: dict[str, ContactSection] = Field(default_factory=dict)
    derivatives: DerivativesSection = DerivativesSection()
