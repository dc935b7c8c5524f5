"""Typed errors: what was expected, what was got, and what to change."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches
from typing import TypeVar

E = TypeVar("E", bound="ForceGPError")


class ForceGPError(Exception):
    """Base of every error that a user of the library can cause.

    Args:
        message: one sentence that says what is wrong and where (file, joint, row).
        expected: what would have been right.
        got: what was found instead.
        hint: what to change.
    """

    def __init__(
        self, message: str, *, expected: object = None, got: object = None, hint: str | None = None
    ) -> None:
        self.message, self.expected, self.got, self.hint = message, expected, got, hint
        parts = [message]
        parts += [f"expected: {expected}"] if expected is not None else []
        parts += [f"got: {got}"] if got is not None else []
        parts += [f"hint: {hint}"] if hint else []
        super().__init__("\n  ".join(parts))

    @classmethod
    def at(cls: type[E], place: str, cause: ForceGPError) -> E:
        """An error of this class that adds to another one where it arose (a file, a line)."""
        message = f"{place}: {cause.message}"
        return cls(message, expected=cause.expected, got=cause.got, hint=cause.hint)


class RobotFileError(ForceGPError, ValueError):
    """A robot file that cannot be read, or that describes no valid robot."""


class UnsupportedRobotError(RobotFileError):
    """A robot file that is valid but uses what this library does not model (the message names the joint)."""


class InertiaError(RobotFileError):
    """Inertial parameters that no rigid body can have (the message names the link and the reason)."""


class RobotFileWarning(UserWarning):
    """A robot file that is usable but doubtful; the same sentence is kept in `RobotModel.remarks`."""


class UnknownNameError(ForceGPError, LookupError):
    """A name (joint, frame, contact, quantity, model) that does not exist; lists the valid ones."""

    def __init__(self, kind: str, name: object, valid: Iterable[str]) -> None:
        names = list(valid)
        near = get_close_matches(str(name), names, n=1)
        super().__init__(
            f"unknown {kind} {name!r}",
            expected="one of " + ", ".join(names) if names else "none are defined",
            hint=f"did you mean {near[0]!r}?" if near else None,
        )


class ShapeError(ForceGPError, ValueError):
    """A tensor whose shape, dtype or device does not fit."""


class DataError(ForceGPError, ValueError):
    """A data set, or a data file, that cannot be used (the message names file, column and row)."""


class SceneError(ForceGPError, ValueError):
    """A scene file that is not valid (the message names file, line and key)."""


class MappingError(ForceGPError, ValueError):
    """A mapping of log columns that is not valid, or does not fit the log (names file, line and key)."""


class ModelError(ForceGPError, ValueError):
    """A model that is asked for what it cannot do, or a saved model that cannot be read."""


class NumericalError(ForceGPError, ArithmeticError):
    """A computation that has no trustworthy result (a matrix not positive definite, a diverging run)."""


class MissingDependencyError(ForceGPError, ImportError):
    """An optional package that the request needs and that is not installed."""
