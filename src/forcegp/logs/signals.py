"""The quantities of a log in SI units and in the robot's joint order, on one clock."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass
class Signals:
    """Quantities of a log; each step of the import takes them and leaves them valid.

    Attributes:
        joint_names: the robot's joints.
        t: `(n,)` time [s].
        row: `(n,)` number of each row in the log.
        segment: `(n,)` number of the trajectory.
        vectors: `q`, `qd`, `qdd`, `tau` as far as they are logged, `(n, nq)` each; `wrench` `(n, 6)`.
        contact: name → `(n,)` bool.
    """

    joint_names: tuple[str, ...]
    t: Array
    row: NDArray[np.int64]
    segment: NDArray[np.int64]
    vectors: dict[str, Array]
    contact: dict[str, NDArray[np.bool_]] = field(default_factory=dict)

    def __len__(self) -> int:
        """Number of rows."""
        return len(self.t)

    def keep(self, mask: NDArray[np.bool_]) -> None:
        """Keep only some rows, one column after another, so that memory holds one copy."""
        if mask.all():
            return
        self.t, self.row, self.segment = self.t[mask], self.row[mask], self.segment[mask]
        self.change(lambda value: value[mask])
        self.contact = {name: value[mask] for name, value in self.contact.items()}

    def change(self, function: Callable[[Array], Array]) -> None:
        """Replace each vector in turn."""
        for name in list(self.vectors):
            self.vectors[name] = function(self.vectors.pop(name))

    def runs(self, *keys: NDArray[np.generic]) -> list[slice]:
        """Stretches of rows within one segment on which further keys do not change."""
        return runs(self.segment, *keys)


def runs(*keys: NDArray[np.generic]) -> list[slice]:
    """Stretches of rows on which none of the keys changes.

    >>> runs(np.array([0, 0, 1, 1]), np.array([True, True, True, False]))
    [slice(0, 2, None), slice(2, 3, None), slice(3, 4, None)]
    """
    n = len(keys[0])
    cut = np.zeros(max(n - 1, 0), dtype=bool)
    for key in keys:
        cut |= key[1:] != key[:-1]
    edges = [0, *(np.flatnonzero(cut) + 1).tolist(), n] if n else []
    return [slice(a, b) for a, b in itertools.pairwise(edges)]
