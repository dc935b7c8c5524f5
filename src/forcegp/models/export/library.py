"""A fitted model that predicts with exported C code, which is compiled locally and cached on disk."""

from __future__ import annotations

import copy
import ctypes
import dataclasses
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.errors import ForceGPError, ModelError, NumericalError, ShapeError, check_name
from forcegp.forces.posterior import LOW
from forcegp.forces.quantities import FlatStates, ForceField, ForceLinearization, flat_states, hidden_forces
from forcegp.forces.unknowns import AXES
from forcegp.models.export.mean import DIFFERENTIATED
from forcegp.models.export.model import ExportedModel
from forcegp.models.export.source import READ, c_source
from forcegp.models.external_wrench import ExternalWrench, parts_of_contacts, surface_contacts
from forcegp.models.prediction import Prediction, Predictor, in_pieces
from forcegp.native import load_library

NAME = "forcegp"
NOT_FINITE, JAMMED, UNRESOLVED, NO_INERTIA, NO_JACOBIAN, AT_REST, NO_NOISE, OVERFLOW = 1, 2, 3, 4, 5, 6, 7, 9
UNDETERMINED = 11
"""Nonzero status codes that the C code returns."""
MESSAGES = {
    JAMMED: "the friction coefficient of a contact is so large that the contact jams",
    UNRESOLVED: "the precision of the C code does not resolve a predicted variance",
    OVERFLOW: "a predicted number is not finite: implausible states cause overflow",
    NO_INERTIA: "the mass matrix is not positive definite",
    NO_JACOBIAN: "closed contacts hold the robot in the same direction, so that a Jacobian is not determined",
    NOT_FINITE: "a measured value is not finite, or its noise is not positive",
    NO_NOISE: "an update needs the noise of a quantity that the fit did not measure: pass noise_std",
}
KINDS: dict[int, type[ForceGPError]] = {JAMMED: ModelError, NO_NOISE: ModelError, NOT_FINITE: ShapeError}
POINTER = ctypes.c_void_p
FUNCTIONS = {
    "predict_learned": [ctypes.c_long, *[POINTER] * 4, ctypes.c_uint, ctypes.c_int, *[POINTER] * 3],
    "begin": [],
    "update": [*[POINTER] * 4, ctypes.c_uint, POINTER, POINTER],
    "forget": [ctypes.c_double, ctypes.c_int],
    "drift": [ctypes.c_int, ctypes.c_double],
}
"""Arguments after the pointer to the online state. All functions but the first require online learning."""


class CompiledFit(Predictor):
    """A fit that evaluates `StructuredFit.predict` in C within microseconds.

    It is created by `StructuredFit.compiled`. `library` has the functions of the C header, `forcegp_…`."""

    kind = "compiled"

    def __init__(self, model: ExportedModel) -> None:
        self.model, self.system = model, model.system
        header, source = c_source(model, NAME)
        self.library = load_library(source.replace(f'#include "{NAME}.h"\n', header), level="-O3")
        for name in FUNCTIONS if model.online else list(FUNCTIONS)[:1]:
            getattr(self.library, f"forcegp_{name}").argtypes = [POINTER, *FUNCTIONS[name]]
        self._many = self.library.forcegp_predict_learned
        if model.jacobians:
            arguments = [ctypes.c_long, *[POINTER] * 4, ctypes.c_uint, *[POINTER] * 2]
            self.library.forcegp_jacobian_many.argtypes = arguments
        if model.wrench is not None:
            self.library.forcegp_external_wrench.argtypes = [POINTER, ctypes.c_long, *[POINTER] * 10]
        if model.reads_contacts:
            self.library.forcegp_contact_force.argtypes = [POINTER, ctypes.c_long, *[POINTER] * 9]
        self._learned: Tensor | None = None
        self._memory: int | None = None
        self._sizes = {name: self.library.forcegp_size(1 << bit) for bit, name in enumerate(READ)}
        self._known: dict[str | tuple[str, ...], _Rows] = {}

    def save(self, path: str | Path) -> None:
        """Raise an error, since the fit itself must be saved instead.

        Raises:
            ModelError: always.
        """
        raise ModelError("a compiled fit cannot be saved", hint="save the fit, or call fit.export(path)")

    def force_field(self) -> ForceField:
        """Return the posterior mean of Q̄ = Q + Q_z as a force field in PyTorch."""
        if self._learned is not None:
            raise ModelError(
                "samples added in C are not part of the force field in PyTorch", hint="update the fit"
            )
        return self.model.posterior

    def update(
        self,
        q: Tensor,
        qd: Tensor,
        tau: Tensor,
        measured: Tensor,
        quantity: str = "qdd",
        *,
        active: Tensor | None = None,
        noise_std: Tensor | None = None,
    ) -> CompiledFit:
        """Add samples one after the other, with the same result as `StructuredFit.update`.

        Args:
            q, qd, tau: states, `(*batch, nq)`.
            measured: measured values at these states, `(*batch, d)`.
            quantity: the measured quantity.
            active: mask `(*batch, n_contacts)` of closed contacts. By default, all contacts are closed.
            noise_std: standard deviation of the noise `(d,)`. The default is that of the fit.

        Raises:
            ModelError: the model cannot learn in C, or the noise of the quantity is unknown.
            ShapeError: an argument has the wrong shape for the system, or is not finite.
            UnknownNameError: the quantity does not exist.
        """
        read = self._read(quantity)
        flat = flat_states(self.system, q, qd, tau, active)
        expected, got = (*flat.batch, read.size), tuple(measured.shape)
        if expected != got:
            raise ShapeError(
                f"values of {quantity!r} do not match the states", expected=str(expected), got=got
            )
        std = None if noise_std is None else noise_std.expand(read.size).double().contiguous()
        noise, newer = None if std is None else std.data_ptr(), self._copy()
        columns = [x.contiguous() for x in (*flat[:4], measured.double().reshape(-1, read.size))]
        for row in zip(*columns, strict=True):
            *state, value = (x.data_ptr() for x in row)
            status = self.library.forcegp_update(newer._memory, *state, read.bits, value, noise)
            if status not in (0, AT_REST):
                raise KINDS.get(status, NumericalError)(MESSAGES[status])
        return newer

    def forget(
        self, factor: float, priors: Sequence[str] | None = None, *, budget: int = 2**30
    ) -> CompiledFit:
        """Reduce the weight of all previous samples, as in `StructuredFit.forget`.

        Args:
            factor: factor on the weight of all previous samples. If `priors` is given, it is the correlation
                of their forces with the previous forces.
            priors: names of priors whose forces drift towards the prior. Samples then keep their weight.
            budget: number of weights for which the prior is renewed, each at the cost of one row. The others
                are renewed in later calls. By default, all are renewed.

        Raises:
            ModelError: the model cannot learn in C, or the factor is out of range.
            UnknownNameError: a prior does not exist.
        """
        newer, names = self._copy(), [prior.name for prior in self.model.posterior.priors]
        for name in priors or ():
            check_name("force prior to forget", name, names)
        if priors is None:
            status = self.library.forcegp_forget(newer._memory, factor, budget)
        else:
            drift = self.library.forcegp_drift
            status = max((drift(newer._memory, names.index(name), factor) for name in priors), default=0)
        if status:
            raise ModelError("invalid forgetting factor", expected="above 0, at most 1", got=factor)
        return newer

    def _copy(self) -> CompiledFit:
        """Return a copy of the fit with its own online state."""
        newer, learned = copy.copy(self), self._begun if self._learned is None else self._learned
        newer._learned = learned.clone()
        newer._memory = newer._learned.data_ptr()
        return newer

    @cached_property
    def _begun(self) -> Tensor:
        """Return the initial online state, with the values of a `forcegp_learned`."""
        if not self.model.online:
            raise ModelError(
                "this fit cannot learn online in C",
                expected="sparse inference with all functions, without state noise or delay, and online=True",
                hint="call the `update` method of the fit",
            )
        parts = self.model.parts()
        n, folded = parts[0].rank, sum(part.weights.numel() for part in parts)
        contacts = max(len(self.system.contacts), 1)
        begun = torch.empty(2 * n + folded + n * (n + 1) // 2 + contacts + 1, dtype=torch.float64)
        self.library.forcegp_begin(begun.data_ptr())
        return begun

    def predict(
        self,
        q: Tensor,
        qd: Tensor,
        tau: Tensor,
        quantity: str | Sequence[str] = "qdd",
        *,
        active: Tensor | None = None,
        covariance: bool = True,
        system: ConstrainedSystem | None = None,
        noise: bool = False,
    ) -> Prediction:
        """Return the posterior mean and covariance of a quantity, as in `StructuredFit.predict`.

        The arguments and errors are those of that method.

        Raises:
            ModelError: `system` is not the system of the fit, or friction jams a contact.
        """
        if system is not None and system is not self.system:
            raise ModelError(
                "a compiled fit predicts on its own system", hint="use the `predict` method of the fit"
            )
        read = self._read(quantity if isinstance(quantity, str) else tuple(quantity))
        nq, (arrays, batch) = self.system.robot.nq, self._states(q, qd, tau, active)
        mean, beyond = self._new(*batch, read.size), self._new(*batch, nq)
        spread = self._new(*batch, read.size, read.size) if covariance else None
        pointers = [None if x is None else x.data_ptr() for x in (*arrays, mean, spread, beyond)]
        status = self._many(self._memory, batch.numel(), *pointers[:4], read.bits, noise, *pointers[4:])
        if status not in (0, UNDETERMINED):
            raise self._error(status, q, qd, tau, active)
        if read.order is not None:
            mean = mean[..., read.order]
            spread = None if spread is None else spread[..., read.order, :][..., read.order]
        joints = self.system.robot.joint_names
        far = beyond if LOW in self.model.tensors else None
        result = Prediction(mean, spread, read.parts, far, joints, checked=True)
        return self._doubted(result, flat_states(self.system, q, qd, tau, active)) if status else result

    def _doubted(self, prediction: Prediction, flat: FlatStates) -> Prediction:
        """Return a prediction with descriptions of its undetermined components."""
        names, doubts = self.system.contact_names, dict[str, None]()
        closed = self._learned[-1 - len(names) : -1] if self._learned is not None else torch.zeros(len(names))
        never = [name for name, count in zip(names, closed, strict=True) if count == 0.0]
        never = [name for name in never if name in self.model.never_closed]

        def read(piece: FlatStates) -> tuple[Tensor | None, ...]:
            at = piece.with_equations(self.system)
            hidden = hidden_forces(self.system, at, prediction.parts, never)
            doubts.update(dict.fromkeys(() if hidden is None else hidden.doubts))
            return ()

        in_pieces(flat, read)
        known = ~prediction.mean.isnan()
        return dataclasses.replace(prediction, determined=known, doubts=tuple(doubts), checked=True)

    def jacobian(
        self,
        q: Tensor,
        qd: Tensor,
        tau: Tensor,
        quantity: str | Sequence[str] = "qdd",
        *,
        active: Tensor | None = None,
    ) -> MeanJacobian:
        """Return the posterior mean of quantities and its Jacobian with respect to q, q̇ and τ.

        Args:
            q, qd, tau: states, `(*batch, nq)`.
            quantity: `"qdd"`, `"multiplier"`, `"contact_force"` or `"joint_friction"`, or several of them.
            active: mask `(*batch, n_contacts)` of closed contacts. By default, all contacts are closed.

        Raises:
            UnknownNameError: the quantity does not exist.
            ModelError: the fit was compiled without Jacobians or updated in C, or friction jams a contact.
            NumericalError: the closed contacts are not independent.
        """
        if not self.model.jacobians:
            raise ModelError(
                "this fit was compiled without Jacobians",
                expected="fit.compiled(jacobians=True)",
                got="fit.compiled(jacobians=False)",
            )
        if self._learned is not None:
            raise ModelError(
                "samples added in C do not change the Jacobian", hint="update the fit, and compile it again"
            )
        names = [quantity] if isinstance(quantity, str) else list(quantity)
        for name in names:
            check_name("quantity with a Jacobian", name, DIFFERENTIATED)
        read, nq = self._read(tuple(names)), self.system.robot.nq
        arrays, batch = self._states(q, qd, tau, active)
        mean, slopes = self._new(*batch, read.size), self._new(*batch, read.size, 3, nq)
        pointers = [None if x is None else x.data_ptr() for x in (*arrays, mean, slopes)]
        status = self.library.forcegp_jacobian_many(batch.numel(), *pointers[:4], read.bits, *pointers[4:])
        if status:
            raise self._error(status, q, qd, tau, active)
        if read.order is not None:
            mean, slopes = mean[..., read.order], slopes[..., read.order, :, :]
        return MeanJacobian(mean, slopes[..., 0, :], slopes[..., 1, :], slopes[..., 2, :], read.parts)

    def external_wrench(
        self,
        q: Tensor,
        qd: Tensor,
        tau: Tensor,
        qdd: Tensor,
        *,
        active: Tensor | None = None,
        qdd_std: Tensor | None = None,
    ) -> ExternalWrench:
        """Estimate, separately for each state, the external wrench on the frame of `compiled(wrench=...)`.

        The result is that of `StructuredFit.external_wrench` for samples in any order. Friction with memory
        requires a log in time order and is not tracked.

        Args:
            q, qd, tau, qdd: states with measured accelerations, `(*batch, nq)`.
            active: mask `(*batch, n_contacts)` of closed contacts. By default, all contacts are closed.
            qdd_std: standard deviation of the acceleration noise `(nq,)`. The default is that of the fit.

        Raises:
            ModelError: the fit was compiled without a wrench, or friction jams a contact.
            ShapeError: an argument has the wrong shape for the system, or is not finite.
        """
        mean, covariance, beyond, _ = self._wrench((q, qd, tau, qdd), active, qdd_std, False)
        frame, joints = self.model.wrench, self.system.robot.joint_names
        assert frame is not None
        parts = {"external_wrench": slice(0, len(frame.axes))}
        far = beyond if LOW in self.model.tensors else None
        return ExternalWrench(mean, covariance, parts, far, joints, frame, checked=True)

    def wrench_jacobian(
        self,
        q: Tensor,
        qd: Tensor,
        tau: Tensor,
        qdd: Tensor,
        *,
        active: Tensor | None = None,
        qdd_std: Tensor | None = None,
    ) -> WrenchJacobian:
        """Return the mean of `external_wrench`, and its Jacobian from fourth-order finite differences.

        The arguments and errors are those of `external_wrench`.
        """
        mean, _, _, slopes = self._wrench((q, qd, tau, qdd), active, qdd_std, True)
        return WrenchJacobian(mean, *slopes.unbind(-2))

    def contact_force(
        self,
        q: Tensor,
        qd: Tensor,
        tau: Tensor,
        qdd: Tensor,
        *,
        active: Tensor | None = None,
        qdd_std: Tensor | None = None,
    ) -> Prediction:
        """Estimate, separately for each state, the forces of all contacts in world axes [N].

        The result is that of `StructuredFit.contact_force` for samples in any order. Friction with memory
        requires a log in time order and is not tracked.

        Args:
            q, qd, tau, qdd: states with measured accelerations, `(*batch, nq)`.
            active: mask `(*batch, n_contacts)` of closed contacts. By default, all contacts are closed.
            qdd_std: standard deviation of the acceleration noise `(nq,)`. The default is that of the fit.

        Returns:
            The mean `(*batch, 3 c)` and covariance `(*batch, 3 c, 3 c)` of c contacts, zero for open
            contacts. With several contacts, `parts` has the slice of each.

        Raises:
            ModelError: the system has no contact, or friction jams a contact.
            ShapeError: an argument has the wrong shape for the system, or is not finite.
        """
        names = surface_contacts(self.system, None)
        arrays, batch = self._measured((q, qd, tau, qdd), active, qdd_std, AXES * len(names))
        mean, covariance, beyond = self._filled("contact_force", arrays, batch)
        far = beyond if LOW in self.model.tensors else None
        parts, joints = parts_of_contacts(names), self.system.robot.joint_names
        return Prediction(mean, covariance, parts, far, joints, checked=True)

    def _measured(
        self, state: Sequence[Tensor], active: Tensor | None, qdd_std: Tensor | None, k: int
    ) -> tuple[tuple[Any, ...], torch.Size]:
        """Return the arrays for an estimate of k unknowns from accelerations, and the batch shape.

        The last three arrays are the outputs: mean, covariance and distance beyond the training data.
        """
        q, qd, tau, qdd = state
        nq, flat = self.system.robot.nq, flat_states(self.system, q, qd, tau, active)
        self.system.robot.check_state(qdd=qdd)
        if not bool(torch.isfinite(qdd).all()):
            raise ShapeError("qdd contains values that are not finite", expected="finite numbers")
        rows = qdd.expand(*flat.batch, nq).reshape(-1, nq)
        std = None if qdd_std is None else qdd_std.to(q).expand(nq).contiguous()
        inputs = [x.contiguous() for x in (flat.q, flat.qd, flat.tau, rows, flat.active)]
        outputs = (q.new_empty(*flat.batch, *shape) for shape in ((k,), (k, k), (nq,)))
        return (*inputs, std, *outputs), flat.batch

    def _filled(
        self, name: str, arrays: tuple[Any, ...], batch: torch.Size, more: tuple[Tensor | None, ...] = ()
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Call a function of the library on the arrays of `_measured`, and return the three outputs."""
        pointers = [None if x is None else x.data_ptr() for x in (*arrays, *more)]
        status = getattr(self.library, f"forcegp_{name}")(self._memory, batch.numel(), *pointers)
        if status:
            raise KINDS.get(status, NumericalError)(MESSAGES[status])
        return arrays[-3:]

    def _wrench(
        self, state: Sequence[Tensor], active: Tensor | None, qdd_std: Tensor | None, differentiate: bool
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return mean, covariance, distance beyond the training data, and slopes `(*batch, k, 4, nq)`."""
        if self.model.wrench is None:
            raise ModelError(
                "this fit was compiled without an external wrench",
                hint='fit.compiled(wrench=forcegp.WrenchFrame("tool"))',
            )
        k, q = len(self.model.wrench.axes), state[0]
        arrays, batch = self._measured(state, active, qdd_std, k)
        slopes = q.new_empty((*batch, k, 4, q.shape[-1]) if differentiate else (0, k, 4, q.shape[-1]))
        more = (slopes if differentiate else None,)
        mean, covariance, beyond = self._filled("external_wrench", arrays, batch, more)
        return mean, covariance, beyond, slopes

    def linearize(
        self,
        q: Tensor,
        qd: Tensor,
        tau: Tensor,
        *,
        active: Tensor | None = None,
        system: ConstrainedSystem | None = None,
    ) -> ForceLinearization:
        """Return the mean acceleration and multiplier with their Jacobians (see `StructuredFit`)."""
        if system is not None and system is not self.system:
            raise ModelError("a compiled fit predicts on its own system", hint="use the method of the fit")
        prediction = self.jacobian(q, qd, tau, ["qdd", "multiplier"], active=active)
        fields: list[Tensor] = []
        for at in prediction.parts.values():
            fields += [prediction.mean[..., at], *(x[..., at, :] for x in prediction[1:4])]
        return ForceLinearization(*fields)

    def _states(
        self, q: Tensor, qd: Tensor, tau: Tensor, active: Tensor | None
    ) -> tuple[tuple[Tensor | None, ...], torch.Size]:
        """Return the arrays of states for the C code, and the batch shape."""
        if active is None and self._plain(q, qd, tau):
            return (q, qd, tau, None), q.shape[:-1]
        flat = flat_states(self.system, q, qd, tau, active)
        arrays = *(x.to(self.model.dtype) for x in flat[:3]), flat.active
        return tuple(x.contiguous() for x in arrays), flat.batch

    def _new(self, *shape: int) -> Tensor:
        """Return a new array with the precision of the C code."""
        return torch.empty(shape, dtype=self.model.dtype)

    def _error(self, status: int, q: Tensor, qd: Tensor, tau: Tensor, active: Tensor | None) -> ForceGPError:
        """Return the error that the C code reported, or raise an error that names a non-finite state."""
        flat_states(self.system, q, qd, tau, active)
        return KINDS.get(status, NumericalError)(MESSAGES[status])

    def _plain(self, *states: Tensor) -> bool:
        """Return whether the C code can read the states without copying them."""
        q, known = states[0], all(isinstance(x, Tensor) for x in states)
        kinds = {(x.shape, x.dtype, x.device.type, x.is_contiguous()) for x in states if known}
        return (
            known
            and kinds == {(q.shape, torch.float64, "cpu", True)}
            and self.model.dtype == torch.float64
            and q.shape[-1:] == (self.system.robot.nq,)
        )

    def _read(self, quantity: str | tuple[str, ...]) -> _Rows:
        """Return the rows of the requested quantities, and their order in the C code."""
        if quantity in self._known:
            return self._known[quantity]
        names = [quantity] if isinstance(quantity, str) else list(dict.fromkeys(quantity))
        if not names:
            raise ModelError("no quantity is named", expected="one of " + ", ".join(READ))
        for name in names:
            check_name("quantity", name, READ)
        parts, starts, order = {}, {}, []
        for name in sorted(names, key=READ.index):
            starts[name] = sum(self._sizes[other] for other in starts)
        for name in names:
            parts[name] = slice(len(order), len(order) + self._sizes[name])
            order += range(starts[name], starts[name] + self._sizes[name])
        bits, as_is = sum(1 << READ.index(name) for name in names), order == list(range(len(order)))
        self._known[quantity] = _Rows(bits, len(order), parts, None if as_is else order)
        return self._known[quantity]


class MeanJacobian(NamedTuple):
    """The mean of quantities and its Jacobian, with one row per component.

    Attributes:
        mean: the mean `(*batch, d)`.
        dq, dqd, dtau: derivatives with respect to q, q̇ and τ, `(*batch, d, nq)`.
        parts: the slice of each quantity.
    """

    mean: Tensor
    dq: Tensor
    dqd: Tensor
    dtau: Tensor
    parts: dict[str, slice]


class WrenchJacobian(NamedTuple):
    """The mean of an external wrench and its Jacobian, with one row per component.

    Attributes:
        mean: the mean `(*batch, k)`.
        dq, dqd, dtau, dqdd: derivatives with respect to q, q̇, τ and q̈, `(*batch, k, nq)`.
    """

    mean: Tensor
    dq: Tensor
    dqd: Tensor
    dtau: Tensor
    dqdd: Tensor


class _Rows(NamedTuple):
    """Bits, number of components and slices of quantities, and their order if it differs from that in C."""

    bits: int
    size: int
    parts: dict[str, slice]
    order: list[int] | None
