"""Whether exact inference fits into memory, before anything is allocated."""

from __future__ import annotations

from collections.abc import Sequence

from forcegp.errors import ModelError
from forcegp.gp.structured_covariance import Block
from forcegp.memory import announce_memory, free_memory

MATRICES_TO_LEARN = 3.0
"""Square matrices of all rows that learning holds at once: the covariance, its factor and a copy."""

MATRICES_TO_CONDITION = 2.0
"""Those that conditioning holds: the covariance and its factor."""

SHARE = 0.8
"""Fraction of the free memory that exact inference may take."""


def exact_bytes(blocks: Sequence[Block], learning: bool = True) -> int:
    """Bytes of memory that exact inference on whitened rows takes at its peak.

    Args:
        blocks: whitened rows.
        learning: whether hyperparameters are learned, or the rows conditioned on only.
    """
    rows = sum(block.rows for block in blocks)
    components = sum(W.shape[-1] for W in blocks[0].operators) if blocks else 0
    samples = [len(block.target) for block in blocks]
    kernels = max((n * n for n in samples), default=0) * components
    item = blocks[0].target.element_size() if blocks else 8
    return int(item * ((MATRICES_TO_LEARN if learning else MATRICES_TO_CONDITION) * rows**2 + kernels))


def require_exact_fits(blocks: Sequence[Block], learning: bool = True, available: int | None = None) -> None:
    """Refuse exact inference that would not fit into memory, and announce what takes most of it.

    Args:
        blocks: whitened rows.
        learning: whether hyperparameters are learned.
        available: bytes that may be taken; by default `SHARE` of what is free.

    Raises:
        ModelError: it takes more.
    """
    free = free_memory()
    allowed = (None if free is None else int(SHARE * free)) if available is None else available
    needed = exact_bytes(blocks, learning)
    rows = sum(block.rows for block in blocks)
    samples = sum(len(block.target) for block in blocks)
    if allowed is not None and needed > allowed:
        raise ModelError(
            f"exact inference on {samples} samples ({rows} rows) does not fit into memory",
            expected=f"at most {allowed / 2**30:.1f} GiB",
            got=f"{needed / 2**30:.1f} GiB",
            hint='use inference="sparse", or fewer samples',
        )
    announce_memory(needed, f"exact inference on {samples} samples ({rows} rows)")
