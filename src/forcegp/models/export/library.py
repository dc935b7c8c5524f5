"""A fitted model that predicts by its own C code, compiled by the machine's compiler and kept on disk."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.errors import ModelError, NumericalError, check_name
from forcegp.forces.noise import LOW
from forcegp.forces.quantities import ForceField, flat_states
from forcegp.models.export.model import ExportedModel
from forcegp.models.export.source import READ, c_source
from forcegp.models.prediction import Prediction, Predictor
from forcegp.native import load_library

NAME = "forcegp"
JAMMED, UNRESOLVED, NO_INERTIA = 2, 3, 4
"""What the C code returns other than 0."""
MESSAGES = {
    JAMMED: "friction of a contact would press harder than it opposes",
    UNRESOLVED: "double precision does not resolve a predicted variance",
    NO_INERTIA: "the mass matrix is not positive definite",
}


class CompiledFit(Predictor):
    """A fit whose predictions come from its C code: the numbers of `StructuredFit.predict`, in microseconds.

    Made by `StructuredFit.compiled`; `library` has the functions of the C header, named `forcegp_…`."""

    kind = "compiled"

    def __init__(self, model: ExportedModel) -> None:
        self.model, self.system = model, model.system
        header, source = c_source(model, NAME)
        self.library = load_library(source.replace(f'#include "{NAME}.h"\n', header), level="-O3")
        self._many = self.library.forcegp_predict_many
        self._many.argtypes = [ctypes.c_long, *[ctypes.c_void_p] * 4, ctypes.c_uint, ctypes.c_int]
        self._many.argtypes += [ctypes.c_void_p] * 3
        self._sizes = {name: self.library.forcegp_size(1 << bit) for bit, name in enumerate(READ)}
        self._known: dict[str | tuple[str, ...], _Rows] = {}

    def save(self, path: str | Path) -> None:
        """A compiled fit has no file of its own.

        Raises:
            ModelError: always.
        """
        raise ModelError("a compiled fit cannot be saved", hint="save the fit, or call fit.export(path)")

    def force_field(self) -> ForceField:
        """Posterior mean of Q̄ = Q + Q_z, `(n, nq)` at states, in PyTorch."""
        return self.model.posterior

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
        """Posterior mean and covariance of a quantity, as `StructuredFit.predict` gives them.

        Arguments and errors are those of that method. `quantity` may also be `"joint_friction"`, the friction
        of the joints, that of the robot file included [N m, N].

        Raises:
            ModelError: another `system` than that of the fit, or friction with which a contact jams.
        """
        if system is not None and system is not self.system:
            raise ModelError("a compiled fit predicts on its own system", hint="use the predict of the fit")
        read = self._read(quantity if isinstance(quantity, str) else tuple(quantity))
        nq = self.system.robot.nq
        if active is None and self._plain(q, qd, tau):
            arrays, batch = (q, qd, tau, None), q.shape[:-1]
        else:
            *given, batch = flat_states(self.system, q, qd, tau, active)
            arrays = tuple(x.contiguous() for x in given)
        mean, beyond = q.new_empty((*batch, read.size)), q.new_empty((*batch, nq))
        spread = q.new_empty((*batch, read.size, read.size)) if covariance else None
        pointers = [None if x is None else x.data_ptr() for x in (*arrays, mean, spread, beyond)]
        status = self._many(batch.numel(), *pointers[:4], read.bits, noise, *pointers[4:])
        if status:
            flat_states(self.system, q, qd, tau, active)  # says which state is not finite
            raise (ModelError if status == JAMMED else NumericalError)(MESSAGES[status])
        if read.order is not None:
            mean = mean[..., read.order]
            spread = None if spread is None else spread[..., read.order, :][..., read.order]
        joints = self.system.robot.joint_names
        return Prediction(mean, spread, read.parts, beyond if LOW in self.model.tensors else None, joints)

    def _plain(self, *states: Tensor) -> bool:
        """Whether states can be read where they are."""
        q, known = states[0], all(isinstance(x, Tensor) for x in states)
        kinds = {(x.shape, x.dtype, x.device.type, x.is_contiguous()) for x in states if known}
        return (
            known
            and kinds == {(q.shape, torch.float64, "cpu", True)}
            and q.shape[-1:] == (self.system.robot.nq,)
        )

    def _read(self, quantity: str | tuple[str, ...]) -> _Rows:
        """The rows of requested quantities, and their place in the C code."""
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


class _Rows(NamedTuple):
    """Bits and number of components of quantities, the slice of each, and their order if C has another."""

    bits: int
    size: int
    parts: dict[str, slice]
    order: list[int] | None
