"""A robot with its constraints, and the equations of motion that follow from them at a state."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from forcegp import dynamics, kinematics
from forcegp.constraints.baumgarte import Baumgarte
from forcegp.constraints.contact import Constraint
from forcegp.constraints.gauss import Equations
from forcegp.errors import ForceGPError, ShapeError, UnknownNameError
from forcegp.robot.model import RobotModel
from forcegp.types import JointVector


@dataclass(frozen=True, eq=False)
class ConstrainedSystem:
    """A robot with its constraints.

    Args:
        robot: the robot.
        contacts: the constraints; an empty sequence is free motion.
        baumgarte: stabilization of the constraint error, or `None`.

    Raises:
        UnknownNameError: a contact names a frame that the robot has not.
        ForceGPError: two contacts share a name.
    """

    robot: RobotModel
    contacts: Sequence[Constraint] = ()
    baumgarte: Baumgarte | None = None

    def __post_init__(self) -> None:
        names = [contact.name for contact in self.contacts]
        for name in names:
            if names.count(name) > 1:
                raise ForceGPError(f"two contacts are named {name!r}", hint="give each contact its own name")
        for contact in self.contacts:
            contact.check(self.robot)

    @property
    def contact_names(self) -> tuple[str, ...]:
        """Names of the constraints, in order."""
        return tuple(contact.name for contact in self.contacts)

    @property
    def m(self) -> int:
        """Number of constraint rows."""
        return sum(contact.rows for contact in self.contacts)

    def contact(self, name: str) -> Constraint:
        """A constraint by name.

        Raises:
            UnknownNameError: no such contact.
        """
        for contact in self.contacts:
            if contact.name == name:
                return contact
        raise UnknownNameError("contact", name, self.contact_names)

    def with_robot(self, robot: RobotModel) -> ConstrainedSystem:
        """The same constraints on a robot with other parameters."""
        return dataclasses.replace(self, robot=robot)

    def active_rows(self, active: Tensor | None, batch: torch.Size) -> Tensor:
        """`(*batch, m)` bool from `(*batch, n_contacts)` bool, all active for `None`.

        Raises:
            ShapeError: not boolean, or a shape that does not fit the contacts and the batch.
        """
        n, device = len(self.contacts), self.robot.device
        if active is None:
            return torch.ones(*batch, self.m, dtype=torch.bool, device=device)
        sizes = zip(reversed(active.shape), reversed((*batch, n)), strict=False)
        fits = (
            0 < active.ndim <= len(batch) + 1 and active.shape[-1] == n and all(a in (1, b) for a, b in sizes)
        )
        if not fits or active.dtype != torch.bool:
            raise ShapeError(
                f"active does not fit the contacts {', '.join(self.contact_names) or '(none)'}",
                expected=f"bool of shape {(*batch, n)}",
                got=f"{str(active.dtype).removeprefix('torch.')} of shape {tuple(active.shape)}",
            )
        repeats = torch.tensor([contact.rows for contact in self.contacts], dtype=torch.int64, device=device)
        return active.repeat_interleave(repeats, dim=-1).expand(*batch, self.m)

    def equations(self, q: JointVector, qd: JointVector, active: Tensor | None = None) -> Equations:
        """The equations of motion at states (q, q̇).

        Args:
            q, qd: `(*batch, nq)` joint positions and velocities.
            active: `(*batch, n_contacts)` bool, which contacts are closed in each sample; default all.

        Raises:
            ShapeError: an argument does not fit.
        """
        robot = self.robot
        robot.check_state(q=q, qd=qd)
        if q.shape != qd.shape:
            raise ShapeError("q and qd are not one batch", expected=tuple(q.shape), got=tuple(qd.shape))
        poses = kinematics.link_poses(robot, q)
        motion = kinematics.link_motion(robot, poses, qd)
        links = dynamics.link_inertia(robot, poses)
        terms = {contact.name: contact.terms(robot, poses, motion, qd) for contact in self.contacts}
        c, A, b = self._stack(q, list(terms.values()))
        cd = (A @ qd[..., None])[..., 0]
        if self.baumgarte is not None:
            b = self.baumgarte.stabilized(b, c, cd)
        rows = self.active_rows(active, q.shape[:-1])
        return Equations(
            M=dynamics.mass_matrix_of_poses(robot, poses, links),
            A=torch.where(rows[..., None], A, 0.0),
            b=torch.where(rows, b, 0.0),
            c=c,
            cd=cd,
            Q_C=dynamics.bias_force_of_motion(robot, poses, links, motion),
            Q_G=dynamics.gravity_force_of_poses(robot, poses, links),
            Q_D=dynamics.damping_force(robot, qd),
            contact_points={name: term.point for name, term in terms.items() if term.point is not None},
            poses=poses,
            motion=motion,
        )

    def _stack(self, q: Tensor, terms: list) -> tuple[Tensor, Tensor, Tensor]:
        """c, A, b of all contacts, concatenated over rows."""
        if not terms:
            empty = q.new_zeros(*q.shape[:-1], 0)
            return empty, q.new_zeros(*q.shape[:-1], 0, q.shape[-1]), empty
        return (
            torch.cat([t.c for t in terms], dim=-1),
            torch.cat([t.A for t in terms], dim=-2),
            torch.cat([t.b for t in terms], dim=-1),
        )
