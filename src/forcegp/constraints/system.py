"""Constrained systems: a robot, its constraints, their stabilization, and the equations of motion."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import torch
from torch import Tensor
from torch.linalg import vecdot

from forcegp import dynamics, kinematics
from forcegp.constraints.contact import Constraint, ConstraintTerms, SurfaceContact
from forcegp.constraints.gauss import Equations, Linearization, linearize
from forcegp.errors import ParameterError, ShapeError, UnknownNameError
from forcegp.kinematics import LinkMotion, LinkPoses, PointMotion
from forcegp.notebook import html_table
from forcegp.resources import announce_memory
from forcegp.robot.model import RobotModel
from forcegp.types import ConstraintVector, JointVector

SQUARE, LINEAR = 20, 60
"""Measured peak number of matrices and vectors, over joints and constraint rows, per state."""
CERTAIN = 0.25
"""Fraction of the memory bound that every measured computation exceeded."""


@dataclass(frozen=True)
class Baumgarte:
    """Baumgarte stabilization, which damps the constraint error according to c̈ + 2ωξ ċ + ω² c = 0 (eq. 29).

    The right-hand side becomes b̃ = b − 2ωξ A q̇ − ω² c. Equation (30) of the paper has the opposite signs,
    for which the error would grow.

    Args:
        natural_frequency: natural frequency ω > 0 [rad/s].
        damping_ratio: damping ratio ξ > 0; 1 is critical damping.

    Raises:
        ParameterError: a parameter is not positive.
    """

    natural_frequency: float = 10.0
    damping_ratio: float = 1.0

    def __post_init__(self) -> None:
        for name in ("natural_frequency", "damping_ratio"):
            value = getattr(self, name)
            if not 0.0 < value < float("inf"):
                raise ParameterError(
                    f"Baumgarte's {name} must be positive",
                    expected="a positive finite number",
                    got=value,
                    hint="pass baumgarte=None for no stabilization",
                )

    def stabilized(self, b: ConstraintVector, c: ConstraintVector, cd: ConstraintVector) -> ConstraintVector:
        """Return b̃ = b − 2ωξ ċ − ω² c, `(*batch, m)` (eq. 30, with its signs corrected)."""
        omega = self.natural_frequency
        return b - 2.0 * omega * self.damping_ratio * cd - omega**2 * c


@dataclass(frozen=True, eq=False)
class ConstrainedSystem:
    """A robot with its constraints.

    Args:
        robot: the robot.
        contacts: the constraints; if there are none, the robot moves freely.
        baumgarte: stabilization of the constraint error, or `None`.

    Example:
        >>> import forcegp
        >>> robot = forcegp.load_robot("kuka_iiwa")
        >>> floor = forcegp.Plane(offset=0.05)
        >>> table = forcegp.SurfaceContact("table", "lbr_iiwa_link_7", (0.0, 0.0, 0.1), floor)
        >>> ConstrainedSystem(robot, [table], Baumgarte()).m
        1

    Raises:
        UnknownNameError: a contact is attached to an unknown frame.
        ParameterError: two contacts have the same name, or a point is not valid.
    """

    robot: RobotModel
    contacts: Sequence[Constraint] = ()
    baumgarte: Baumgarte | None = None

    def __post_init__(self) -> None:
        names = [contact.name for contact in self.contacts]
        for name in names:
            if names.count(name) > 1:
                raise ParameterError(
                    f"two contacts are named {name!r}", hint="give each contact a unique name"
                )
        for contact in self.contacts:
            contact.check(self.robot)

    def __repr__(self) -> str:
        """Return a one-line summary of the robot and its contacts, without numerical values."""
        contacts = ", ".join(f"{type(contact).__name__} {contact.name!r}" for contact in self.contacts)
        rule = f"; {self.baumgarte}" if self.baumgarte is not None else ""
        return f"<ConstrainedSystem: {self.robot!r}; {contacts or 'no contacts'}{rule}>"

    def _repr_html_(self) -> str:
        """Return a table of the constraints for notebooks."""
        rows = [
            (c.name, type(c).__name__, ", ".join(dict(c.anchors)), str(getattr(c, "surface", "–")))
            for c in self.contacts
        ]
        notes = [] if self.baumgarte is None else [str(self.baumgarte)]
        head = ("constraint", "kind", "frames", "surface")
        title = f"ConstrainedSystem of {repr(self.robot).strip('<>')}"
        return html_table(title, head, rows, notes)

    @property
    def contact_names(self) -> tuple[str, ...]:
        """Names of the constraints, in order."""
        return tuple(contact.name for contact in self.contacts)

    @property
    def m(self) -> int:
        """Number of constraint rows."""
        return sum(contact.rows for contact in self.contacts)

    @property
    def row_names(self) -> list[str]:
        """Name of each constraint row: the name of the constraint, numbered if there are several rows."""
        rows = ((c.name, c.rows, row + 1) for c in self.contacts for row in range(c.rows))
        return [name if count == 1 else f"{name} {row}" for name, count, row in rows]

    def contact(self, name: str) -> Constraint:
        """Return the constraint with the given name.

        Raises:
           UnknownNameError: the contact does not exist.
        """
        if name not in self.contact_names:
            raise UnknownNameError("contact", name, self.contact_names)
        return self.contacts[self.contact_names.index(name)]

    @cached_property
    def rows(self) -> dict[str, slice]:
        """Constraint rows of each constraint, keyed by name."""
        ends = itertools.accumulate(contact.rows for contact in self.contacts)
        return {c.name: slice(end - c.rows, end) for c, end in zip(self.contacts, ends, strict=True)}

    @cached_property
    def may_stick(self) -> list[tuple[int, SurfaceContact, slice]]:
        """Contacts that may stick, each with its index and its two tangential rows."""
        return [
            (k, contact, slice(rows.start + 1, rows.stop))
            for k, (contact, rows) in enumerate(zip(self.contacts, self.rows.values(), strict=True))
            if isinstance(contact, SurfaceContact) and contact.stick_speed is not None
        ]

    @cached_property
    def can_open(self) -> Tensor:
        """Mask `(n_contacts,)` of the constraints that can open, namely the contacts with a surface."""
        flags = [isinstance(contact, SurfaceContact) for contact in self.contacts]
        return torch.tensor(flags, dtype=torch.bool, device=self.robot.device)

    @property
    def state_bytes(self) -> int:
        """Upper bound on the memory needed to evaluate the equations of motion at one state [bytes]."""
        width = self.robot.nq + self.m
        return 8 * (SQUARE * width**2 + LINEAR * width)

    def announce_states(self, states: int, copies: float, what: str) -> None:
        """Warn about or reject a computation at many states at once (see `announce_memory`).

        `copies` is the peak memory relative to that of the equations of motion; `what` names the computation.

        Raises:
            MemoryLimitError: the computation needs more memory than is free.
        """
        needed = int(copies * states * self.state_bytes)
        announce_memory(needed, what, certain=int(CERTAIN * needed))

    def with_robot(self, robot: RobotModel) -> ConstrainedSystem:
        """Return the same constraints on a robot with different parameters."""
        return dataclasses.replace(self, robot=robot)

    def with_stick_speeds(self, speeds: Mapping[str, float]) -> ConstrainedSystem:
        """Return the system with the given stick speeds [m/s] for contacts that do not specify one."""
        contacts = [
            dataclasses.replace(each, stick_speed=speeds[each.name])
            if isinstance(each, SurfaceContact) and each.stick_speed is None and each.name in speeds
            else each
            for each in self.contacts
        ]
        changed = any(new is not old for new, old in zip(contacts, self.contacts, strict=True))
        return dataclasses.replace(self, contacts=contacts) if changed else self

    def active_rows(self, active: Tensor | None, batch: torch.Size) -> Tensor:
        """Expand a mask of active contacts `(*batch, n_contacts)` to rows `(*batch, m)`; `None` selects all.

        Raises:
            ShapeError: the mask is not boolean, or does not match the contacts and the batch shape.
        """
        n = len(self.contacts)
        if active is None:
            return torch.ones(*batch, self.m, dtype=torch.bool, device=self.robot.device)
        if not isinstance(active, Tensor):
            raise ShapeError("active is not a tensor", expected="a bool tensor", got=type(active).__name__)
        sizes = zip(reversed(active.shape), reversed((*batch, n)), strict=False)
        fits = 0 < active.ndim <= len(batch) + 1 and active.shape[-1] == n
        if not fits or not all(a in (1, b) for a, b in sizes) or active.dtype != torch.bool:
            raise ShapeError(
                f"active does not match the contacts {', '.join(self.contact_names) or '(none)'}",
                expected=f"bool of shape {(*batch, n)}",
                got=f"{str(active.dtype).removeprefix('torch.')} of shape {tuple(active.shape)}",
            )
        return active[..., self._contact_of_row].expand(*batch, self.m)

    def equations(self, q: JointVector, qd: JointVector, active: Tensor | None = None) -> Equations:
        """Return the equations of motion at states (q, q̇).

        Args:
            q, qd: `(*batch, nq)` joint positions and velocities.
            active: `(*batch, n_contacts)` bool, the closed contacts of each sample; all by default.

        Example:
            >>> import torch, forcegp
            >>> system = forcegp.load_scene("kuka_plane").system()
            >>> q, qd = torch.zeros(2, 7, dtype=torch.float64)
            >>> eom = system.equations(q, qd)
            >>> eom.A.shape, eom.multiplier(eom.Q_K).shape
            (torch.Size([1, 7]), torch.Size([1]))

        Raises:
            ShapeError: an argument has the wrong shape, dtype or device.
        """
        robot = self.robot
        robot.check_state(q=q, qd=qd)
        if q.shape != qd.shape:
            raise ShapeError("q and qd have different batch shapes", expected=[*q.shape], got=[*qd.shape])
        poses, motion, point_motion = self._moving(q, qd)
        robot_terms = dynamics.known_terms(robot, poses, motion, qd)
        return self._assembled(q, qd, active, robot_terms, point_motion, lambda: (poses, motion))

    def _assembled(
        self,
        q: Tensor,
        qd: Tensor,
        active: Tensor | None,
        robot_terms: tuple[Tensor, Tensor, Tensor, Tensor],
        point_motion: Callable[[str, Sequence[float]], PointMotion],
        links: Callable[[], tuple[LinkPoses, LinkMotion]],
    ) -> Equations:
        """Assemble the equations of motion from M, Q_C, Q_G, Q_D and the motion of the constraint points."""
        terms = self._terms(point_motion)
        c, cd, A, b, holds = self._rows(q, qd, terms, active)
        touching = zip(self.contact_names, (term.point for term in terms), strict=True)
        points = {name: point for name, point in touching if point is not None}
        M, Q_C, Q_G, Q_D = robot_terms
        return Equations(M, A, b, c, cd, Q_C, Q_G, Q_D, points, point_motion, links, holds)

    def linearize(
        self, q: JointVector, qd: JointVector, force: JointVector, active: Tensor | None = None
    ) -> Linearization:
        """Return the constrained acceleration and the multiplier, with their Jacobians.

        The acceleration is q̈(q, q̇, Q) = L b + H (Q_C + Q_G + Q_D + Q). The exact derivatives with respect
        to q, q̇ and Q are detached from the autograd graph. If Q depends on the state, as learned forces do,
        add `dforce` times the derivative of Q.

        Args:
            q, qd: `(*batch, nq)` joint positions and velocities.
            force: `(*batch, nq)` sum Q of the motor torques and all forces missing from the robot file.
            active: `(*batch, n_contacts)` bool, the closed contacts of each sample; all by default.

        Raises:
            ShapeError: an argument has the wrong shape, dtype or device.

        Example:
            >>> import torch, forcegp
            >>> system = forcegp.load_scene("kuka_plane").system()
            >>> at = system.linearize(*torch.zeros(3, 7, dtype=torch.float64))
            >>> at.dq.shape, at.multiplier_dforce.shape
            (torch.Size([7, 7]), torch.Size([1, 7]))
        """
        self.robot.check_state(force=force)
        if force.shape != q.shape:
            raise ShapeError("q and force have unequal batch shapes", expected=[*q.shape], got=[*force.shape])
        with torch.no_grad():
            eom = self.equations(q, qd, active)

        def rows(q: Tensor, qd: Tensor) -> tuple[Tensor, Tensor]:
            return self._rows(q, qd, self._terms(self._moving(q, qd)[2]), active)[2:4]

        return linearize(self.robot, eom, rows, q, qd, force)

    @cached_property
    def _contact_of_row(self) -> Tensor:
        """Index of the contact of each constraint row, `(m,)`."""
        rows = [i for i, contact in enumerate(self.contacts) for _ in range(contact.rows)]
        return torch.tensor(rows, dtype=torch.int64, device=self.robot.device)

    def _moving(
        self, q: Tensor, qd: Tensor
    ) -> tuple[LinkPoses, LinkMotion, Callable[[str, Sequence[float]], PointMotion]]:
        """Return the poses and motion of the links, and a function that computes the motion of a point."""
        poses = kinematics.link_poses(self.robot, q)
        motion = kinematics.link_motion(self.robot, poses, qd)
        return poses, motion, partial(kinematics.point_motion, self.robot, poses, motion, qd)

    def _terms(self, point_motion: Callable[[str, Sequence[float]], PointMotion]) -> list[ConstraintTerms]:
        """Evaluate the constraints from the motion of their points."""
        return [c.terms_of([point_motion(*anchor) for anchor in c.anchors]) for c in self.contacts]

    def _rows(
        self, q: Tensor, qd: Tensor, terms: Sequence[ConstraintTerms], active: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Return c and ċ of all contacts, and A, stabilized b and the row mask of active contacts."""
        if len(terms) == 1:
            c, A, b = terms[0].c, terms[0].A, terms[0].b
        else:
            empty, none = q.new_zeros(*q.shape[:-1], 0), q.new_zeros(*q.shape[:-1], 0, q.shape[-1])
            c = torch.cat([empty, *(term.c for term in terms)], dim=-1)
            b = torch.cat([empty, *(term.b for term in terms)], dim=-1)
            A = torch.cat([none, *(term.A for term in terms)], dim=-2)
        # ċ = A q̇ (eq. 27), b̃ = b − 2ωξ ċ − ω² c (eq. 30 with the signs corrected)
        cd = vecdot(A, qd[..., None, :])
        if self.baumgarte is not None:
            b = self.baumgarte.stabilized(b, c, cd)
        # A = 0 and b = 0 for open contacts, and along the surface where a contact slides
        open_ = self.active_rows(active, q.shape[:-1]).logical_not()
        if any(term.holds is not None for term in terms):
            holds = [torch.ones_like(t.b, dtype=torch.bool) if t.holds is None else t.holds for t in terms]
            open_ = open_ | torch.cat(holds, dim=-1).logical_not()
        return c, cd, A.masked_fill(open_[..., None], 0.0), b.masked_fill(open_, 0.0), ~open_
