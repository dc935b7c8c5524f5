"""Calls with arguments of the wrong kind, run without the type checks of the test suite.

Prints one line per call: its number and the class of what it raised, or `nothing`.
"""

from __future__ import annotations

import sys
import traceback

from forcegp.errors import ForceGPError


def outcomes(calls: dict[str, object]) -> None:
    """Run each call and print what it raised."""
    for name, call in calls.items():
        try:
            call()  # type: ignore[operator]
            print(name, "nothing")
        except ForceGPError as error:
            print(name, type(error).__name__, "|", str(error).replace("\n", " "))
        except Exception as error:
            traceback.print_exc(file=sys.stderr)
            print(name, "RAW", type(error).__name__, "|", str(error).replace("\n", " ")[:200])
