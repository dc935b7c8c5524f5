"""The command line `forcegp`: each command is a thin function that calls the library."""

from forcegp.cli.app import app, main

__all__ = ["app", "main"]
