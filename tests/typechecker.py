"""The run-time type checker of the test suite."""

from __future__ import annotations

from beartype import BeartypeConf, beartype

check = beartype(conf=BeartypeConf(is_pep484_tower=True))
"""An `int` serves where a `float` is asked for, as in static checks."""
