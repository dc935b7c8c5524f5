"""Two processes give the sums of one."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
import torch.multiprocessing
from safetensors.torch import load_file

from forcegp.errors import ModelError
from forcegp.gp.basis import latent_basis
from forcegp.gp.sums import accumulate, reduce_sums
from gp.distributed_worker import POINTS, SAMPLES, run
from gp.sparse_cases import COMPONENTS, PROCESSES, first, parameters, rows

ADDED = 1e-9
"""Relative: the same sums in another order."""


def test_two_processes_equal_one(tmp_path: Path) -> None:
    torch.multiprocessing.spawn(run, args=(2, str(tmp_path)), nprocs=2)
    block = rows(SAMPLES)
    basis = latent_basis(PROCESSES, parameters(), first(rows(POINTS, seed=5), POINTS), COMPONENTS)
    one = accumulate(basis, [block])
    for rank in range(2):
        got = load_file(tmp_path / f"{rank}.safetensors")
        for i, part in enumerate(one.tensors):
            scale = float(part.abs().max())
            assert float((got[f"sum.{i}"] - part).abs().max()) < ADDED * scale


def test_without_a_group_the_message_says_how_to_start() -> None:
    basis = latent_basis(PROCESSES, parameters(), first(rows(5), 5), COMPONENTS)
    with pytest.raises(ModelError, match="torchrun"):
        reduce_sums(accumulate(basis, [rows(5)]))
