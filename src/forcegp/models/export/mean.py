"""The posterior mean of a fit in scalars, from which C code, Jacobians and a CasADi function are derived.

All terms that depend only on the state form a straight-line program: mechanics, contact points, and inputs
and features of the priors. Functions with support points are evaluated in loops. In the program, they are
inputs f with slopes ∂f/∂x. Consider a motion M q̈ = Q + (A + U)ᵀ λ, A q̈ = b, with friction U λ proportional
to the multiplier. It is differentiated implicitly. At fixed q̈ and λ, the equations change by dR and dg, and

    (I + LᵀU) dλ = (A M⁻¹ Aᵀ)⁻¹ dg − Lᵀ dR,   dq̈ = M⁻¹ (dR + (Aᵀ + U) dλ),

The mechanics in dR are closed-form derivatives of inverse dynamics. The contacts must be independent.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch

from forcegp.compiled.expression import Scalar, Tangents
from forcegp.compiled.mechanics import _forces, _point_blocks
from forcegp.compiled.program import (
    PARAMETERS,
    Links,
    Program,
    _inverse_dynamics_derivatives,
    _motion,
    _solve,
    cross,
    numbers,
)
from forcegp.constraints import SurfaceContact
from forcegp.constraints.gauss import FACING_DOWN
from forcegp.errors import ModelError
from forcegp.forces.external_wrench import ROWS, WrenchFrame
from forcegp.forces.priors import contact
from forcegp.forces.priors.base import ForcePrior
from forcegp.forces.priors.constants import DrivePrior
from forcegp.forces.priors.inertial import InertialPrior, PayloadPrior
from forcegp.forces.priors.joint import TERMS, JointForcePrior
from forcegp.forces.term import ONE, JointState, JointTerm
from forcegp.gp import kernels
from forcegp.gp.basis import KernelPart
from forcegp.gp.features import stacked
from forcegp.models.export.model import ExportedModel, Functions, row_of

DIFFERENTIATED = ("qdd", "multiplier", "contact_force", "joint_friction")
"""Quantities with a mean that has Jacobians and a CasADi form."""
ARGUMENTS = ("q", "qd", "tau", "closed")
REST = 1e-30
"""Squared sliding speed, or squared distance, below which the square root has slope zero."""


def _matern(square: Scalar, more: float) -> Scalar:
    """Return (1 + r + more r²) e^{−r}, with a root that is also differentiable at a support point."""
    r = (square + REST).sqrt()
    return (r + 1.0 + square * more) * (-r).exp()


PROFILES = {
    kernels.SquaredExponential: lambda square: (square * -0.5).exp(),
    kernels.Matern32: lambda square: _matern(square * 3.0, 0.0),
    kernels.Matern52: lambda square: _matern(square * 5.0, 1.0 / 3.0),
}
"""Stationary kernels as functions of the squared distance."""


Scalars = Any
"""A NumPy array of scalars."""


class Touching(NamedTuple):
    """A contact, with its fields in the order of `touching` in `controller.c`."""

    position: Scalars
    velocity: Scalars
    jacobian: Scalars
    normal: Scalars
    tangent: Scalars
    sliding: Scalars
    sliding_jacobian: Scalars
    turning: Scalars
    A: Scalars
    b: Scalars
    c: Scalars


class Mean:
    """The scalars that define the mean of an exported model.

    Attributes:
        M, Q_C, Q_G, Q_D: mass matrix, bias force, gravity force and damping force.
        touching: the contacts, each computed as if it were closed.
        A, b: constraint rows of the contacts, which are zero for open contacts.
        x: standardized inputs of each prior, `(1 or components, width)`.
        phi: features of each component of each prior.
        expected: the force that learned terms are expected to have, on which friction of contacts depends.
    """

    def __init__(self, model: ExportedModel, parts: Sequence[Functions]) -> None:
        self.model, self.parts, self.robot = model, parts, model.system.robot
        self.links = Links(self.robot)
        self.graph, n = self.links.graph, self.robot.nq
        self.q, self.qd, self.tau = (np.array(self.links.vector(x), dtype=object) for x in ARGUMENTS[:3])
        if self.robot.torque_scale is not None:
            self.tau = self.tau * np.array(self.robot.torque_scale.tolist())
        self.M, self.Q_C, self.Q_G = _forces(self.links)
        self.Q_D = self._damping(None)
        on = [x for x in model.system.contacts if isinstance(x, SurfaceContact)]
        self.names = [x.name for x in on]
        self.touching = [self._contact(x) for x in on]
        self.closed = np.array([self.graph.input("closed", i) for i in range(len(on))], dtype=object)
        rows = [at.A * closed for at, closed in zip(self.touching, self.closed, strict=True)]
        self.A = np.array(rows, dtype=object).reshape(len(on), n)
        self.b = np.array([at.b[0] for at in self.touching], dtype=object) * self.closed
        self.x = [self._inputs(p, None) for p in range(len(parts))]
        self.phi = [self._all_features(p, x) for p, x in enumerate(self.x)]
        self.expected = self._expected()

    def program(self, outputs: Iterable[Scalar], arguments: Sequence[str]) -> Program:
        """Return a program with the given outputs and arguments."""
        outputs = list(outputs)
        return Program(tuple(arguments), (len(outputs),), self.graph, outputs)

    def zeros(self, *shape: int) -> Scalars:
        """Return an array of zeros."""
        return self.graph.constants(np.zeros(shape))

    def sliding(self) -> tuple[list[int], list[Scalar]]:
        """Return the priors of joints that can stick, and Q_D, the inputs and the features for a `slip`."""
        slip = [self.graph.input("slip", i) for i in range(self.robot.nq)]
        priors = [p for p, part in enumerate(self.parts) if part.prior.sticks]
        x = [self._inputs(p, slip) for p in priors]
        outputs = [*self._damping(slip), *(each for rows in x for each in rows.flat)]
        for p, rows in zip(priors, x, strict=True):
            outputs += [each for phi in self._all_features(p, rows) for each in phi]
        return priors, outputs

    def wrench_jacobian(self, frame: WrenchFrame) -> Program:
        """Return a program that maps q to J for the components of a wrench (see `WrenchFrame.jacobian`)."""
        index, point = self.robot.frame_index(frame.frame), np.array(frame.point, dtype=float)
        rotation, _, J, _ = _point_blocks(self.links, self.robot, index, point)
        if frame.reference == "local":
            J = np.concatenate([rotation.T @ J[:3], rotation.T @ J[3:]])
        return self.program(J[[ROWS[axis] for axis in frame.axes]].flat, ARGUMENTS[:1])

    def _all_features(self, p: int, x: Scalars) -> list[list[Scalar]]:
        """Return the features φ of each component of a prior at its inputs."""
        part = self.parts[p]
        return [
            [] if part.finite is None else self._features(p, part.finite, k, x[k if len(x) > 1 else 0])
            for k in range(part.components)
        ]

    def _expected(self) -> Scalars:
        """Return Q̂ of an `ExpectedForce`."""
        force, errors = self.zeros(self.robot.nq), (part.prior for part in self.parts)
        error = next((prior for prior in errors if isinstance(prior, contact.CoulombErrorPrior)), None)
        for term, weights in () if error is None else error.expected.terms:
            raw = {**self._raw_inputs(term, None), ONE: self.zeros(self.robot.nq) + 1.0}
            for name, w in weights.items():
                driven = w * self.robot.driven if term.needs_drive else w
                force = force + np.array(raw[name], dtype=object) * np.array(driven.tolist())
        return force

    def _damping(self, slip: Sequence[Scalar] | None) -> Scalars:
        """Return viscous, Coulomb and Stribeck friction from the robot file; `slip` replaces tanh(q̇/v₀)."""
        names = ("damping", "friction", "friction_velocity", "stribeck", "stribeck_velocity")
        force, columns = [], (numbers(getattr(self.robot, x)) for x in names)
        for i, (v, d, c, v_c, s, v_s) in enumerate(zip(self.qd, *columns, strict=True)):
            fast = v / v_s if s else v * 0.0
            dry = (-(fast * fast)).exp() * s + c
            direction = (v / v_c).tanh() if slip is None else slip[i]
            if self.robot.drag is not None:
                b, cubic = self.robot.drag[i].tolist()
                d = abs(v) * b + v * v * cubic + d
            force.append(-(v * d) - (dry * direction if c or s else 0.0))
        return np.array(force, dtype=object)

    def _contact(self, contact: SurfaceContact) -> Touching:
        ((frame, point),), n = contact.anchors, self.robot.nq
        at = np.asarray([float(x) for x in point])
        _, center, J, bias = _point_blocks(self.links, self.robot, self.robot.frame_index(frame), at)
        twist = J @ self.qd
        c, normal, curvature = contact.center_surface.scalars(center, twist[3:])
        arm = normal * -float(contact.radius)
        jacobian = J[3:] + np.stack([cross(J[:3, j], arm) for j in range(n)], axis=1)
        velocity, A = twist[3:] + cross(twist[:3], arm), normal @ J[3:]
        rule = self.model.system.baumgarte
        omega, xi = (0.0, 0.0) if rule is None else (rule.natural_frequency, rule.damping_ratio)
        b = -(normal @ bias[3:] + curvature) - (A @ self.qd) * (2.0 * omega * xi) - c * omega**2
        return Touching(
            center + arm,
            velocity,
            jacobian,
            normal,
            self._tangents(normal),
            velocity - normal * (normal @ velocity),
            jacobian - np.outer(normal, normal @ jacobian),
            normal @ J[:3],
            A,
            np.array([b], dtype=object),
            np.array([c], dtype=object),
        )

    def _tangents(self, n: Scalars) -> Scalars:
        """Return R e_x and R e_y for the smallest rotation with R e_z = n, or a fixed frame if n is −e_z."""
        up = (n[2] + (1.0 - FACING_DOWN)).step()
        share = up / (n[2] * up + 1.0)
        x, y, both = 1.0 - n[0] * n[0] * share, up * 2.0 - 1.0 - n[1] * n[1] * share, -(n[0] * n[1] * share)
        return np.array([[x, both, -n[0]], [both, y, -n[1]]], dtype=object)

    def _inputs(self, p: int, slip: Sequence[Scalar] | None) -> Scalars:
        """Return the standardized inputs x, in a single row if all components share them."""
        part, scales = self.parts[p], self.model.posterior.process.scales[p]
        shared = all(x.ndim == 2 for x in part.support.values())
        rows: list[list[Scalar]] = []
        raw = self._raw_inputs(part.prior, slip)
        for k in range(1 if shared else part.components):
            row = []
            for name, columns in raw.items():
                used = columns if shared else [columns[k]]
                pair = ((x if shared else x[k]).tolist() for x in (scales.mean[name], scales.std[name]))
                row += [(x - m) / s for x, m, s in zip(used, *pair, strict=True)]
            rows.append(row)
        return np.array(rows, dtype=object)

    def _raw_inputs(self, prior: ForcePrior, slip: Sequence[Scalar] | None) -> dict[str, list[Scalar]]:
        """Return the inputs, keyed by name. Joint friction has one input per joint."""
        if isinstance(prior, contact.NormalForcePrior):
            return self._raw_inputs(prior.like, slip)
        if isinstance(prior, JointTerm):
            load = np.array([(x.step() * 2.0 - 1.0) * x for x in self.Q_G], dtype=object)
            direction = None if slip is None else np.array(slip, dtype=object)
            try:
                columns = prior.columns(JointState(self.q, self.qd, load, direction))
            except (AttributeError, TypeError) as cause:
                text = f"the columns of {prior.name!r} have no form in C and CasADi: {cause}"
                expected = "arithmetic, abs, integer powers and the functions of forcegp.forces.term"
                raise ModelError(text, expected=expected) from cause
            zero = self.graph.constant(0.0)
            acts = [driven or not prior.needs_drive for driven in self.robot.driven.tolist()]
            return {
                name: [x if y else zero for x, y in zip(column, acts, strict=True)]
                for name, column in columns.items()
            }
        if isinstance(prior, contact.SurfaceForcePrior):
            at = self.touching[self.names.index(prior.contact)]
            square = at.sliding @ at.sliding
            moving = (square - REST).step()
            speed = (square * moving + (1.0 - moving) * REST).sqrt()
            along = {"position": at.tangent @ at.position, "velocity": at.tangent @ at.velocity}
            return {name: list(along.get(name, [speed])) for name in prior.inputs}
        if not isinstance(prior, JointForcePrior):
            return {"one": [self.graph.constant(0.0)]}
        raw = {name: list(getattr(self, name)) for name in prior.inputs}
        if prior.periodic and "q" in raw:
            turns = [i for i, kind in enumerate(self.robot.joint_types) if kind == "revolute"]
            raw["q"] = [self.graph.input(turn, i) for turn in ("sin", "cos") for i in turns]
            raw["q"] += [x for i, x in enumerate(self.q) if i not in turns]
        return raw

    def _features(self, p: int, part: KernelPart, k: int, x: Scalars) -> list[Scalar]:
        """Return the features φ(x) of component k."""
        kernel, params = part.kernel, part.params
        if isinstance(kernel, kernels.Linear):
            columns = self.parts[p].columns(kernel.inputs)
            slopes = row_of(kernel.slope_std(params), k).expand(len(columns)).tolist()
            lines = [x[c] * s for c, s in zip(columns, slopes, strict=True)]
            if isinstance(kernel, kernels.Columns):
                return lines
            return [*lines, self.graph.constant(float(row_of(kernel.bias_std(params), k)))]
        if isinstance(kernel, kernels.Constant):
            return [self.graph.constant(float(row_of(kernel.std(params), k)))]
        assert isinstance(kernel, kernels.Sum)
        left, right = (self._features(p, KernelPart(*side), k, x) for side in kernel.parts(params))
        product = isinstance(kernel, kernels.Product)
        return [a * b for a in left for b in right] if product else left + right

    def _covariances(self, p: int, part: KernelPart, k: int) -> list[Scalar]:
        """Return k(x, z_j) of component k for all support points z_j of a prior."""
        kernel, params, support = part.kernel, part.params, self.parts[p].support
        if isinstance(kernel, kernels.Sum):
            left, right = (self._covariances(p, KernelPart(*side), k) for side in kernel.parts(params))
            product = isinstance(kernel, kernels.Product)
            return [a * b if product else a + b for a, b in zip(left, right, strict=True)]
        if isinstance(kernel, kernels.Constant):
            return [self.graph.constant(float(row_of(kernel.std(params), k).square()))] * self.parts[p].size
        assert isinstance(kernel, kernels.Linear | kernels.Stationary)
        z = stacked(support, kernel.inputs)
        inverse = isinstance(kernel, kernels.Stationary)
        scale = row_of(torch.exp(-params["log_lengthscale"]) if inverse else kernel.slope_std(params), k)
        row, columns = self.x[p][k if len(self.x[p]) > 1 else 0], self.parts[p].columns(kernel.inputs)
        x = row[columns] * np.array(scale.expand(len(columns)).tolist())
        Z = ((z if z.ndim == 2 else z[k]) * scale).numpy()
        if isinstance(kernel, kernels.Linear):
            bias = float(row_of(kernel.bias_std(params), k).square())
            return [(x * point).sum() + bias for point in Z]
        profile, variance = PROFILES[type(kernel)], float(row_of((2.0 * params["log_std"]).exp(), k))
        return [profile(((x - point) * (x - point)).sum()) * variance for point in Z]


class Motion(NamedTuple):
    """The motion q̈ and the multipliers λ under given impressed forces."""

    qdd: Scalars
    multiplier: Scalars


class LearnedMotion(Mean):
    """The mean of quantities, given the values (and slopes, for Jacobians) of functions with support points.

    Args:
        model, parts: the model, and the functions of its priors.
        differentiate: whether to compute derivatives with respect to q, q̇ and τ (directions 0 to 3 nq − 1).
    """

    def __init__(self, model: ExportedModel, parts: Sequence[Functions], differentiate: bool) -> None:
        super().__init__(model, parts)
        self.differentiate, n = differentiate, self.robot.nq
        self.seeds: dict[int, Tangents] = {}
        one, coulomb = self.graph.constant(1.0), model.posterior.process.coulomb
        for name, first in (("q", 0), ("qd", n), ("tau", 2 * n)):
            self.seeds |= {self.graph.input(name, i).position: {first + i: one} for i in range(n)}
        for i in range(n):
            sin, cos = (self.graph.input(turn, i) for turn in ("sin", "cos"))
            self.seeds[sin.position], self.seeds[cos.position] = {i: cos}, {i: -sin}
        self.U = self.zeros(n, len(self.names))
        for law in coulomb:
            c = self.names.index(law.contact)
            self.U[:, c] = self._against(c, float(law.smoothing)) * float(law.coefficient)

    def tangents(self, outputs: Iterable[Scalar]) -> Scalars:
        """Return the derivatives of scalars, with shape `(outputs, 3 nq)`."""
        tangents, zero = self.graph.tangents(list(outputs), self.seeds), self.graph.constant(0.0)
        directions = range(3 * self.robot.nq)
        return np.array([[t.get(d, zero) for d in directions] for t in tangents], dtype=object)

    def quantities(self) -> dict[str, Scalars]:
        """Return the posterior mean of each quantity in `DIFFERENTIATED`."""
        Q, Q_z, Q_F = self._forces_of_priors()
        motion = self._motion(Q + Q_z, self._mean_terms, self.U)
        normals = [at.normal * l for at, l in zip(self.touching, motion.multiplier, strict=True)]
        none = np.array([], dtype=object)
        return {
            "qdd": motion.qdd,
            "multiplier": motion.multiplier,
            "contact_force": np.concatenate([none, *normals]),
            "joint_friction": Q_F + self.Q_D,
        }

    @property
    def _mean_terms(self) -> tuple[str, ...]:
        return self.model.posterior.process.mean.terms  # pyright: ignore[reportFunctionMemberAccess]

    @cached_property
    def _inverses(self) -> tuple[Scalars, Scalars, Scalars]:
        """Return M⁻¹, S = (A M⁻¹ Aᵀ)⁻¹ with ones for open contacts, and L = M⁻¹ Aᵀ S."""
        M_inv, m = _solve(self.M, self.graph.constants(np.eye(self.robot.nq))), len(self.names)
        if not m:
            return M_inv, self.zeros(0, 0), self.zeros(self.robot.nq, 0)
        W, one = self.A @ M_inv @ self.A.T, self.graph.constant(1.0)
        for r in range(m):
            W[r, r] = W[r, r] + (one - self.closed[r])
        S = _solve(W, self.graph.constants(np.eye(m)))
        return M_inv, S, M_inv @ self.A.T @ S

    def _motion(
        self, rest: Scalars, terms: Sequence[str], U: Scalars | None = None, pulled: bool = True
    ) -> Motion:
        """Return the motion M q̈ = Q_C + Q_G + rest + (A + U)ᵀ λ, A q̈ = b, and its derivatives.

        Q_C acts if `"bias"` is in `terms`, and Q_G if `"gravity"` is. A q̈ = 0 unless `pulled`.
        """
        M_inv, S, L = self._inverses
        zero, m = self.zeros(self.robot.nq), len(self.names)
        known = (self.Q_C if "bias" in terms else zero) + (self.Q_G if "gravity" in terms else zero)
        K = self.A.T if U is None else self.A.T + U
        response = self.graph.constants(np.eye(m)) if U is None or not m else L.T @ U + np.eye(m)
        b = self.b if pulled else self.zeros(m)

        def solved(force: Scalars, gap: Scalars) -> Motion:
            # (I + LᵀU) λ = S gap − Lᵀ force, q̈ = M⁻¹ (force + K λ)
            if not m:
                return Motion(M_inv @ force, gap)
            multiplier = _eliminated(response, S @ gap - L.T @ force)
            return Motion(M_inv @ (force + K @ multiplier), multiplier)

        motion = solved(known + rest, b)
        if self.differentiate:
            qdd, multiplier = motion
            fixed = self.seeds | {x.position: {} for x in (*qdd, *multiplier) if x.value is None}
            outputs = [*(rest + _times(K, multiplier, zero)), *(b - _times(self.A, qdd, self.zeros(m)))]
            kept, self.seeds = self.seeds, fixed
            change = self.tangents(outputs)
            self.seeds, n = kept, self.robot.nq
            moving = list(self.qd) if "bias" in terms else None
            parts = _inverse_dynamics_derivatives(self.links, moving, list(qdd), "gravity" in terms)
            change[:n, : 2 * n] = change[:n, : 2 * n] - np.concatenate(parts, axis=1)
            rates = solved(change[:n], change[n:])
            for x, by in zip((*qdd, *multiplier), np.concatenate(rates), strict=True):
                self.seeds[x.position] = {d: t for d, t in enumerate(by) if t.value != 0.0}
        return motion

    def _forces_of_priors(self) -> tuple[Scalars, Scalars, Scalars]:
        """Return Q without Q_C and Q_G, the contact force Q_z, and the learned friction of the joints."""
        n, terms = self.robot.nq, self._mean_terms
        Q, Q_z, Q_F = self.zeros(n), self.zeros(n), self.zeros(n)
        Q = Q + (self.Q_D if "friction" in terms else Q) + (self.tau if "actuation" in terms else Q)
        first = slope = 0
        for p, part in enumerate(self.parts):
            f, prior = self._latent(p, first, slope), part.prior
            if part.size:
                first, slope = first + part.components, slope + part.components * self.x[p].shape[1]
            if isinstance(prior, InertialPrior):
                (columns, units), errors = part.inertial(self.robot), self.zeros((PARAMETERS + 1) * n)
                errors[columns] = f * np.array(units.tolist())
                links, drives = errors[: PARAMETERS * n].reshape(n, PARAMETERS), errors[PARAMETERS * n :]
                Q = Q - self._inertial_force(links, drives)
            elif isinstance(prior, DrivePrior):
                Q = Q + prior.std * (self.tau * f)
            elif isinstance(prior, PayloadPrior):
                links, units = self.zeros(n, PARAMETERS), prior.units(self.robot.mass).tolist()
                links[prior.link(self.robot), : len(units)] = f * np.array(units)
                Q = Q - self._inertial_force(links, self.zeros(0))
            elif isinstance(prior, contact.NormalForcePrior):
                # Aᵀ Lᵀ f: −Lᵀ f is the multiplier of M q̈ = f + Aᵀ λ, A q̈ = 0
                Q = Q - _times(self.A.T, self._motion(f, (), pulled=False).multiplier, self.zeros(n))
            elif isinstance(prior, contact.CoulombErrorPrior | contact.SurfaceForcePrior):
                Q_z = Q_z + self._contact_operator(prior) @ f
            else:
                assert isinstance(prior, JointForcePrior | JointTerm)
                Q = Q + f
                Q_F = Q_F + f if isinstance(prior, JointTerm) else Q_F
        return Q, Q_z, Q_F

    def _latent(self, p: int, first: int, slope: int) -> Scalars:
        """Return the latent force f of a prior. If derivatives are computed, the part with support points is
        an input that has slopes with respect to x."""
        part, forces = self.parts[p], []
        for k, phi in enumerate(self.phi[p]):
            weights = part.weights[k, part.size :].tolist()
            f = sum((x * w for x, w in zip(phi, weights, strict=True)), start=self.graph.constant(0.0))
            if part.rest is not None and part.size and not self.differentiate:
                covariances = self._covariances(p, part.rest, k)
                weights = part.weights[k, : part.size].tolist()
                f = sum((x * w for x, w in zip(covariances, weights, strict=True)), start=f)
            elif part.size:
                rest, x = self.graph.input("f", first + k), self.x[p][k if len(self.x[p]) > 1 else 0]
                by_x = [self.graph.input("slope", slope + k * len(x) + c) for c in range(len(x))]
                rates = np.array(by_x, dtype=object) @ self.tangents(x)
                self.seeds[rest.position] = {d: t for d, t in enumerate(rates) if t.value != 0.0}
                f = rest + f
            forces.append(f)
        return np.array(forces, dtype=object)

    def _against(self, c: int, smoothing: float) -> Scalars:
        """Return u = −J_Eᵀ s(v), the generalized force due to a unit friction force."""
        at = self.touching[c]
        return -(at.sliding_jacobian.T @ at.sliding) / (at.sliding @ at.sliding + smoothing**2).sqrt()

    def _contact_operator(self, prior: ForcePrior) -> Scalars:
        """Return the operator E of a contact force, `(nq, components)`; see `forces/priors/contact.py`."""
        assert isinstance(prior, contact.CoulombErrorPrior | contact.SurfaceForcePrior)
        c = self.names.index(prior.contact)
        at, closed = self.touching[c], self.closed[c]
        square = at.sliding @ at.sliding
        if isinstance(prior, contact.CoulombErrorPrior):
            law = next(x for x in prior.friction if x.contact == prior.contact)
            eps = float(law.smoothing)
            known = self.Q_D + self.tau + self.expected
            load = self._motion(known, TERMS, self.U).multiplier[c] * float(law.coefficient)
            E = self._against(c, eps) * (load * closed)
            return np.stack([E, E * (-(eps**2) / (square + eps**2))], axis=1)
        if not isinstance(prior, contact.SlidingFrictionPrior):
            return (at.tangent @ at.jacobian).T * closed
        u = self._against(c, prior.smoothing)
        columns = {"viscous": -(at.sliding_jacobian.T @ at.sliding), "dry": u}
        if set(prior.terms) & set(contact.LOADED):
            # The multiplier under the analytical forces, with friction μ̂ λ u at this contact
            U = self.zeros(*self.U.shape)
            U[:, c] = u * prior.friction_coefficient
            free = self._motion(self.Q_D + self.tau, TERMS, U).multiplier[c]
            load = free * free.step()
            rate = at.turning @ self.qd
            spin = (rate * rate + prior.torsion_smoothing**2).sqrt()
            columns["coulomb"] = u * load
            columns["stribeck"] = columns["coulomb"] * (-square / prior.stribeck_speed**2).exp()
            columns["torsion"] = at.turning * (-(load * rate) / spin)
        return np.stack([columns[term] * closed for term in prior.terms], axis=1)

    def _inertial_force(self, errors: Scalars, drives: Scalars) -> Scalars:
        """Return [Y(q, q̇, q̈), diag q̈] δ at the analytical q̈, for errors δ of links and drives."""
        links, qdd = self.links, self._motion(self.Q_D + self.tau, TERMS).qdd
        motion = _motion(links, list(self.qd), list(qdd), gravity=True)
        torques, forces = [], []
        for (omega, v, alpha, a), R, p, (m, *rest) in zip(motion, links.R, links.p, errors, strict=True):
            h = R @ np.array(rest[:3], dtype=object)
            xx, xy, xz, yy, yz, zz = rest[3:]
            inertia = R @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]], dtype=object) @ R.T
            origin = a + cross(alpha, p) + cross(omega, v + cross(omega, p))
            force = origin * m + cross(alpha, h) + cross(omega, cross(omega, h))
            torque = cross(h, origin) + inertia @ alpha + cross(omega, inertia @ omega)
            torques.append(torque + cross(p, force))
            forces.append(force)
        wrenches = zip(links.z, links.l, links.composite(torques), links.composite(forces), strict=True)
        force = np.array([z @ torque + l @ force for z, l, torque, force in wrenches], dtype=object)
        return force + drives * qdd if len(drives) else force


def _times(K: Scalars, x: Scalars, zero: Scalars) -> Scalars:
    """Return K x, or zero if x is empty."""
    return K @ x if len(x) else zero


def _eliminated(K: Scalars, rhs: Scalars) -> Scalars:
    """Return K⁻¹ rhs by elimination without pivoting."""
    K, x, n = K.copy(), rhs.copy(), len(rhs)
    for k in range(n):
        for i in range(k + 1, n):
            factor = K[i, k] / K[k, k]
            K[i, k:], x[i] = K[i, k:] - K[k, k:] * factor, x[i] - x[k] * factor
    for k in reversed(range(n)):
        for j in range(k + 1, n):
            x[k] = x[k] - x[j] * K[k, j]
        x[k] = x[k] / K[k, k]
    return x
