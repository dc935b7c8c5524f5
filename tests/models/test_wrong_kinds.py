"""Arguments of the wrong kind end in typed errors; models reach other processes through their saved form."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

CALLS = 20


@pytest.fixture(scope="module")
def lines() -> list[str]:
    """What the script prints: it runs without the type checks of the test suite, as users do."""
    script = Path(__file__).with_name("wrong_kinds.py")
    paths = os.pathsep.join([str(script.parents[1]), *sys.path])
    done = subprocess.run(
        [sys.executable, str(script)],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "PYTHONPATH": paths},
    )
    return done.stdout.splitlines()


def test_every_wrong_argument_is_a_typed_error(lines: list[str]) -> None:
    calls = [line for line in lines if " | " in line]
    assert len(calls) == CALLS
    assert [line for line in lines if " RAW " in line or line.endswith(" nothing")] == []
    found = {line.split(" ")[0]: line for line in calls}
    assert "unknown quantity 5" in found["quantity=5"]
    assert "NumericalError" in found["qd=1e300"]
    assert "call torch.tensor(q" in found["q=list"]


def test_copies_of_a_fit_predict_the_same_bits(lines: list[str]) -> None:
    copies = ("pickle", "fit of a pickled model", "deepcopy", "save and load")
    assert lines[CALLS:] == [f"{name} same" for name in copies]
