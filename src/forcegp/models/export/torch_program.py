"""The posterior mean and covariance as a `torch.export` program."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from forcegp.destination import write_or_keep
from forcegp.files import written_folder
from forcegp.forces.quantities import FlatStates
from forcegp.models.prediction import Predictor, Query

OUTPUTS = ("qdd", "multiplier")


class _Posterior(torch.nn.Module):
    def __init__(self, fit: Predictor) -> None:
        super().__init__()
        self.fit = fit

    def forward(self, q: Tensor, qd: Tensor, tau: Tensor, active: Tensor) -> tuple[Tensor | None, ...]:
        flat, query = FlatStates(q, qd, tau, active, q.shape[:-1]), Query(OUTPUTS, None, True, False)
        return self.fit.at(flat, query)[0][:3]


@torch.no_grad()
def write_torch(fit: Predictor, path: Path, name: str) -> None:
    """Write the program that maps q, q̇, τ `(1, nq)` and closed contacts `(1, n_contacts)` to mean, covariance
    and distance beyond the training data; the program raises no errors."""
    system = fit.system
    state = [torch.zeros(1, system.robot.nq, dtype=system.robot.dtype) for _ in range(3)]
    closed = torch.ones(1, len(system.contacts), dtype=torch.bool)
    program = torch.export.export(_Posterior(fit), (*state, closed), strict=False)

    def write(folder: Path) -> None:
        with written_folder(folder) as temporary:
            torch.export.save(program, str(temporary / f"{name}.pt2"))

    write_or_keep(write, path)
