"""A fitted model that predicts by its own C code, compiled by the machine's compiler and kept on disk."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from pathlib import Path

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

    Made by `StructuredFit.compiled`.

    Attributes:
        model: what the code contains.
        system: robot and contacts.
        library: the functions of the C header, with the prefix `forcegp_`.
    """

    kind = "compiled"

    def __init__(self, model: ExportedModel) -> None:
        self.model, self.system = model, model.system
        header, source = c_source(model, NAME)
        self.library = load_library(source.replace(f'#include "{NAME}.h"\n', header), level="-O3")
        self._many = self.library.forcegp_predict_many
        self._many.argtypes = [ctypes.c_long, *[ctypes.c_void_p] * 4, ctypes.c_uint, ctypes.c_int]
        self._many.argtypes += [ctypes.c_void_p] * 3
        self._sizes = [self.library.forcegp_size(1 << bit) for bit in range(len(READ))]

    def save(self, path: str | Path) -> None:
        """A compiled fit has no file of its own.

        Raises:
            ModelError: always.
        """
        raise ModelError(
            "a compiled fit cannot be saved", hint="save the fit, or export it: fit.export(path)"
        )

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

        Args:
            q, qd, tau: `(*batch, nq)` states.
            quantity: a name of `QUANTITIES`, or several for their joint distribution; or `"joint_friction"`,
                the friction of the joints, that of the robot file included [N m, N].
            active: `(*batch, n_contacts)` bool, which contacts are closed; default all.
            covariance: whether to compute the covariance.
            system: the system of the fit; the code has no other.
            noise: whether the covariance is that of a measurement, noise of torque and sensor included.

        Raises:
            UnknownNameError: no such quantity.
            ShapeError: a state or `active` does not fit the system, or is not finite.
            ModelError: another system, or friction with which a contact jams.
            NumericalError: a variance is rounding.
        """
        if system is not None and system is not self.system:
            raise ModelError("a compiled fit predicts on its own system", hint="use the predict of the fit")
        names = [quantity] if isinstance(quantity, str) else list(quantity)
        if not names:
            raise ModelError("no quantity is named", expected="one of " + ", ".join(READ))
        for name in names:
            check_name("quantity", name, READ)
        flat = flat_states(self.system, q, qd, tau, active)
        bits = sorted({READ.index(name) for name in names})
        n, d, nq = len(flat.q), sum(self._sizes[bit] for bit in bits), self.system.robot.nq
        mean, beyond = torch.empty(n, d, dtype=torch.float64), torch.empty(n, nq, dtype=torch.float64)
        spread = torch.empty(n, d, d, dtype=torch.float64) if covariance else None
        arrays = [x.detach().contiguous() for x in (flat.q, flat.qd, flat.tau, flat.active)]
        pointers = [x.data_ptr() for x in arrays]
        out = (mean.data_ptr(), None if spread is None else spread.data_ptr(), beyond.data_ptr())
        status = self._many(n, *pointers, sum(1 << bit for bit in bits), int(noise), *out)
        if status:
            raise (ModelError if status == JAMMED else NumericalError)(MESSAGES[status])
        parts, order = self._parts(names, bits)
        if order != list(range(d)):
            mean = mean[:, order]
            spread = None if spread is None else spread[:, order][:, :, order]
        return Prediction(
            mean.reshape(*flat.batch, d),
            None if spread is None else spread.reshape(*flat.batch, d, d),
            parts,
            beyond.reshape(*flat.batch, nq) if LOW in self.model.tensors else None,
            self.system.robot.joint_names,
        )

    def _parts(self, names: Sequence[str], bits: Sequence[int]) -> tuple[dict[str, slice], list[int]]:
        """The rows of each quantity as they are asked for, and where the C code puts them."""
        starts, first = {}, 0
        for bit in bits:
            starts[READ[bit]], first = first, first + self._sizes[bit]
        parts, order = {}, []
        for name in dict.fromkeys(names):
            size = self._sizes[READ.index(name)]
            parts[name] = slice(len(order), len(order) + size)
            order += range(starts[name], starts[name] + size)
        return parts, order
