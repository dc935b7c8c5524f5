"""The command-line interface `forcegp`, in which each command is a thin wrapper around the library."""

from forcegp.cli.app import app, main

__all__ = ["app", "main"]
