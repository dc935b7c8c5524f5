"""Typed errors that give the expected value, the actual value, and a remedy."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from difflib import get_close_matches
from importlib import import_module
from itertools import islice
from typing import Any, TypeVar

from forcegp.limits import NAME_COMPARED, NAMES_COMPARED

LONGEST_VALUE = 2000
"""Maximum number of characters of an invalid value that a message contains."""

E = TypeVar("E", bound="ForceGPError")


class ForceGPError(Exception):
    """Base class of all errors that a user of the library can cause.

    Args:
        message: one sentence that states the fault and its location (file, joint, row).
        expected: the valid value.
        got: the value found.
        hint: what to change.
    """

    def __init__(
        self, message: str, *, expected: object = None, got: object = None, hint: str | None = None
    ) -> None:
        self.message, self.expected, self.got, self.hint = message, expected, got, hint
        parts = [message]
        parts += [f"expected: {expected}"] if expected is not None else []
        parts += [f"got: {_shortened(str(got), LONGEST_VALUE)}"] if got is not None else []
        parts += [f"hint: {hint}"] if hint else []
        super().__init__("\n  ".join(parts))

    @classmethod
    def at(cls: type[E], place: str, cause: ForceGPError) -> E:
        """Convert an error to this class, adding its location (such as a file or a line) to the message."""
        message = f"{place}: {cause.message}"
        error = cls.__new__(cls)
        ForceGPError.__init__(error, message, expected=cause.expected, got=cause.got, hint=cause.hint)
        return error

    @classmethod
    @contextmanager
    def within(cls, place: str) -> Iterator[None]:
        """Re-raise this library's errors in the block as errors of this class that name the location."""
        try:
            yield
        except ForceGPError as cause:
            raise cls.at(place, cause) from cause

    def __reduce__(self) -> tuple[Any, ...]:
        """Reduce the error to text and plain values so that it can be copied or sent to another process."""
        state = {name: _plain(value) for name, value in self.__dict__.items()}
        return _rebuilt, (type(self), tuple(map(_plain, self.args)), state)


def _plain(value: object) -> object:
    """Return a plain value unchanged, and any other value as text, so that every process can unpickle it."""
    return value if isinstance(value, str | int | float | None) else str(value)


def _rebuilt(kind: type[E], args: tuple[object, ...], state: dict[str, object]) -> E:
    """Rebuild an error from `ForceGPError.__reduce__` without calling its constructor again."""
    error = kind.__new__(kind, *args)
    error.args = args
    error.__dict__.update(state)
    return error


def near_names(name: object, valid: Iterable[str], cutoff: float = 0.6) -> list[str]:
    """Return the valid name closest to a misspelt one, if any; the number of compared names is limited."""
    text = str(name)
    if len(text) > NAME_COMPARED:
        return []
    compared = (other for other in islice(valid, NAMES_COMPARED) if len(other) <= NAME_COMPARED)
    return get_close_matches(text, list(compared), n=1, cutoff=cutoff)


def did_you_mean(name: object, valid: Iterable[str], cutoff: float = 0.6) -> str | None:
    """Return a hint that suggests the valid name closest to a misspelt one, if there is one."""
    near = near_names(name, valid, cutoff)
    return f"did you mean {near[0]!r}?" if near else None


class RobotFileError(ForceGPError, ValueError):
    """Raised if a robot file cannot be read or does not describe a valid robot."""


class UnsupportedRobotError(RobotFileError):
    """Raised if a valid robot file contains unsupported elements; the message names the joint."""


class InertiaError(RobotFileError):
    """Raised if inertial parameters are physically impossible; the message names the link and the reason."""


class RobotFileWarning(UserWarning):
    """Issued if a robot file is usable but questionable; `RobotModel.remarks` also contains the message."""


class ConvergenceWarning(UserWarning):
    """Issued if a search ends at its maximum number of steps, so that its result may not be optimal."""


class UnknownNameError(ForceGPError, LookupError):
    """Raised if a name (of a joint, frame, model, …) does not exist; the message lists the valid names."""

    def __init__(self, kind: str, name: object, valid: Iterable[str], hint: str | None = None) -> None:
        names = list(valid)
        more = f" and {len(names) - NAMES_COMPARED} more" if len(names) > NAMES_COMPARED else ""
        listed = ", ".join(names[:NAMES_COMPARED])
        super().__init__(
            f"unknown {kind} {_shortened(repr(name), NAME_COMPARED)}",
            expected=f"one of {listed}{more}" if names else "none are defined",
            hint="; or ".join(text for text in (hint, did_you_mean(name, names)) if text) or None,
        )


def check_name(kind: str, name: object, valid: Collection[str]) -> None:
    """Raise `UnknownNameError` unless a name is one of the valid names."""
    if name not in valid:
        raise UnknownNameError(kind, name, valid)


class ParameterError(ForceGPError, ValueError):
    """Raised if a parameter (for example, a radius) is out of range; the message names the parameter."""


def _shortened(text: str, length: int) -> str:
    return text if len(text) <= length else text[:length] + "…"


class ShapeError(ForceGPError, ValueError):
    """Raised if a tensor has the wrong shape, dtype or device."""


class DataError(ForceGPError, ValueError):
    """Raised if a data set or a data file cannot be used; the message names the file, column and row."""


class SceneError(ForceGPError, ValueError):
    """Raised if a scene file is invalid; the message names the file, line and key."""


class MappingError(ForceGPError, ValueError):
    """Raised if a column mapping is invalid or does not match the log; the message names the key."""


class ModelError(ForceGPError, ValueError):
    """Raised if a model does not support the request, or if a saved model cannot be read."""


class NumericalError(ForceGPError, ArithmeticError):
    """Raised if a computation has no reliable result, for example because a matrix is indefinite."""


class MassMatrixError(NumericalError):
    """Raised if a mass matrix is not positive definite, for example because of negative masses."""

    def __init__(self, cause: Exception) -> None:
        text, hint = "a mass matrix is not positive definite", "check the robot's masses and inertias"
        super().__init__(text, got=str(cause)[:200], hint=hint)


class MissingDependencyError(ForceGPError, ImportError):
    """Raised if a required optional package is not installed."""


class DestinationError(ForceGPError, OSError):
    """Raised if a path cannot be written; the message gives the location of any results that were kept."""


class MemoryLimitError(ForceGPError, RuntimeError):
    """Raised instead of starting a computation that needs more than the free memory."""


def optional_module(name: str, purpose: str, extra: str | None = None) -> Any:
    """Import an optional package.

    Args:
        name: the module to import.
        purpose: the subject of the error message, such as `"Reading MJCF files"`.
        extra: the optional extra of this library that installs the package; defaults to the package name.

    Returns:
        The module.

    Raises:
        MissingDependencyError: the package is not installed; the hint gives the command that installs it.

    Example:
        >>> optional_module("math", "Arithmetic").sqrt(4.0)
        2.0
    """
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        package = name.partition(".")[0]
        # If an installed package lacks one of its own dependencies, that is a different error.
        if error.name is None or error.name.partition(".")[0] != package:
            raise
        raise MissingDependencyError(
            f"{purpose} needs the package {package!r}",
            expected=f"{package} to be installed",
            got=str(error),
            hint=f'pip install "forcegp[{extra or package}]"',
        ) from error
