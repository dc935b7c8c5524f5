"""Models and their errors travel to the workers of a process pool and back."""

from __future__ import annotations

import dataclasses
import multiprocessing
import os
import pickle
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor

import pytest
import torch

import forcegp
from forcegp.errors import ForceGPError, ModelError
from forcegp.forces.quantities import States
from forcegp.models.structured_fit import StructuredFit
from random_data import random_data, table_system

DATA = random_data(table_system(), 12)
FEW = forcegp.models.LearningOptions(max_evaluations=2)


@pytest.fixture(scope="module")
def pool() -> Iterator[ProcessPoolExecutor]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("OMP_NUM_THREADS", "1")
        patch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
        with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as workers:
            yield workers


def identity(system: forcegp.ConstrainedSystem, at: States) -> torch.Tensor:
    return torch.eye(7, dtype=torch.float64).expand(len(at.q), 7, 7)


def predicted(model: StructuredFit, quantity: str) -> torch.Tensor:
    """What a worker predicts, as a tensor that is sent back by value."""
    return model.predict(DATA.q, DATA.qd, DATA.tau, quantity).mean.clone()


@pytest.mark.slow
def test_a_worker_predicts_the_same_bits_and_raises_the_same_error(pool: ProcessPoolExecutor) -> None:
    model = forcegp.StructuredGP(table_system(), "zero", noise=0.1).fit(DATA, options=FEW)
    here = predicted(model, "qdd")
    assert pool.submit(predicted, model, "qdd").result(timeout=120).tolist() == here.tolist()
    with pytest.raises(ForceGPError, match="unknown quantity") as there:
        pool.submit(predicted, model, "gdd").result(timeout=120)
    with pytest.raises(ForceGPError) as error:
        predicted(model, "gdd")
    assert str(there.value) == str(error.value) and type(there.value) is type(error.value)


def fitted(model: forcegp.StructuredGP) -> list[float]:
    """What a worker fits and predicts."""
    return predicted(model.fit(DATA, options=FEW), "qdd").flatten().tolist()


def test_a_worker_fits_a_model_to_the_same_bits(pool: ProcessPoolExecutor) -> None:
    model = forcegp.StructuredGP(table_system(), "zero", noise=0.1)
    assert pool.submit(fitted, model).result(timeout=120) == fitted(model)


def test_a_fit_of_python_code_says_so_before_it_is_sent(pool: ProcessPoolExecutor) -> None:
    hill = forcegp.priors.OperatorForcePrior("own", 7, identity)
    fit = forcegp.StructuredGP(table_system(), "zero", force_priors=[hill], noise=0.1).fit(DATA, learn=[])
    with pytest.raises(ModelError, match="contains Python code"):
        pool.submit(predicted, fit, "qdd").result(timeout=120)


def test_equations_that_a_measurement_keeps_are_not_sent() -> None:
    """They are many times as large as the samples."""
    fit = forcegp.StructuredGP(table_system(), noise=0.1).fit(DATA, learn=[])
    (m,) = fit.training.measurements
    plain = len(pickle.dumps(dataclasses.replace(m)))
    assert m.at(fit.system) is m.at(fit.system)
    assert len(pickle.dumps(m)) == plain
