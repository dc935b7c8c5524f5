"""How much memory the equations of motion of many states take, to be announced before they are computed."""

from __future__ import annotations

from forcegp.constraints.system import ConstrainedSystem
from forcegp.memory import announce_memory

SQUARE, LINEAR = 20, 60
"""Matrices over joints and constraint rows, and vectors over them, that the equations of one state hold at
their peak; measured, and rounded up."""
CERTAIN = 0.25
"""Part of the bound below which no measured work stays."""
ITEM = 8
"""Bytes of a float64."""


def state_bytes(system: ConstrainedSystem) -> int:
    """Upper bound on the memory that the equations of motion of one state take [bytes].

    Args:
        system: robot and contacts.

    Example:
        >>> import forcegp
        >>> state_bytes(forcegp.load_scene("kuka_plane").system())
        14080
    """
    width = system.robot.nq + system.m
    return ITEM * (SQUARE * width**2 + LINEAR * width)


def announce_states(system: ConstrainedSystem, states: int, copies: float, what: str) -> None:
    """Announce, or refuse, work on many states; see `announce_memory`.

    Args:
        system: robot and contacts.
        states: how many are worked on at once.
        copies: how many times the memory of the equations of motion a state takes at the peak.
        what: the work, as the subject of a sentence.

    Raises:
        MemoryLimitError: it certainly needs more than is free.
    """
    needed = int(copies * states * state_bytes(system))
    announce_memory(needed, what, certain=int(CERTAIN * needed))
