"""Optional packages: imported on first use, with an error that names the extra to install."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from forcegp.errors import MissingDependencyError


def optional_module(name: str, purpose: str, extra: str | None = None) -> Any:
    """An optional package.

    Args:
        name: the module to import.
        purpose: what needs it, the subject of the message, such as `"Reading MJCF files"`.
        extra: the extra of this library that installs it; default its own name.

    Returns:
        The module.

    Raises:
        MissingDependencyError: the package is not installed; the hint is the command that installs it.

    Example:
        >>> optional_module("math", "Arithmetic").sqrt(4.0)
        2.0
    """
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        package = name.partition(".")[0]
        # A package that is installed but lacks something itself is broken, which is another error.
        if error.name is None or error.name.partition(".")[0] != package:
            raise
        raise MissingDependencyError(
            f"{purpose} needs the package {package!r}",
            expected=f"{package} to be installed",
            got=str(error),
            hint=f'pip install "forcegp[{extra or package}]"',
        ) from error
