"""Typed errors travel: they are copied and sent between processes with everything that they say."""

from __future__ import annotations

import copy
import importlib
import inspect
import pickle
import pkgutil
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import pytest
import torch

import forcegp
from forcegp.errors import DataError, ForceGPError, NumericalError, UnknownNameError
from forcegp.rollout.trajectory import DivergedError, Divergence


def error_classes() -> list[type[ForceGPError]]:
    for module in pkgutil.walk_packages(forcegp.__path__, "forcegp."):
        if not module.name.endswith("__main__"):  # the program, which takes over interrupts
            importlib.import_module(module.name)
    found, todo = [], [ForceGPError]
    while todo:
        kind = todo.pop()
        found.append(kind)
        todo += kind.__subclasses__()
    return sorted(set(found), key=lambda kind: kind.__name__)


def sample(kind: type[ForceGPError]) -> ForceGPError:
    if kind is UnknownNameError:
        return UnknownNameError("joint", "elbw", ["shoulder", "elbow"])
    if kind is DivergedError:
        return DivergedError([Divergence(0.1, 0, [0.0], [1.0], "too fast")], 2, "rollout")  # type: ignore[arg-type]
    if "message" not in inspect.signature(kind).parameters:
        pytest.skip(f"{kind.__name__} has a constructor of its own: add a sample")
    return kind("the sentence", expected=("a", torch.float64), got=torch.zeros(2), hint="do this")


@pytest.mark.parametrize("kind", error_classes(), ids=lambda kind: kind.__name__)
def test_an_error_is_copied_with_all_that_it_says(kind: type[ForceGPError]) -> None:
    error = sample(kind)
    for copied in (pickle.loads(pickle.dumps(error)), copy.deepcopy(error), copy.copy(error)):
        assert type(copied) is kind
        assert str(copied) == str(error)
        assert (copied.message, copied.hint) == (error.message, error.hint)
        assert str(copied.expected) == str(error.expected)


def test_what_cannot_be_sent_is_sent_as_text() -> None:
    error = DataError("wrong", got=lambda x: x)
    assert "lambda" in pickle.loads(pickle.dumps(error)).got


def fail_in_a_worker(number: int) -> None:
    raise UnknownNameError("joint", f"elbow{number}", ["elbow"])


def test_a_worker_of_a_process_pool_raises_the_typed_error() -> None:
    message = r"unknown joint 'elbow3'(.|\n)*did you mean 'elbow'"
    with (
        ProcessPoolExecutor(1, mp_context=get_context("fork")) as pool,
        pytest.raises(UnknownNameError, match=message),
    ):
        pool.submit(fail_in_a_worker, 3).result()


def test_an_error_at_a_place_keeps_its_parts_whatever_its_class() -> None:
    cause = DataError("row 3 is wrong", expected=1, got=2, hint="drop it")
    assert str(NumericalError.at("a.csv", cause)).startswith("a.csv: row 3 is wrong\n  expected: 1")
    assert UnknownNameError.at("a.csv", cause).hint == "drop it"


def test_a_huge_name_among_huge_lists_is_refused_at_once() -> None:
    names = ["x" * 50 + str(i) for i in range(200_000)]
    text = str(UnknownNameError("key", "y" * 10**6, names))
    assert len(text) < 200_000
    assert "and 199500 more" in text
