"""Memory is said before it is taken, and refused where there is not enough."""

from __future__ import annotations

import warnings

import pytest

from forcegp import resources
from forcegp.errors import MemoryLimitError
from forcegp.resources import MemoryNeedWarning, announce_memory, free_memory


def test_free_memory_is_what_the_system_says() -> None:
    free = free_memory()
    assert free is None or 0 < free < 1 << 50


def test_half_of_the_free_memory_is_announced_and_more_than_all_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(resources, "free_memory", lambda: 10 << 30)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        announce_memory(5 << 30, "the covariance")
    with pytest.warns(MemoryNeedWarning, match=r"the covariance needs 6\.00 GiB of 10\.00 GiB"):
        announce_memory(6 << 30, "the covariance")
    with pytest.raises(MemoryLimitError, match=r"the covariance needs more(.|\n)*got: 11\.00 GiB"):
        announce_memory(11 << 30, "the covariance")


def test_the_limit_of_a_container_counts(monkeypatch: pytest.MonkeyPatch, tmp_path) -> None:
    (tmp_path / "memory.max").write_text("1000\n")
    (tmp_path / "memory.current").write_text("400\n")
    monkeypatch.setattr(resources, "_CGROUP", tmp_path)
    assert free_memory() == 600
    (tmp_path / "memory.max").write_text("max\n")
    assert free_memory() != 600
