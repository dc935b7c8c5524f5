"""Terms: forces that are linear in named columns of the state, Q_i = Σ_c w_ic φ_c(x_i), written once.

A law of joint friction, for example, is a function from the state x_i of a joint to its columns φ. The same
lines evaluate it for a batch of states in PyTorch and for the scalars of a program
(`compiled/expression.py`), from which the C code, its Jacobians and the CasADi function are derived. The
weights w are Gaussian, and their standard deviations follow from the evidence (`learning/evidence.py`).
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import Field, dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.errors import ModelError
from forcegp.forces.priors.base import JOINT, ForcePrior
from forcegp.forces.quantities import States
from forcegp.robot.model import RobotModel

Array = Any
"""A tensor `(n, nq)`, or a NumPy array `(nq,)` of scalars in a program."""
NEAR_REST = 0.02
"""Speed below which a joint or contact is nearly at rest [rad/s, m/s], the resolution of common encoders."""
SPEEDS = (NEAR_REST, 0.1, 0.5)
"""Saturation speeds of dry friction [rad/s, m/s]: a sharp step and two more gradual transitions."""
FORCE = ("N m", "N")
"""Units of forces of revolute and of sliding joints."""
Units = Mapping[str, tuple[str, str]]
"""Units for revolute and for sliding joints, by names."""


def exp(x: Array) -> Array:
    """Return eˣ."""
    return x.exp() if isinstance(x, Tensor) else np.exp(x)


def log(x: Array) -> Array:
    """Return the natural logarithm of x."""
    return x.log() if isinstance(x, Tensor) else np.log(x)


def sqrt(x: Array) -> Array:
    """Return √x."""
    return x.sqrt() if isinstance(x, Tensor) else np.sqrt(x)


def tanh(x: Array) -> Array:
    """Return tanh x."""
    return x.tanh() if isinstance(x, Tensor) else np.tanh(x)


def sin(x: Array) -> Array:
    """Return sin x."""
    return x.sin() if isinstance(x, Tensor) else np.sin(x)


def cos(x: Array) -> Array:
    """Return cos x."""
    return x.cos() if isinstance(x, Tensor) else np.cos(x)


def constants(like: Array, values: object) -> Array:
    """Return constants as a tensor or as a NumPy array, as `like` is."""
    return like.new_tensor(values) if isinstance(like, Tensor) else np.asarray(values)


@dataclass(frozen=True)
class JointState:
    """The state of each joint, from which a term computes its columns; with coupled drives, of each drive.

    Attributes:
        q, qd: positions and velocities [rad, rad/s; m, m/s].
        load: |Q_G|, the magnitude of the gravity force [N m, N].
        slip: direction of motion of a joint that may stick, which replaces tanh(q̇/v) in dry friction.
        history: states z of bristles along a log, one array per distance, or `None` for a state without past.
        recording: number of the recording `(n, 1)`, or `None` if it is unknown.
    """

    q: Array
    qd: Array
    load: Array
    slip: Array | None = None
    history: Sequence[Array] | None = None
    recording: Tensor | None = None

    def direction(self, speed: float = NEAR_REST) -> Array:
        """Return the direction of motion, tanh(q̇/v) for a saturation speed v [rad/s, m/s]."""
        return tanh(self.qd / speed) if self.slip is None or speed > NEAR_REST else self.slip


class PerJointPrior(ForcePrior):
    """A prior on one force per joint with E = I; subclasses may have a different operator.

    Forces of drives have E = Cᵀ, which is the identity unless drives are coupled. The joints of a free base
    have no drive, and therefore no such force and no remainder of it.
    """

    per_joint = True
    of_drives = False
    """Whether the forces act between the drives and their gears."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        cls.per_joint = cls.operator is PerJointPrior.operator

    def outputs(self, robot: RobotModel) -> int:
        return robot.nq

    def operator(self, system: ConstrainedSystem, at: States) -> Tensor:
        driven = system.robot.driven if self.needs_drive else torch.ones_like(system.robot.driven)
        E = torch.diag(driven.to(at.q))
        E = system.robot.joint_torque(E).mT if self.of_drives else E
        return E.expand(len(at.q), -1, -1)

    def applied(self, B: Tensor, system: ConstrainedSystem, at: States) -> Tensor:
        if not self.per_joint:
            return super().applied(B, system, at)
        # B Cᵀ
        B = system.robot.drive_motion(B) if self.of_drives else B
        return B * system.robot.driven if self.needs_drive else B

    @property
    def needs_drive(self) -> bool:
        """Whether joints without a drive have no such force."""
        return self.of_drives or self.remainder


class JointTerm(PerJointPrior):
    """A force of each joint that is linear in columns of the state of that joint.

    A subclass is a frozen dataclass with plain fields, a `name`, a kernel such as `Columns()`, and `columns`.
    It works in fits, predictions, rollouts, wrenches, C, CasADi, written-back robot files and saved models.

    Example:
        >>> from dataclasses import dataclass, field
        >>> from forcegp.gp.kernels import Columns
        >>> @dataclass(frozen=True)
        ... class AirDrag(JointTerm):
        ...     kernel: Columns = field(default_factory=Columns)
        ...     name: str = "air_drag"
        ...
        ...     def columns(self, x):
        ...         return {"quadratic": x.qd * x.qd * x.direction(0.1)}
        >>> JointTerm.laws["air_drag"] is AirDrag
        True
    """

    target = JOINT
    of_drives = True
    centred = False
    sticks = True
    laws: ClassVar[dict[str, type[JointTerm]]] = {}
    """All terms, by the names under which they are saved."""
    units: ClassVar[Units] = {}
    """Units of the weights of columns, for revolute and for sliding joints, by the first letters of the names
    of the columns. Other weights are in N m or N per unit of their column."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        name = cls.__dict__.get("name")
        name = name.default if isinstance(name, Field) else name
        if not isinstance(name, str):
            return
        other = JointTerm.laws.get(name, cls)
        # A notebook defines a class again when its cell runs again.
        if (other.__module__, other.__qualname__) != (cls.__module__, cls.__qualname__):
            text = f"the name {name!r} of {cls.__qualname__} is that of {other.__qualname__}"
            hint = "give the class its own name"
            raise ModelError(text, expected="a name that no other term has", hint=hint)
        JointTerm.laws[name] = cls

    @abstractmethod
    def columns(self, x: JointState) -> dict[str, Array]:
        """Return the named columns φ_c(x_i), each of the shape of `x.qd`.

        They may use arithmetic, `abs`, and the functions of this module, which C and CasADi have too.
        """

    def check(self, system: ConstrainedSystem) -> None:
        """Raise `ModelError` if a column is not valid at rest or in motion."""
        self.probe(system)

    def probe(self, system: ConstrainedSystem) -> Tensor:
        """Return the columns at three states of each joint `(c, 3, nq)`, one of them at rest.

        Raises:
            ModelError: a column is not finite, or of the wrong shape.
        """
        x = system.robot.mass.new_tensor([[0.0], [-0.1], [2.0]]).expand(-1, system.robot.nq)
        columns = self.columns(JointState(x, x, x.abs()))
        for name, column in columns.items():
            found = tuple(column.shape) if isinstance(column, Tensor) else repr(column)
            if found != x.shape or not bool(column.isfinite().all()):
                raise ModelError(
                    f"column {name!r} of force prior {self.name!r} is not valid",
                    expected="finite values of the shape of x.qd, also at rest and for negative q and q̇",
                    got="NaN or infinity" if found == x.shape else found,
                )
        return torch.stack([*columns.values()]) if columns else x[:0]

    def features(self, system: ConstrainedSystem, at: States) -> dict[str, Tensor]:
        robot = system.robot
        history = None if at.history is None else at.history.unbind(-1)
        q, qd, load = robot.drive_motion(at.q), robot.drive_motion(at.qd), robot.drive_torque(at.eom.Q_G)
        x = JointState(q, qd, load.abs(), at.slip, history, at.recording)
        return {name: column[..., None] for name, column in self.columns(x).items()}


EXPECTED, ONE = "expected", "one"
"""Prefix of the names of the weights ŵ of an `ExpectedForce`, and the name of a constant column."""


@dataclass(frozen=True, eq=False)
class ExpectedForce:
    """The force that learned terms are expected to have, Q̂ = Σ E Φ ŵ.

    Attributes:
        terms: terms of the joints, each with the weights ŵ `(nq,)` of its columns.
    """

    terms: tuple[tuple[JointTerm, Mapping[str, Tensor]], ...] = ()

    @classmethod
    def of(cls, priors: Sequence[ForcePrior], tensors: Mapping[str, Tensor]) -> ExpectedForce:
        """Return the force of the terms among priors whose weights are among learned tensors."""
        terms = []
        for prior in priors:
            start = f"{EXPECTED}.{prior.name}."
            keys = sorted(key for key in tensors if key.startswith(start))
            weights = {key.removeprefix(start): tensors[key] for key in keys}
            if isinstance(prior, JointTerm) and weights:
                terms.append((prior, weights))
        return cls(tuple(terms))

    def __call__(self, system: ConstrainedSystem, at: States) -> Tensor:
        """Return Q̂ `(n, nq)` at given states."""
        force = torch.zeros_like(at.q)
        for term, weights in self.terms:
            phi = {**term.features(system, at), ONE: torch.ones_like(at.q)[..., None]}
            f = torch.stack([phi[name][..., 0] * w for name, w in weights.items()]).sum(0)
            force = force + (term.operator(system, at) @ f[..., None])[..., 0]
        return force
