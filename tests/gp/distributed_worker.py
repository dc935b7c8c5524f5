"""What each process of the test of distributed sums does."""

from __future__ import annotations

from pathlib import Path

import torch
import torch.distributed as dist
from safetensors.torch import save_file

from forcegp.gp.basis import latent_basis
from forcegp.gp.features import rows_of
from forcegp.gp.sums import accumulate, reduce_sums, share_basis
from gp.sparse_cases import COMPONENTS, PROCESSES, first, parameters, rows

SAMPLES, POINTS = 61, 12


def run(rank: int, processes: int, folder: str) -> None:
    """Sum over this process's shard, from a basis that only the first process has right."""
    torch.set_num_threads(1)
    store = Path(folder) / "store"
    dist.init_process_group("gloo", init_method=store.as_uri(), rank=rank, world_size=processes)
    block = rows(SAMPLES)
    own = rows_of(block, torch.arange(SAMPLES).tensor_split(processes)[rank])
    wrong = {key: value + 0.1 * rank for key, value in parameters().items()}
    mine = latent_basis(PROCESSES, wrong, first(rows(POINTS, seed=5 + rank), POINTS), COMPONENTS)
    sums = reduce_sums(accumulate(share_basis(mine), [own]))
    kept = {f"sum.{i}": part.clone() for i, part in enumerate(sums.tensors)}
    save_file(kept, Path(folder) / f"{rank}.safetensors")
    dist.destroy_process_group()
