"""Optional packages: imported where they are installed, and one clear error where they are not."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import pytest

from forcegp.errors import MissingDependencyError, optional_module


def test_an_installed_module_is_returned() -> None:
    assert optional_module("math", "Arithmetic") is math


def test_a_missing_package_is_one_error_with_the_command_that_installs_it() -> None:
    with pytest.raises(MissingDependencyError) as caught:
        optional_module("no_such_package.reader", "Reading bags", "ros")
    assert str(caught.value).startswith("Reading bags needs the package 'no_such_package'")
    assert 'hint: pip install "forcegp[ros]"' in str(caught.value)
    assert isinstance(caught.value, ImportError)


def test_a_broken_package_is_not_reported_as_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "broken_package.py").write_text("import a_module_that_it_lacks\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(ModuleNotFoundError, match="a_module_that_it_lacks") as caught:
        optional_module("broken_package", "Anything")
    assert not isinstance(caught.value, MissingDependencyError)
    assert "broken_package" not in sys.modules
