"""Whitened rows of two processes at random inputs, and the textbook sparse Gaussian process in NumPy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from forcegp.gp.basis import latent_basis
from forcegp.gp.features import Block, Features, components_of
from forcegp.gp.kernels import Kernel, Linear, Matern32, Parameters, Process, SquaredExponential, sub
from forcegp.gp.sparse import SparsePosterior
from forcegp.gp.sums import accumulate

WIDTHS = {"q": 2, "qd": 2}
COMPONENTS = (2, 1)


@dataclass(frozen=True)
class Named:
    """A process by its kernel and prefix."""

    kernel: Kernel
    prefix: str


MIXED = (
    Linear(("qd",), shared=True) * SquaredExponential(("q",)) + Linear(("qd",)) + SquaredExponential(("q",))
)
PROCESSES = (Named(MIXED, "joint"), Named(Matern32(("qd",)) + Linear(("q",)) * Linear(("qd",)), "contact"))


def parameters(processes: tuple[Named, ...] = PROCESSES, seed: int = 3) -> dict[str, Tensor]:
    """Random hyperparameters around the kernels' start, with short length-scales."""
    generator = torch.Generator().manual_seed(seed)
    params = {}
    for process, outputs in zip(processes, COMPONENTS, strict=True):
        for key, value in process.kernel.initial(outputs, WIDTHS).items():
            step = 0.2 * torch.randn(value.shape, generator=generator, dtype=torch.float64)
            shorter = 0.5 if "lengthscale" in key else 0.0
            params[f"{process.prefix}.{key}"] = value + step - shorter
    return params


def rows(n: int, r: int = 3, seed: int = 0) -> Block:
    """n samples with r rows each, with targets of unit size."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    features = tuple({name: normal(n, w) for name, w in WIDTHS.items()} for _ in COMPONENTS)
    return Block(features, tuple(normal(n, r, k) for k in COMPONENTS), normal(n, r))


def first(block: Block, count: int) -> list[dict[str, Tensor]]:
    """The inputs of the first samples of a block as inducing points of each process."""
    return [{name: x[:count] for name, x in f.items()} for f in block.features]


def condition_sparse(
    processes: Sequence[Process], params: Parameters, blocks: Sequence[Block], inducing: Sequence[Features]
) -> SparsePosterior:
    """Processes conditioned on whitened rows through given inducing points."""
    basis = latent_basis(processes, params, inducing, components_of(blocks[0]))
    return SparsePosterior.of(basis, accumulate(basis, blocks))


class DenseSparse:
    """Deterministic-training-conditional formulas of Titsias (2009) in terms of all rows' covariances.

    u are the values of every process at its inducing inputs, with the finite part of the kernels kept
    exact: Q = K_fu K_uu⁻¹ K_uf of the rest plus the finite part's own covariance.
    """

    def __init__(
        self,
        processes: tuple[Named, ...],
        finite: tuple[Kernel | None, ...],
        rest: tuple[Kernel | None, ...],
        params: tuple[tuple[dict, dict], ...],
        blocks: list[Block],
        inducing: list[dict[str, Tensor]],
    ) -> None:
        self.finite, self.rest, self.params = finite, rest, params
        self.blocks, self.Z = blocks, inducing
        self.y = np.concatenate([b.target.numpy().reshape(-1) for b in blocks])
        self.Q = self.covariance(blocks, blocks, "Q")
        self.K = self.covariance(blocks, blocks, "K")

    def latent(self, p: int, x1: dict, x2: dict, kind: str) -> np.ndarray:
        """Covariance of one process `(k, n, n')`: exact ("K") or through the inducing points ("Q")."""
        finite, rest = self.params[p]
        total = np.zeros((COMPONENTS[p], len(x1["q"]), len(x2["q"])))
        if self.finite[p] is not None:
            total += self.finite[p].covariance(finite, x1, x2).numpy()
        if self.rest[p] is None:
            return total
        if kind == "K":
            return total + self.rest[p].covariance(rest, x1, x2).numpy()
        to1, to2, K = (self.rest[p].covariance(rest, a, b).numpy() for a, b in self._pairs(p, x1, x2))
        for k in range(len(total)):
            total[k] += to1[k] @ np.linalg.solve(K[k], to2[k].T)
        return total

    def _pairs(self, p: int, x1: dict, x2: dict) -> list[tuple[dict, dict]]:
        return [(x1, self.Z[p]), (x2, self.Z[p]), (self.Z[p], self.Z[p])]

    def covariance(self, one: list[Block], two: list[Block], kind: str) -> np.ndarray:
        """Covariance of all rows with one einsum."""
        grid = []
        for a in one:
            line = []
            for b in two:
                total = np.zeros(())
                for p in range(len(COMPONENTS)):
                    k = self.latent(p, a.features[p], b.features[p], kind)
                    total = total + np.einsum(
                        "iak,kij,jbk->iajb", a.operators[p].numpy(), k, b.operators[p].numpy()
                    )
                line.append(total.reshape(a.rows, b.rows))
            grid.append(line)
        return np.block(grid)

    def negative_bound(self) -> float:
        """−log N(y; 0, Q + I) + ½ tr(K − Q)."""
        C = self.Q + np.eye(len(self.y))
        sign, logdet = np.linalg.slogdet(C)
        assert sign > 0
        fit = self.y @ np.linalg.solve(C, self.y)
        return 0.5 * (fit + logdet + len(self.y) * np.log(2 * np.pi) + np.trace(self.K - self.Q))

    def predict(self, block: Block) -> tuple[np.ndarray, np.ndarray]:
        """Mean `(n, d)` and covariance `(n, d, d)` of rows without noise."""
        C = self.Q + np.eye(len(self.y))
        cross = self.covariance([block], self.blocks, "Q")
        mean = cross @ np.linalg.solve(C, self.y)
        full = self.covariance([block], [block], "K") - cross @ np.linalg.solve(C, cross.T)
        n, d = block.target.shape
        full = full.reshape(n, d, n, d)
        return mean.reshape(n, d), np.stack([full[i, :, i] for i in range(n)])


def textbook(
    blocks: list[Block], inducing: list[dict[str, Tensor]], params: dict[str, Tensor]
) -> DenseSparse:
    """The dense formulas for `PROCESSES`, whose finite and other terms are written down here by hand."""
    joint, contact = sub(params, "joint"), sub(params, "contact")
    damping = Linear(("qd",), shared=True) * SquaredExponential(("q",))
    rest = damping + SquaredExponential(("q",))
    rest_params = {f"left.{k}": v for k, v in sub(joint, "left.left").items()}
    rest_params |= {f"right.{k}": v for k, v in sub(joint, "right").items()}
    return DenseSparse(
        PROCESSES,
        (Linear(("qd",)), Linear(("q",)) * Linear(("qd",))),
        (rest, Matern32(("qd",))),
        ((sub(joint, "left.right"), rest_params), (sub(contact, "right"), sub(contact, "left"))),
        blocks,
        inducing,
    )


def latent_covariance(posterior: SparsePosterior, block: Block) -> Tensor:
    """Posterior covariance of all components at the samples of a block, `(n, components, components)`."""
    eye = torch.eye(sum(COMPONENTS), dtype=torch.float64).expand(len(block.target), -1, -1)
    return posterior.covariance(Block(block.features, eye.split(COMPONENTS, dim=-1), eye[..., 0]))
