"""Families of cases of which `make test` runs a few and `make test-slow` the rest."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import pytest


def slow_except(cases: Iterable[Any], *fast: str, name: Callable[[Any], str] = str) -> list[Any]:
    """Parameters of a test, marked slow but for the named ones."""
    cases = list(cases)
    unknown = set(fast) - {name(case) for case in cases}
    assert not unknown, f"no such cases: {unknown}"
    return [case if name(case) in fast else pytest.param(case, marks=pytest.mark.slow) for case in cases]
