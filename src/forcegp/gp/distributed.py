"""Sums over shards of a log with `torch.distributed`: gloo between processes, NCCL between GPUs.

Each process holds its own samples; the inducing points and hyperparameters must be those of all.

    torchrun --nproc-per-node 2 script.py        # script.py starts with dist.init_process_group("gloo")
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import torch
import torch.distributed as dist
from torch import Tensor

from forcegp.errors import ModelError
from forcegp.gp.basis import LatentBasis
from forcegp.gp.features import Block, Features
from forcegp.gp.kernels import Parameters
from forcegp.gp.sums import CHUNK_SAMPLES, Sums, accumulate

Group = dist.ProcessGroup | None
"""The processes that take part; all of them where it is `None`."""


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


def reduce_sums(sums: Sums, group: Group = None) -> Sums:
    """The sums of all processes added, the same in each of them."""
    flat = add_over_processes(torch.cat([part.reshape(-1) for part in sums.tensors]), group)
    pieces = flat.split([part.numel() for part in sums.tensors])
    return Sums(*(new.reshape(old.shape) for new, old in zip(pieces, sums.tensors, strict=True)))


def add_over_processes(x: Tensor, group: Group = None) -> Tensor:
    """The tensors of all processes added, the same in each of them."""
    _require_processes()
    total = x.detach().clone()
    dist.all_reduce(total, op=dist.ReduceOp.SUM, group=group)
    return total


def accumulate_shards(
    basis: LatentBasis, blocks: Iterable[Block], chunk: int = CHUNK_SAMPLES, group: Group = None
) -> Sums:
    """Sum over the samples of all processes, each of which gives its own.

    The basis must be that of `share_basis`, or computed by each process on equal hardware: eigenvectors
    are defined up to sign and rotation.

    Args:
        basis: basis functions.
        blocks: whitened rows of this process.
        chunk: samples whose basis functions are held at a time.
        group: the processes that take part.

    Raises:
        ModelError: no group of processes has been initialised.
    """
    return reduce_sums(accumulate(basis, blocks, chunk), group)


def share_basis(basis: LatentBasis, source: int = 0, group: Group = None) -> LatentBasis:
    """The basis of one process in all of them, which must hold one of the same shapes.

    Args:
        basis: with the same processes and number of inducing points in every process.
        source: whose hyperparameters, inducing points and eigenvectors are taken.
        group: the processes that take part.

    Raises:
        ModelError: no group of processes has been initialised.
    """
    _require_processes()
    dropped = [s.dropped for part in basis.parts for s in part.spectra]
    counts = iter(_broadcast(torch.tensor(dropped), source, group).tolist())
    parts = []
    for part in basis.parts:
        spectra = tuple(
            dataclasses.replace(
                s,
                values=_broadcast(s.values, source, group),
                vectors=_broadcast(s.vectors, source, group),
                dropped=next(counts),
            )
            for s in part.spectra
        )
        params, Z = (share_tensors(named, source, group) for named in (part.params, part.inducing))
        parts.append(dataclasses.replace(part, params=params, inducing=Z, spectra=spectra))
    return LatentBasis(basis.processes, share_tensors(basis.params, source, group), tuple(parts))


def share_tensors(tensors: Parameters | Features, source: int = 0, group: Group = None) -> dict[str, Tensor]:
    """Named tensors of one process in all of them, which must hold some of the same shapes."""
    _require_processes()
    return {key: _broadcast(tensors[key], source, group) for key in sorted(tensors)}


def _broadcast(x: Tensor, source: int, group: Group) -> Tensor:
    copy = x.detach().clone(memory_format=torch.contiguous_format)
    dist.broadcast(copy, src=source, group=group)
    return copy


def _require_processes() -> None:
    if not (dist.is_available() and dist.is_initialized()):
        raise ModelError(
            "no group of processes has been initialised",
            hint='start with torchrun, and call torch.distributed.init_process_group("gloo") first',
        )
