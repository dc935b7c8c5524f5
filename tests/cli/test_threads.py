"""The program waits without spinning, so that it does not slow down others."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

SHOW = "import forcegp.__main__, os; print(os.environ['OMP_WAIT_POLICY'])"


@pytest.mark.parametrize(("given", "used"), [(None, "passive"), ("active", "active")])
def test_threads_of_the_program_sleep_unless_the_user_says_otherwise(given: str | None, used: str) -> None:
    environment = {key: value for key, value in os.environ.items() if key != "OMP_WAIT_POLICY"}
    environment |= {} if given is None else {"OMP_WAIT_POLICY": given}
    done = subprocess.run(
        [sys.executable, "-c", SHOW], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == used
