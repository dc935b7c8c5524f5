"""Greedy inducing points against the conditional variances written down."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from forcegp.gp.basis import latent_basis
from forcegp.gp.features import Block
from forcegp.gp.inducing import select_inducing
from forcegp.gp.kernels import Linear, Matern32, SquaredExponential, sub
from forcegp.gp.sums import accumulate
from gp.sparse_cases import COMPONENTS, PROCESSES, Named, parameters, rows


def by_hand(block: Block, params: dict[str, Tensor], count: int) -> tuple[list[int], list[float]]:
    """Greedy choice for the second process, every conditional variance from a dense solve."""
    x, weight = block.features[1], (block.operators[1] ** 2).sum(1)[:, 0]
    k = Matern32(("qd",)).covariance(sub(params, "contact.left"), x, x)[0]
    chosen, missed = [], []
    for _ in range(count + 1):
        own = k[:, chosen]
        left = k.diagonal() - (own * torch.linalg.solve(k[chosen][:, chosen], own.mT).mT).sum(-1)
        missed.append(float((weight * left).sum()) / block.rows)
        chosen.append(int((weight * left).argmax()))
    return chosen[:-1], missed


def test_each_point_is_where_most_is_missed() -> None:
    block, params = rows(60), parameters()
    chosen, missed = by_hand(block, params, 10)
    selection = select_inducing(PROCESSES, params, [block], limit=10, share=0.0)[1]
    assert torch.equal(selection.points["qd"], block.features[1]["qd"][chosen])
    assert selection.missed.tolist() == pytest.approx(missed, rel=1e-8)


def test_missed_is_the_trace_term_of_the_bound() -> None:
    block, params = rows(60), parameters()
    selections = select_inducing(PROCESSES, params, [block], limit=12, share=0.0)
    basis = latent_basis(PROCESSES, params, [s.points for s in selections], COMPONENTS)
    sums = accumulate(basis, [block])
    for p, selection in enumerate(selections):
        assert float(selection.missed[-1]) == pytest.approx(float(sums.missed[p]) / block.rows, rel=1e-7)
        assert float(selection.missed[0]) == pytest.approx(float(sums.prior[p]) / block.rows, rel=1e-12)


def test_number_follows_the_criterion() -> None:
    block, params = rows(80), parameters()
    for share, rows_in_all in ((0.5, None), (0.5, 400), (2.0, None)):
        chosen = select_inducing(PROCESSES, params, [block], rows_in_all, limit=80, share=share)
        for selection, components in zip(chosen, COMPONENTS, strict=True):
            functions = components * torch.arange(len(selection.missed))
            enough = selection.missed * (rows_in_all or block.rows) <= share * functions
            assert enough.tolist() == [False] * (len(enough) - 1) + [True]
    kernel = SquaredExponential(("q",))
    smooth = {f"one.{k}": v + 3.0 for k, v in kernel.initial(2, {"q": 2}).items()}
    smooth["one.log_std"] -= 3.0
    block = Block(block.features[:1], block.operators[:1], block.target)
    (few,) = select_inducing([Named(kernel, "one")], smooth, [block], limit=80)
    assert len(few.points["q"]) <= 12


def test_no_points_where_none_are_needed() -> None:
    block, params = rows(20), parameters()
    hidden = Block(block.features, (block.operators[0], torch.zeros_like(block.operators[1])), block.target)
    selections = select_inducing(PROCESSES, params, [hidden], limit=5)
    assert len(selections[1].points["q"]) == 0
    kernel = Linear(("q",))
    linear = {f"contact.{k}": v for k, v in kernel.initial(1, {"q": 2, "qd": 2}).items()}
    only = (PROCESSES[0], Named(kernel, "contact"))
    assert len(select_inducing(only, params | linear, [block], limit=5)[1].points["q"]) == 0


def test_repeated_samples_are_chosen_once() -> None:
    block, params = rows(6), parameters()
    twice = [block, block]
    for selection in select_inducing(PROCESSES, params, twice, limit=12, share=0.0):
        x = torch.cat([selection.points["q"], selection.points["qd"]], dim=-1)
        assert len(x.unique(dim=0)) == 6
        assert float(selection.missed[-1]) < 1e-9 * float(selection.missed[0])
