"""The two sums over samples that determine a sparse posterior. They can be streamed, added and discounted.

Only S_i = W_iᵀW_i and c_i = W_iᵀy_i of whitened rows y_i = W_i f(x_i) + ε enter the sums G = Σ V_i S_i V_iᵀ
and v = Σ V_i c_i, where V_i contains the basis functions of each component at sample i.
"""

from __future__ import annotations

import itertools
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
    total, part = Sums.zero(basis, next(iter(basis.params.values()))), None
    for block in chunked(blocks, chunk):
        groups = _groups(basis, block)
        if part is None or part.groups != groups:
            if part is not None:
                part.add_to(total)
            part = _Arranged.zero(basis, groups, total.v)
        part.add(basis, block, total)
    if part is not None:
        part.add_to(total)
    return total


@dataclass(frozen=True)
class _Group:
    """Processes with the same operator. They act like one process with all their basis functions.

    Attributes:
        processes: the processes.
        components: number of components.
        width: number of columns of each component, including padding.
    """

    processes: tuple[int, ...]
    components: int
    width: int


def _groups(basis: LatentBasis, block: Block) -> tuple[_Group, ...]:
    """Return the processes that act on a block, grouped by operator. Groups with few columns are the last."""
    same: dict[int, list[int]] = {}
    for p, W in enumerate(block.operators):
        same.setdefault(id(W), []).append(p)
    groups = []
    for processes in same.values():
        if bool(block.operators[processes[0]].any()):
            width = sum(basis.parts[p].used.shape[1] for p in processes)
            groups.append(_Group(tuple(processes), basis.parts[processes[0]].components, width))
    return tuple(sorted(groups, key=lambda group: group.width <= FEW))


@dataclass(frozen=True, eq=False)
class _Arranged:
    """The sums G and v over samples that have the same groups, with columns in the order of the groups.

    Attributes:
        groups: the groups.
        positions: position of each column in the basis, or −1 for padding.
        G: Σ V S Vᵀ, of which only the upper triangle is used.
        v: Σ V c.
    """

    groups: tuple[_Group, ...]
    positions: Tensor
    G: Tensor
    v: Tensor

    @classmethod
    def zero(cls, basis: LatentBasis, groups: tuple[_Group, ...], like: Tensor) -> _Arranged:
        """Return the sums over no samples."""
        each = [torch.arange(0)]
        for group in groups:
            places = [torch.full(basis.parts[p].used.shape, -1) for p in group.processes]
            for at, p in zip(places, group.processes, strict=True):
                columns = basis.of_process(p)
                at[basis.parts[p].used] = torch.arange(columns.start, columns.stop)
            each.append(torch.cat(places, dim=1).flatten())
        at = torch.cat(each).to(like.device)
        return cls(groups, at, like.new_zeros(len(at), len(at)), like.new_zeros(len(at)))

    def add(self, basis: LatentBasis, block: Block, moments: Moments) -> None:
        """Add a block in place, and its other sums to the moments."""
        y, W = block.target, [block.operators[group.processes[0]] for group in self.groups]
        V = [_values(basis, block, group, moments) for group in self.groups]
        wide = sum(group.width > FEW for group in self.groups)
        W_wide = torch.cat([y.new_zeros(*y.shape, 0), *W[:wide]], dim=-1)
        V_wide = torch.cat([y.new_zeros(len(y), 0), *(x.flatten(1) for x in V[:wide])], dim=-1)
        # S = WᵀW `(k, k, n)` and c = Wᵀy `(k, n)` of each sample
        S, c = (W_wide.mT @ W_wide).permute(1, 2, 0).contiguous(), (W_wide.mT @ y[..., None])[..., 0].mT
        # The other rows Φ = W V are computed, and Wᵀ Φ
        Phi = [
            (W_g[..., None] * V_g[:, None]).flatten(2) for W_g, V_g in zip(W[wide:], V[wide:], strict=True)
        ]
        rows = torch.cat([y.new_zeros(*y.shape, 0), *Phi], dim=-1)
        across, rows = W_wide.mT @ rows, rows.flatten(0, 1)
        few, columns = slice(V_wide.shape[1], None), self._columns(wide)
        weighted = torch.empty_like(V_wide)
        for k, of_k in enumerate(columns):
            # G_kl += Σ_i V_k S_kl V_lᵀ, v_k += Σ_i V_k c_k
            for l, of_l in enumerate(columns[k:], k):
                torch.mul(V_wide[:, of_l], S[k, l, :, None], out=weighted[:, of_l])
            V_k, later = V_wide[:, of_k].mT, slice(of_k.start, few.start)
            self.G[of_k, later].addmm_(V_k, weighted[:, later])
            self.G[of_k, few].addmm_(V_k, across[:, k])
            self.v[of_k] += V_k @ c[k]
        self.G[few, few].addmm_(rows.mT, rows)
        self.v[few] += rows.mT @ y.flatten()
        moments.yy.add_(y.square().sum())
        moments.rows.add_(block.rows)

    def _columns(self, wide: int) -> list[slice]:
        """Return the columns of each component of the first groups."""
        widths = [group.width for group in self.groups[:wide] for _ in range(group.components)]
        ends = list(itertools.accumulate(widths, initial=0))
        return [slice(a, b) for a, b in itertools.pairwise(ends)]

    def add_to(self, total: Sums) -> None:
        """Add the sums to those of the basis, in its order and without padding."""
        used = (self.positions >= 0).nonzero()[:, 0]
        at, G = self.positions[used], torch.triu(self.G)[used[:, None], used]
        total.G[at[:, None], at] += G + torch.triu(G, 1).mT
        total.v[at] += self.v[used]


def _values(basis: LatentBasis, block: Block, group: _Group, moments: Moments) -> Tensor:
    """Return the basis functions of a group `(n, components, width)`, with zeros as padding.

    The variances of the parts that inducing points approximate are added to the moments.
    """
    S_kk, each = block.operators[group.processes[0]].square().sum(1).mT, []
    for p in group.processes:
        part, x = basis.parts[p], block.features[p]
        values, explained = part.values(x)
        each.append(values.transpose(0, 1))
        if part.split.rest is not None:
            # tr W k Wᵀ = Σ_k S_kk k_k(x, x) with S = WᵀW, and of what is missed, k − |V|²
            prior = part.rest_variance(x)
            moments.prior[p] += (S_kk * prior).sum()
            moments.missed[p] += (S_kk * part.missed(prior, explained)).sum()
    return torch.cat(each, dim=-1)


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
