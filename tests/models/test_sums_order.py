"""Sums that are read again keep the order of kernel inputs, which a file does not."""

from __future__ import annotations

from pathlib import Path

import forcegp
from forcegp.forces.problem import Totals, basis_of
from forcegp.models import structured_stream
from forcegp.storage.checkpoint import Checkpoint
from random_data import random_data, table_system


def test_inputs_are_in_the_order_of_the_prior(tmp_path: Path) -> None:
    model = forcegp.StructuredGP(table_system(), "analytical", inference="sparse")
    fit = model.fit(random_data(table_system(), 30, free=False), learn=[])
    basis = basis_of(fit.problem, fit.hyperparameters)
    tensors = structured_stream._tensors(basis, Totals.zero(fit.problem, basis))
    saved = Checkpoint(tmp_path / "sums", "key")
    saved.write(dict(reversed(list(tensors.items()))))
    read, _ = structured_stream._restored(basis, saved.read(tensors))
    assert [list(part.inducing) for part in read.parts] == [list(part.inducing) for part in basis.parts]
    assert len(basis.parts[0].inducing) > 1
