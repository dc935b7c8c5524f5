"""A sparse posterior survives being written down as tensors."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from forcegp.errors import ModelError
from forcegp.gp.sparse import SparsePosterior
from gp.sparse_cases import PROCESSES, condition_sparse, first, parameters, rows


def test_what_is_loaded_predicts_the_same_and_can_be_updated(tmp_path: Path) -> None:
    block, test, params = rows(30), rows(5, seed=2), parameters()
    Z = first(block, 8)
    posterior = condition_sparse(PROCESSES, params, [block], [Z[0], {k: x[:0] for k, x in Z[1].items()}])
    save_file(posterior.tensors(), tmp_path / "posterior.safetensors")
    loaded = SparsePosterior.of_tensors(PROCESSES, params, load_file(tmp_path / "posterior.safetensors"))
    assert torch.equal(loaded.covariance(test), posterior.covariance(test))
    for p, features in enumerate(test.features):
        assert torch.equal(loaded.latent_mean(p, features), posterior.latent_mean(p, features))
    more = rows(40, seed=7)
    for one, other in ((loaded.updated([more]), posterior.updated([more])), (loaded, posterior)):
        assert torch.allclose(one.sums.G, other.sums.G, rtol=1e-10, atol=1e-10)


def test_what_does_not_fit_is_refused() -> None:
    block, params = rows(30), parameters()
    tensors = condition_sparse(PROCESSES, params, [block], first(block, 8)).tensors()
    with pytest.raises(ModelError, match=r"incomplete[\s\S]*L"):
        SparsePosterior.of_tensors(PROCESSES, params, {k: x for k, x in tensors.items() if k != "L"})
    with pytest.raises(ModelError, match="does not match its processes"):
        SparsePosterior.of_tensors(PROCESSES, params, tensors | {"L": tensors["L"][:-1, :-1]})
