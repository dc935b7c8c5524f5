"""Sums over shards of a log with `torch.distributed`: gloo between processes, NCCL between GPUs.

Each process holds its own samples; the inducing points and hyperparameters must be those of all.

    torchrun --nproc-per-node 2 script.py        # script.py starts with dist.init_process_group("gloo")
"""

from __future__ import annotations

import dataclasses

import torch
import torch.distributed as dist
from torch import Tensor

from forcegp.errors import ModelError
from forcegp.gp.basis import LatentBasis
from forcegp.gp.factor import Spectrum
from forcegp.gp.features import Features
from forcegp.gp.kernels import Parameters
from forcegp.gp.sums import Sums


def shard(samples: int, rank: int, processes: int) -> slice:
    """The samples of one process: equal runs of neighbouring ones, to within one.

    Example:
        >>> [shard(7, rank, 3) for rank in range(3)]
        [slice(0, 3, None), slice(3, 5, None), slice(5, 7, None)]

    Raises:
        ModelError: there is no such process.
    """
    if not 0 <= rank < processes:
        raise ModelError("no such process", expected=f"a rank from 0 to {processes - 1}", got=rank)
    size, more = divmod(samples, processes)
    first = rank * size + min(rank, more)
    return slice(first, first + size + (rank < more))


def reduce_sums(sums: Sums) -> Sums:
    """The sums of all processes added, the same in each of them.

    All must use the basis of `share_basis`: eigenvectors are defined up to sign and rotation.

    Raises:
        ModelError: no group of processes has been initialised.
    """
    flat = add_over_processes(torch.cat([part.reshape(-1) for part in sums.tensors]))
    pieces = flat.split([part.numel() for part in sums.tensors])
    return Sums(*(new.reshape(old.shape) for new, old in zip(pieces, sums.tensors, strict=True)))


def add_over_processes(x: Tensor) -> Tensor:
    """The tensors of all processes added, the same in each of them."""
    _require_processes()
    total = x.detach().clone()
    dist.all_reduce(total, op=dist.ReduceOp.SUM)
    return total


def share_basis(basis: LatentBasis) -> LatentBasis:
    """The basis of the first process in all of them, which must hold one of the same shapes.

    Raises:
        ModelError: no group of processes has been initialised.
    """
    _require_processes()
    dropped = [s.dropped for part in basis.parts for s in part.spectra]
    counts = iter(_broadcast(torch.tensor(dropped)).tolist())
    parts = []
    for part in basis.parts:
        spectra = tuple(
            Spectrum(_broadcast(s.values), _broadcast(s.vectors), next(counts)) for s in part.spectra
        )
        params, Z = _shared(part.params), _shared(part.inducing)
        parts.append(dataclasses.replace(part, params=params, inducing=Z, spectra=spectra))
    return LatentBasis(basis.processes, _shared(basis.params), tuple(parts))


def _shared(tensors: Parameters | Features) -> dict[str, Tensor]:
    return {key: _broadcast(tensors[key]) for key in sorted(tensors)}


def _broadcast(x: Tensor) -> Tensor:
    copy = x.detach().clone(memory_format=torch.contiguous_format)
    dist.broadcast(copy, src=0)
    return copy


def _require_processes() -> None:
    if not (dist.is_available() and dist.is_initialized()):
        raise ModelError(
            "no group of processes has been initialised",
            hint='start with torchrun, and call torch.distributed.init_process_group("gloo") first',
        )
