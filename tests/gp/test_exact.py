"""Exact inference that does not fit is refused before anything is allocated."""

from __future__ import annotations

import pytest
import torch

from forcegp import resources
from forcegp.errors import ModelError
from forcegp.gp import exact
from forcegp.gp.exact import exact_bytes, require_exact_fits
from forcegp.gp.features import Block
from forcegp.resources import MemoryNeedWarning


def wide(samples: int) -> Block:
    """Samples of seven rows that take no memory."""
    zero = torch.zeros(1, dtype=torch.float64)
    return Block(({"q": zero.expand(samples, 7)},), (zero.expand(samples, 7, 7),), zero.expand(samples, 7))


def test_size_grows_with_the_square_of_the_rows() -> None:
    small, large = exact_bytes([wide(1000)]), exact_bytes([wide(10_000)])
    assert small > 2 * 8 * 7000**2
    assert large == pytest.approx(100 * small, rel=1e-6)
    assert exact_bytes([wide(500), wide(500)]) < small
    assert exact_bytes([wide(1000)], learning=False) < small


def test_what_takes_most_of_the_memory_is_announced(monkeypatch: pytest.MonkeyPatch) -> None:
    needed = exact_bytes([wide(100)])
    for module in (resources, exact):
        monkeypatch.setattr(module, "free_memory", lambda: int(1.5 * needed))
    with pytest.warns(MemoryNeedWarning, match=r"exact inference on 100 samples \(700 rows\) needs"):
        require_exact_fits([wide(100)])


def test_a_long_log_is_refused_with_its_size_and_the_way_out() -> None:
    with pytest.raises(ModelError, match=r"1000000 samples \(7000000 rows\)[\s\S]*GiB[\s\S]*sparse"):
        require_exact_fits([wide(1_000_000)])
    require_exact_fits([wide(10)])
    needed = exact_bytes([wide(100)])
    require_exact_fits([wide(100)], available=needed)
    with pytest.raises(ModelError, match="does not fit"):
        require_exact_fits([wide(100)], available=needed - 1)
