"""Readers that are optional: what to install where one is missing."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType

from forcegp.errors import MissingDependencyError


def require(module: str, package: str, purpose: str) -> ModuleType:
    """Import an optional package.

    Args:
        module: what to import.
        package: what to install.
        purpose: the format that needs it.

    Raises:
        MissingDependencyError: it is not installed; the hint has the command.
    """
    try:
        return import_module(module)
    except ImportError as cause:
        raise MissingDependencyError(
            f"reading {purpose} needs the package {package!r}",
            got=str(cause),
            hint="pip install 'forcegp[import]'",
        ) from cause
