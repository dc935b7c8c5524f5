"""Whether exact inference fits into memory, before anything is allocated."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from forcegp.errors import ModelError
from forcegp.gp.structured_covariance import Block

MATRICES_TO_LEARN = 3.0
"""Square matrices of all rows that learning holds at once: the covariance, its factor and a copy."""

MATRICES_TO_CONDITION = 2.0
"""Those that conditioning holds: the covariance and its factor."""

SHARE = 0.8
"""Fraction of the free memory that exact inference may take."""

CGROUP = Path("/sys/fs/cgroup")
"""Where Linux says how much memory a container may use."""


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


def available_bytes() -> int:
    """Memory that the process may still take: what the system has free, within a container's limit."""
    free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    information = Path("/proc/meminfo")
    if information.is_file():
        lines = dict(line.split(":", 1) for line in information.read_text().splitlines())
        free = int(lines["MemAvailable"].split()[0]) * 1024
    limit, used = (_number(CGROUP / name) for name in ("memory.max", "memory.current"))
    return free if limit is None or used is None else min(free, max(limit - used, 0))


def _number(path: Path) -> int | None:
    text = path.read_text().strip() if path.is_file() else ""
    return int(text) if text.isdigit() else None


def require_exact_fits(blocks: Sequence[Block], learning: bool = True, available: int | None = None) -> None:
    """Refuse exact inference that would not fit into memory.

    Args:
        blocks: whitened rows.
        learning: whether hyperparameters are learned.
        available: bytes that may be taken; by default `SHARE` of what is free.

    Raises:
        ModelError: it takes more.
    """
    allowed = int(SHARE * available_bytes()) if available is None else available
    needed = exact_bytes(blocks, learning)
    if needed > allowed:
        rows = sum(block.rows for block in blocks)
        samples = sum(len(block.target) for block in blocks)
        raise ModelError(
            f"exact inference on {samples} samples ({rows} rows) does not fit into memory",
            expected=f"at most {allowed / 2**30:.1f} GiB",
            got=f"{needed / 2**30:.1f} GiB",
            hint='use inference="sparse", or fewer samples',
        )
