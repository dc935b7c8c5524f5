"""The two sums over samples that determine a sparse posterior. They can be streamed, added and discounted.

Only S_i = W_iᵀW_i and c_i = W_iᵀy_i of whitened rows y_i = W_i f(x_i) + ε enter the sums G = Σ V_i S_i V_iᵀ
and v = Σ V_i c_i, where V_i contains the basis functions of each component at sample i.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from forcegp.errors import ModelError
from forcegp.gp.basis import LatentBasis
from forcegp.gp.features import Block, chunked

CHUNK_SAMPLES = 1024
"""Number of samples whose basis functions are kept in memory at a time."""
FEW = 5
"""Maximum number of columns of a component whose rows are computed, such as constants. With 16, which
includes the six columns of joint friction, means after updates in C and in Python differ by 1.7e-10 σ instead
of 0.6e-10 σ."""


@dataclass(frozen=True, eq=False)
class Moments:
    """All sums over the samples except the large matrix G.

    Attributes:
        v: Σ V Wᵀy `(size,)`.
        yy: Σ y² `()`.
        rows: number of rows, scaled down by forgetting `()`.
        prior: Σ tr W k Wᵀ `(processes,)` for the part of each process that inducing points approximate.
        missed: the residual prior variance, Σ tr W (k − VᵀV) Wᵀ `(processes,)`.
    """

    v: Tensor
    yy: Tensor
    rows: Tensor
    prior: Tensor
    missed: Tensor

    @property
    def tensors(self) -> tuple[Tensor, ...]:
        """All sums."""
        return tuple(getattr(self, field.name) for field in fields(self))


@dataclass(frozen=True, eq=False)
class Sums(Moments):
    """All sums over the samples for one basis.

    Attributes:
        G: Σ V S Vᵀ `(size, size)`.
    """

    G: Tensor

    @classmethod
    def zero(cls, basis: LatentBasis, like: Tensor) -> Sums:
        """Return the sums of an empty data set."""
        n, p = basis.size, len(basis.parts)
        return cls(*(like.new_zeros(shape) for shape in ((n,), (), (), (p,), (p,), (n, n))))

    def __add__(self, other: Sums) -> Sums:
        """Add the sums over two sets of samples.

        Raises:
            ModelError: the sums belong to bases of different sizes.
        """
        self._check(other)
        return Sums(*(a + b for a, b in zip(self.tensors, other.tensors, strict=True)))

    def __sub__(self, other: Sums) -> Sums:
        """Remove the samples of `other`, which must be a subset of the samples.

        Raises:
            ModelError: the sums belong to bases of different sizes, or `other` has more rows.
        """
        self._check(other)
        if float(other.rows) > float(self.rows):
            raise ModelError(
                "cannot remove more rows than were added",
                expected=f"at most {float(self.rows):g}",
                got=float(other.rows),
            )
        return Sums(*(a - b for a, b in zip(self.tensors, other.tensors, strict=True)))

    def scaled(self, factor: float) -> Sums:
        """Scale the sums by `factor` for exponential forgetting.

        Raises:
            ModelError: the factor is not between 0 and 1.
        """
        if not 0.0 <= factor <= 1.0:
            raise ModelError("a forgetting factor must be between 0 and 1", got=factor)
        return Sums(*(factor * a for a in self.tensors))

    def _check(self, other: Sums) -> None:
        if self.G.shape != other.G.shape or self.prior.shape != other.prior.shape:
            raise ModelError(
                "sums of different bases cannot be combined",
                expected=f"{len(self.v)} basis functions of {len(self.prior)} processes",
                got=f"{len(other.v)} of {len(other.prior)}",
                hint="compute both with the same inducing points and hyperparameters",
            )


@torch.no_grad()
def without_feedback(sums: Sums, later: Tensor, widens: bool = False) -> Sums:
    """Return sums in which some weights are learned from what the others leave, and do not change them.

    With weights o learned first and p later, A = I + G, and ŵ_o = A_oo⁻¹ v_o, the sums have G_op = 0 and
    v_p − G_po ŵ_o: feedback from p is cut (Plummer, *Cuts in Bayesian graphical models*, 2015). Since w_p is
    unknown, the covariance of w_o is that of both learned together, (A_oo − G_op A_pp⁻¹ G_po)⁻¹.

    Args:
        later: positions of the weights p `(k,)`.
        widens: whether A_oo is replaced by the inverse of this covariance.
    """
    if not len(later):
        return sums
    first = torch.ones_like(sums.v, dtype=torch.bool)
    first[later] = False
    o = first.nonzero()[:, 0]
    G, v = sums.G.clone(), sums.v.clone()
    A = G[o[:, None], o] + torch.eye(len(o)).to(G)
    w = torch.cholesky_solve(v[o, None], torch.linalg.cholesky(A))[:, 0]
    B = G[o[:, None], later]
    v[later] -= B.mT @ w
    if widens:
        # P = A_oo − B A_pp⁻¹ Bᵀ, A_pp = R Rᵀ
        A_pp = sums.G[later[:, None], later] + torch.eye(len(later)).to(G)
        half = torch.linalg.solve_triangular(torch.linalg.cholesky(A_pp), B.mT, upper=False)
        P = A - half.mT @ half
        G[o[:, None], o], v[o] = P - torch.eye(len(o)).to(G), P @ w
    G[later[:, None], o], G[o[:, None], later] = 0.0, 0.0
    return replace(sums, v=v, G=G)


@torch.no_grad()
def accumulate(basis: LatentBasis, blocks: Iterable[Block], chunk: int = CHUNK_SAMPLES) -> Sums:
    """Sum over the samples in the blocks. The memory needed does not depend on their number.

    Args:
        blocks: whitened rows, possibly from a generator.
        chunk: number of samples per chunk.
    """
    total: Sums | None = None
    for block in chunked(blocks, chunk):
        total = Sums.zero(basis, block.target) if total is None else total
        _add(basis, block, total)
    if total is None:
        return Sums.zero(basis, next(iter(basis.params.values())))
    # G = Gᵀ, from its upper triangle
    total.G.copy_(torch.triu(total.G) + torch.triu(total.G, 1).mT)
    return total


def _add(basis: LatentBasis, block: Block, into: Sums) -> None:
    """Add a block in place. Only the upper triangle of G is updated.

    The rows Φ of components with few columns are computed for all of them together.
    """
    V, prior, missed = basis.evaluate(block.features)
    W, y = torch.cat(block.operators, dim=-1), block.target
    # S_kk of S = WᵀW `(n, k)`
    S_kk = W.square().sum(1)
    sizes = [at.stop - at.start if bool(S_kk[:, k].any()) else 0 for k, at in enumerate(basis.columns)]
    wide, narrow = (
        [k for k, n in enumerate(sizes) if n > FEW],
        [k for k, n in enumerate(sizes) if 0 < n <= FEW],
    )
    _add_wide(basis, V, W[..., wide], wide, y, into)
    if narrow:
        at = torch.cat([_range(basis.columns[k]) for k in narrow]).to(V.device)
        owner = torch.tensor(narrow).repeat_interleave(torch.tensor([sizes[k] for k in narrow])).to(V.device)
        # Φ = W V, G_NN += ΦᵀΦ, v_N += Φᵀy, and G_kN += Σ_i V_kᵀ (W_kᵀ Φ) for all other components k
        Phi = W.index_select(-1, owner) * V.index_select(1, at)[:, None]
        rows = Phi.flatten(0, 1)
        into.G[at[:, None], at] += rows.mT @ rows
        into.v[at] += rows.mT @ y.flatten()
        across = (W[..., wide].mT @ Phi).transpose(0, 1).contiguous()
        for k, of_all in zip(wide, across, strict=True):
            own = _range(basis.columns[k]).to(V.device)
            both, later = V[:, basis.columns[k]].mT @ of_all, at > own[0]
            into.G[own[:, None], at[later]] += both[:, later]
            into.G[at[~later][:, None], own] += both[:, ~later].mT
    # tr W k Wᵀ = Σ_k S_kk k_k(x, x), and of what is missed, k − |V|²
    into.prior.add_(_by_process(basis, S_kk, prior))
    into.missed.add_(_by_process(basis, S_kk, missed))
    into.yy.add_((y**2).sum())
    into.rows.add_(block.rows)


def _range(columns: slice) -> Tensor:
    return torch.arange(columns.start, columns.stop)


def _add_wide(basis: LatentBasis, V: Tensor, W: Tensor, wide: list[int], y: Tensor, into: Sums) -> None:
    """Add the components with several columns, whose rows W V would need too much memory."""
    # S = WᵀW `(k, k, n)` and c = Wᵀy `(n, k)` of each sample
    S, c = (W.mT @ W).permute(1, 2, 0).contiguous(), (W.mT @ y[..., None])[..., 0]
    weighted, columns = torch.empty_like(V), [basis.columns[k] for k in wide]
    for k, of_k in enumerate(columns):
        # G_kl += Σ_i V_k S_kl V_lᵀ, v_k += Σ_i V_k c_k
        for l, of_l in enumerate(columns[k:], k):
            torch.mul(V[:, of_l], S[k, l, :, None], out=weighted[:, of_l])
        for run in _runs(columns[k:]):
            into.G[of_k, run].addmm_(V[:, of_k].mT, weighted[:, run])
        into.v[of_k] += V[:, of_k].mT @ c[:, k]


def _by_process(basis: LatentBasis, S_kk: Tensor, variance: Tensor) -> Tensor:
    """Return Σ S_kk var_k for each process `(processes,)`, given S_kk and the variances `(n, k)`."""
    traces = (S_kk * variance).sum(0)
    return torch.stack([traces[components].sum() for components in basis.components])


@torch.no_grad()
def add_rows(basis: LatentBasis, moments: Moments, blocks: Sequence[Block]) -> tuple[Moments, Tensor]:
    """Add a few samples to the moments, and express their rows in terms of the basis functions.

    The rows are computed explicitly, which is faster than `accumulate` for a small number of samples.

    Returns:
        The new moments, and the matrix Φ `(rows, size)` of rows W_i V_iᵀ.
    """
    Phi = moments.v.new_zeros(sum(block.rows for block in blocks), basis.size)
    traces = [moments.v.new_zeros(2)] * len(basis.parts)
    for block, rows in zip(blocks, Phi.split([block.rows for block in blocks]), strict=True):
        for p, (part, x, W) in enumerate(zip(basis.parts, block.features, block.operators, strict=True)):
            if not bool(W.any()):
                continue
            # Φ_i = W_i V_iᵀ
            values, explained = part.values(x)
            rows[:, basis.of_process(p)] = part.rows(W, values)
            # Σ_k S_kk k_k(x, x) and Σ_k S_kk (k_k − |V_k|²)
            S_kk, variance = torch.linalg.vecdot(W, W, dim=1).mT, part.rest_variance(x)
            missed = part.missed(variance, explained)
            traces[p] = traces[p] + (S_kk * torch.stack([variance, missed])).sum((1, 2))
    y = torch.cat([block.target.reshape(-1) for block in blocks])
    # v += Φᵀ y
    v = torch.addmv(moments.v, Phi.mT, y)
    prior, missed = torch.stack(traces, dim=1)
    yy, rows = moments.yy + y @ y, moments.rows + len(y)
    return Moments(v, yy, rows, moments.prior + prior, moments.missed + missed), Phi


def _runs(columns: list[slice]) -> list[slice]:
    """Merge adjacent slices."""
    runs: list[slice] = []
    for part in columns:
        if runs and runs[-1].stop == part.start:
            runs[-1] = slice(runs[-1].start, part.stop)
        else:
            runs.append(part)
    return runs
