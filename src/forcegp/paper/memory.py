"""Largest memory that a piece of work takes."""

from __future__ import annotations

from pathlib import Path

STATUS = Path("/proc/self/status")
CLEAR = Path("/proc/self/clear_refs")
RESET_PEAK = "5"
"""What the kernel takes as the request to forget the peak so far (man 5 proc)."""


def reset_peak() -> bool:
    """Forget the process's peak memory; false where the system cannot."""
    try:
        CLEAR.write_text(RESET_PEAK)
    except OSError:
        return False
    return True


def peak_memory() -> int | None:
    """Peak resident memory of the process since the last reset [byte], `None` where it is not known."""
    try:
        lines = STATUS.read_text().splitlines()
    except OSError:
        return None
    sizes = [line.split()[1] for line in lines if line.startswith("VmHWM:")]
    return int(sizes[0]) * 1024 if sizes else None
