"""A sentence that is computed from results."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Finding:
    """A reading of the numbers.

    Attributes:
        topic: in a few words.
        agrees: whether the paper's claim, or ours, is borne out; `None` where none is made.
        text: the reading, with its numbers.
    """

    topic: str
    agrees: bool | None
    text: str
