"""Every reader ends in a result or a typed error: on all kept inputs, and on some that Hypothesis makes.

`make attack` tries 20,000 inputs per reader, guided by coverage.
"""

from __future__ import annotations

import random
import sys
import time
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

ROOT = Path(__file__).resolve().parents[2] / "fuzz"
sys.path.insert(0, str(ROOT))

from mutate import mutated  # noqa: E402
from targets import CORPORA, TARGETS, run_one, seeds  # noqa: E402

SLOW = 5.0
"""Seconds per input, on a busy machine."""
READERS = sorted(path.name for path in CORPORA.iterdir() if path.is_dir())


def test_every_target_has_a_corpus() -> None:
    assert set(READERS) == set(TARGETS)


@pytest.mark.parametrize("reader", READERS)
def test_kept_inputs_are_answered(reader: str) -> None:
    pytest.importorskip("h5py" if reader == "log-hdf5" else "numpy")
    answers = []
    for data in seeds(reader):
        start = time.perf_counter()
        answers.append(run_one(reader, data))
        assert time.perf_counter() - start < 4.0 * SLOW, "imports included"
    assert "read" in answers, "a valid file is read, or the mutations would test nothing"


@pytest.mark.parametrize("reader", READERS)
@settings(max_examples=25, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
@given(number=st.integers(0, 2**32), junk=st.binary(max_size=60))
def test_changed_inputs_are_answered(reader: str, number: int, junk: bytes) -> None:
    start = time.perf_counter()
    run_one(reader, mutated(random.Random(number), [*seeds(reader), junk]))
    assert time.perf_counter() - start < SLOW
