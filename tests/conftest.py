"""With `FORCEGP_CHECKED=1` shapes and types of every call are checked; each test process uses one thread."""

from __future__ import annotations

import os
from collections.abc import Iterator

from jaxtyping import config, install_import_hook

# The hook sees modules that are imported after it, so it comes before any test imports the library.
if os.environ.get("FORCEGP_CHECKED") == "1":
    install_import_hook("forcegp", "typechecker.check")

import pytest
import torch

torch.set_num_threads(1)


@pytest.fixture
def unchecked() -> Iterator[None]:
    """No check of shapes, so that the library's own message on a wrong one is seen."""
    config.update("jaxtyping_disable", True)
    yield
    config.update("jaxtyping_disable", False)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with whole scripts, of which one takes minutes, so that no process waits for it at the end."""
    items.sort(key=lambda item: not item.nodeid.startswith("tests/test_examples_run.py"))
