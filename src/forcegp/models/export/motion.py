"""C code for the motion of trajectories under a posterior mean, or under functions drawn from a posterior."""

from __future__ import annotations

import ctypes

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.errors import MissingDependencyError, ModelError, NumericalError
from forcegp.forces.posterior import ForceSamples
from forcegp.forces.quantities import ForceField
from forcegp.gp.features import FeatureMap
from forcegp.models.export.library import KINDS, MESSAGES
from forcegp.models.export.model import ExportedModel, Functions
from forcegp.models.export.source import NO_FRICTION, c_source
from forcegp.native import load_library

POINTER, LONG = ctypes.c_void_p, ctypes.c_long


class Waves(ctypes.Structure):
    """Random features of one prior, and their weights in each function sample (see `motion.c`)."""

    _fields_ = [("turn", POINTER), ("phase", POINTER), ("weights", POINTER), ("rows", LONG), ("n", LONG)]


class CompiledMotion:
    """A function for q̈ and λ of trajectories, with joints held by dry friction, as in `RolloutProblem`."""

    def __init__(self, model: ExportedModel, samples: ForceSamples | None) -> None:
        header, source = c_source(model, "forcegp", rollout=True)
        library = load_library(source.replace('#include "forcegp.h"\n', header), level="-O2")
        self._motions, self.system = library.forcegp_motions, model.system
        self._motions.argtypes = [POINTER] * 2 + [LONG] * 2 + [POINTER] * 5 + [ctypes.c_int] + [POINTER] * 5
        self._folded = self._waves = None
        self._samples, self._kept = 1, list[Tensor]()
        if samples is not None:
            self._samples = samples.count
            self._folded, self._waves = self._functions(model, samples)

    def _functions(self, model: ExportedModel, samples: ForceSamples) -> tuple[Tensor, ctypes.Array[Waves]]:
        """Return the weights of all function samples, one row each, and the waves for the basis residual."""
        parts = model.parts()
        assert samples.functions.folded is not None
        rows, waves = [], (Waves * len(parts))()
        for p, (part, drawn) in enumerate(zip(parts, samples.functions.folded, strict=True)):
            weights = torch.cat([drawn.on_kernel, drawn.on_features], dim=1)
            rows.append(weights.flatten(0, 1).mT)
            if drawn.missed is not None:
                waves[p] = self._missed(part, *drawn.missed)
        return torch.cat(rows, dim=1).contiguous(), waves

    def _missed(self, part: Functions, draw: FeatureMap, weights: Tensor) -> Waves:
        (term,) = draw.terms
        assert term.waves is not None
        inputs, omega, phase = term.waves
        turn = omega.new_zeros(len(omega), len(part.columns(None)), omega.shape[1])
        turn[:, part.columns(inputs)] = omega.mT
        arrays = turn, phase.contiguous(), (term.scale[..., None] * weights).permute(2, 0, 1).contiguous()
        self._kept += arrays
        return Waves(*(x.data_ptr() for x in arrays), len(turn), turn.shape[2])

    def __call__(
        self, q: Tensor, qd: Tensor, tau: Tensor, active: Tensor, h: Tensor, sticking: bool
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Return q̈ and λ, as specified by `rollout.inputs.CompiledMotion`."""
        n, m = len(q), len(self.system.contacts)
        folded = None if self._folded is None else self._folded.data_ptr()
        states = [x.expand_as(q).contiguous() for x in (q, qd, tau)] + [active.contiguous(), h.contiguous()]
        qdd, held = torch.empty_like(q), torch.empty_like(q, dtype=torch.bool)
        multiplier, c, cd = q.new_empty(3, n, m)
        pointers = [x.data_ptr() for x in (*states, qdd, multiplier, c, cd, held)]
        status = self._motions(
            folded, self._waves, n, n // self._samples, *pointers[:5], sticking, *pointers[5:]
        )
        if status == NO_FRICTION:
            raise NumericalError(
                "the dry friction of the joints cannot be computed",
                hint="a smaller step, or RolloutOptions(sticking=False)",
            )
        if status:
            raise KINDS.get(status, NumericalError)(MESSAGES[status])
        return qdd, multiplier, c, cd, held


def compiled_motion(
    model: ExportedModel, force: ForceField, trained: ConstrainedSystem
) -> CompiledMotion | None:
    """Return C code for the motion of a model, or `None` if a part or a function sample has no C form."""
    system, samples = model.system, force if isinstance(force, ForceSamples) else None
    if system.contact_names != trained.contact_names or system.robot.learned:
        return None
    if system.robot.dtype != torch.float64 or (samples is not None and not _folds(samples)):
        return None
    try:
        model.check()
        return CompiledMotion(model, samples)
    except (ModelError, MissingDependencyError):
        return None


def _folds(samples: ForceSamples) -> bool:
    """Return whether all functions are weighted sums of basis functions and waves."""
    folded = samples.functions.folded
    return folded is not None and all(
        x.missed is None
        or (all(term.waves is not None for term in x.missed[0].terms) and len(x.missed[0].terms) == 1)
        for x in folded
    )
