"""Models of a robot in single precision: those that cannot compute in it say so at once."""

from __future__ import annotations

import pytest
import torch

import forcegp
from forcegp.errors import ModelError
from forcegp.models.registry import create
from random_data import table_system

SYSTEM = table_system()
SINGLE = SYSTEM.with_robot(SYSTEM.robot.to(dtype=torch.float32))


@pytest.mark.parametrize("name", ["gp", "sgp-zero", "sgp-mean", "sgp-contact"])
def test_gaussian_processes_refuse_single_precision(name: str) -> None:
    with pytest.raises(ModelError, match="need double precision") as error:
        create(name, SINGLE, noise=0.1, seed=0)
    assert error.value.hint is not None and "float64" in error.value.hint
    create(name, SYSTEM, noise=0.1, seed=0)


def test_the_analytical_model_computes_in_single_precision() -> None:
    q = torch.zeros(3, SINGLE.robot.nq)
    found = forcegp.AnalyticalModel(SINGLE).nominal().predict(q, q, q)
    assert found.mean.dtype == torch.float32
