"""Header and columns of a data set, for its checks and files."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

from pydantic import NonNegativeFloat, PositiveFloat
from torch import Tensor

from forcegp.files import Header


class DataHeader(Header):
    """Header of a data set; every field is optional, so that a foreign log can be read.

    Attributes:
        dt: sampling period [s].
        noise_std: standard deviation of the noise on q̈ [rad/s²].
        filtered: q̈ was computed by a filter, so that its noise is correlated in time; otherwise `noise_std`
            claims white noise.
        filter_span: of the filter that computed q̈ [s]: its noise is uncorrelated further apart in time.
        robot: name of the robot.
        robot_fingerprint: `RobotModel.fingerprint` of the robot that moved.
        seed: seed of the random numbers that went into the data.
        ordered: rows follow time within each segment (not so for points in order of selection).
        provenance: what was done to the data, oldest first, one line per step.
        derived: joint vectors that a filter computed from others of the log.
        imported: kind and sentence of what an import found in the log, doubts about its mapping among them.
        unmeasured_torques: joints whose motor torque was not measured; theirs is 0 in the columns.
        joint_names, contact_names: in the order of the columns; empty if not logged.
    """

    FORMAT: ClassVar[str] = "forcegp-dataset"
    VERSION: ClassVar[int] = 1

    dt: PositiveFloat | None = None
    noise_std: NonNegativeFloat | None = None
    filtered: bool = False
    filter_span: NonNegativeFloat | None = None
    robot: str | None = None
    robot_fingerprint: str | None = None
    seed: int | None = None
    ordered: bool = True
    provenance: tuple[str, ...] = ()
    derived: tuple[str, ...] = ()
    imported: tuple[tuple[str, str], ...] = ()
    unmeasured_torques: tuple[str, ...] = ()
    joint_names: tuple[str, ...] = ()
    contact_names: tuple[str, ...] = ()

    @property
    def filter_variance(self) -> float:
        """Second moment of the weights with which the filter averages q̈ over time [s²]; 0 if unknown.

        The second derivative of cubics fitted to positions over a span T is q̈ + T²/56 d²q̈/dt² + …, as is an
        average with the variance T²/28; the first derivative of cubics fitted to q̇ has no such term.
        """
        return (self.filter_span or 0.0) ** 2 / 28.0 if {"qd", "qdd"} <= set(self.derived) else 0.0

    def with_step(self, step: str, **fields: object) -> DataHeader:
        """The header with fields changed and one more line of provenance."""
        return self.model_copy(update={"provenance": (*self.provenance, step), **fields})


JOINT_VECTORS = ("q", "qd", "tau", "qdd")
"""The joint vectors that every data set holds."""
AXES = ("x", "y", "z")
"""Components of a Cartesian vector logged of a contact."""


@dataclass(frozen=True, eq=False)
class Fields:
    """What a data set holds; `Dataset` documents each field."""

    t: Tensor
    q: Tensor
    qd: Tensor
    tau: Tensor
    qdd: Tensor
    joint_names: tuple[str, ...]
    contact: Mapping[str, Tensor] = field(default_factory=dict)
    extras: Mapping[str, Tensor] = field(default_factory=dict)
    contact_extras: Mapping[str, Mapping[str, Tensor]] = field(default_factory=dict)
    segment: Tensor = None  # pyright: ignore[reportAssignmentType]  # filled in by the data set
    header: DataHeader = field(default_factory=DataHeader)

    def __len__(self) -> int:
        """Number of samples."""
        return self.t.shape[0]


def component_names(name: str, value: Tensor, joint_names: Sequence[str]) -> list[str]:
    """Names on disk of the columns of a joint vector, a contact's scalar or its Cartesian vector."""
    if value.ndim == 1:
        return [name]
    return [f"{name}.{part}" for part in (AXES if "." in name else joint_names)]


def named_columns(data: Fields) -> dict[str, Tensor]:
    """Every floating-point column but time by its name on disk, vectors whole."""
    named = {name: getattr(data, name) for name in JOINT_VECTORS} | dict(data.extras)
    for name, group in data.contact_extras.items():
        named |= {f"{name}.{contact}": value for contact, value in group.items()}
    return named


def mapped(parts: Sequence[Fields], change: Callable[[list[Tensor]], Tensor]) -> dict[str, Any]:
    """Columns of data sets of one layout; `change` gets the tensors of each column in all parts."""
    first = parts[0]
    return {
        **{name: change([getattr(p, name) for p in parts]) for name in ("t", "segment", *JOINT_VECTORS)},
        "contact": {name: change([p.contact[name] for p in parts]) for name in first.contact},
        "extras": {name: change([p.extras[name] for p in parts]) for name in first.extras},
        "contact_extras": {
            name: {c: change([p.contact_extras[name][c] for p in parts]) for c in group}
            for name, group in first.contact_extras.items()
        },
    }
