"""Basis functions of latent components: whitened covariances with inducing points, and exact features.

With inducing points Z and K_zz = R⁻ᵀR⁻¹, V(x) = Rᵀk(Z, x) are features with a standard normal prior on
their weights, and V(x)ᵀV(x′) = k(x, Z) K_zz⁻¹ k(Z, x′). Eigenvalues of K_zz below `TRUNCATION` of the
largest are dropped. Linear parts of a kernel add their own features, which are exact.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import torch
from torch import Tensor

from forcegp.gp.draws import FunctionDraw
from forcegp.gp.features import Split, split
from forcegp.gp.kernels import Features, Parameters, sub
from forcegp.gp.structured_covariance import Block, Process

TRUNCATION = 1e-12
"""Eigenvalues of the inducing points' covariance below this fraction of the largest are dropped.

Kernels are accurate to about 10⁻¹⁵ of their scale, so an eigenvalue at the threshold is to 10⁻³. Where the
prior is a million times as strong as the noise, a threshold of 10⁻¹⁰ loses what the data could tell.
"""


@dataclass(frozen=True)
class Spectrum:
    """Eigendecomposition of one component's K_zz, U Λ Uᵀ.

    Attributes:
        values: all eigenvalues, in ascending order `(m,)`.
        vectors: U `(m, m)`.
        dropped: how many of the smallest are dropped.
    """

    values: Tensor
    vectors: Tensor
    dropped: int

    @classmethod
    def of(cls, K: Tensor) -> Spectrum:
        """Of a symmetric matrix `(m, m)`."""
        values, vectors = torch.linalg.eigh(K)
        kept = values > TRUNCATION * values[-1] if len(values) else values > 0.0
        return cls(values, vectors, int((~kept).sum()))

    @property
    def root(self) -> Tensor:
        """R = U Λ^{−1/2} of the kept eigenvalues `(m, kept)`; R Rᵀ is the pseudo-inverse of K_zz."""
        return self.vectors[:, self.dropped :] * self.values[self.dropped :].rsqrt()


@dataclass(frozen=True, eq=False)
class ProcessBasis:
    """Basis functions of the components of one process.

    Attributes:
        split: finite part and rest of the kernel.
        params: the process's own log-hyperparameters.
        components: number of components.
        inducing: kernel inputs of the inducing points, none where only the finite part has features.
        spectra: of K_zz of each component.
    """

    split: Split
    params: dict[str, Tensor]
    components: int
    inducing: Features
    spectra: tuple[Spectrum, ...]

    @cached_property
    def roots(self) -> Tensor:
        """R of each component, filled up with zero columns `(components, m, most kept)`."""
        kept = [spectrum.root for spectrum in self.spectra]
        most = max(R.shape[1] for R in kept)
        return torch.stack([torch.nn.functional.pad(R, (0, most - R.shape[1])) for R in kept])

    @cached_property
    def to_inducing(self) -> Callable[[Features], Tensor] | None:
        """x ↦ k(x, Z) `(components, n, m)` of the kernel's rest; `None` without inducing points."""
        rest = self.split.rest
        if rest is None or not points(self.inducing):
            return None
        return rest.kernel.towards(rest.parameters(self.params), self.inducing)

    @cached_property
    def finite(self) -> FunctionDraw | None:
        """The exact features of the finite part; `None` without one."""
        return self.split.finite.features(self.params) if self.split.finite is not None else None

    @cached_property
    def finite_size(self) -> int:
        """Number of exact features of each component."""
        return self.finite.basis(self.inducing).shape[-1] if self.finite is not None else 0

    @cached_property
    def used(self) -> Tensor:
        """Which values are basis functions and no filling, `(components, width)`."""
        width = (self.roots.shape[-1] if self.spectra else 0) + self.finite_size
        used = torch.ones(self.components, width, dtype=torch.bool)
        for k, spectrum in enumerate(self.spectra):
            used[k, len(spectrum.values) - spectrum.dropped : width - self.finite_size] = False
        return used

    @cached_property
    def sizes(self) -> list[int]:
        """Number of basis functions of each component."""
        return self.used.sum(-1).tolist()

    @cached_property
    def columns(self) -> Tensor:
        """Positions of the basis functions among the values of all components."""
        device = next(iter(self.inducing.values())).device
        return self.used.reshape(-1).nonzero()[:, 0].to(device)

    def values(self, features: Features) -> tuple[Tensor, Tensor]:
        """V(x) filled up with zeros `(components, n, width)`; |V|² of inducing points `(components, n)`."""
        parts = []
        explained = next(iter(features.values())).new_zeros(self.components, points(features))
        if self.to_inducing is not None:
            parts.append(self.to_inducing(features) @ self.roots)
            explained = torch.linalg.vecdot(parts[0], parts[0])
        if self.finite is not None:
            parts.append(self.finite.basis(features))
        if len(parts) == 1:
            return parts[0], explained
        return torch.cat([explained[..., None][..., :0], *parts], dim=-1), explained

    def rest_variance(self, features: Features) -> Tensor:
        """Prior variance of the part that inducing points approximate, `(components, n)`."""
        rest = self.split.rest
        if rest is None:
            return next(iter(features.values())).new_zeros(self.components, points(features))
        return rest.kernel.diagonal(rest.parameters(self.params), features)


def points(features: Features) -> int:
    """Number of inputs in a dictionary of features."""
    return len(next(iter(features.values())))


@dataclass(frozen=True, eq=False)
class LatentBasis:
    """Basis functions of every component of every process, side by side.

    Attributes:
        priors: the processes.
        params: all log-hyperparameters.
        parts: basis of each process.
    """

    priors: tuple[Process, ...]
    params: dict[str, Tensor]
    parts: tuple[ProcessBasis, ...]

    @cached_property
    def columns(self) -> tuple[slice, ...]:
        """The basis functions of each component, the components of all processes in order."""
        sizes = [size for part in self.parts for size in part.sizes]
        ends = torch.tensor([0, *sizes]).cumsum(0).tolist()
        return tuple(slice(a, b) for a, b in pairwise(ends))

    @cached_property
    def components(self) -> tuple[slice, ...]:
        """The components of each process among all of them."""
        ends = torch.tensor([0, *(part.components for part in self.parts)]).cumsum(0).tolist()
        return tuple(slice(a, b) for a, b in pairwise(ends))

    @cached_property
    def size(self) -> int:
        """Number of basis functions in all."""
        return self.columns[-1].stop

    @cached_property
    def owner(self) -> Tensor:
        """The component of each basis function `(size,)`."""
        sizes = torch.tensor([own.stop - own.start for own in self.columns])
        device = next(iter(self.parts[0].inducing.values())).device
        return torch.arange(len(sizes)).repeat_interleave(sizes).to(device)

    def of_process(self, p: int) -> slice:
        """The basis functions of process p."""
        own = self.columns[self.components[p]]
        return slice(own[0].start, own[-1].stop)

    def evaluate(self, features: Sequence[Features]) -> tuple[Tensor, Tensor, Tensor]:
        """Basis functions at n samples.

        Args:
            features: kernel inputs of each process.

        Returns:
            V `(n, size)`; by component `(n, components)` the prior variance of the kernels' rest, and
            what is missed of it, k(x, x) − |V(x)|².
        """
        n, V, prior, missed = points(features[0]), [], [], []
        for part, x in zip(self.parts, features, strict=True):
            values, explained = part.values(x)
            V.append(values.transpose(0, 1).reshape(n, -1)[:, part.columns])
            prior.append(part.rest_variance(x))
            missed.append(prior[-1] - explained)
        return torch.cat(V, dim=-1), torch.cat(prior).mT, torch.cat(missed).mT


def latent_basis(
    priors: Sequence[Process],
    params: Parameters,
    inducing: Sequence[Features],
    components: Sequence[int],
) -> LatentBasis:
    """Basis functions of processes with given inducing points.

    Args:
        priors: the processes.
        params: log-hyperparameters, `<process>.<name>`.
        inducing: kernel inputs of the inducing points of each process, of any number, none included.
        components: number of components of each process.
    """
    parts = []
    for prior, Z, count in zip(priors, inducing, components, strict=True):
        own, kernel = sub(params, prior.prefix), split(prior.kernel)
        spectra: tuple[Spectrum, ...] = ()
        if kernel.rest is not None and points(Z):
            K = kernel.rest.kernel.covariance(kernel.rest.parameters(own), Z, Z)
            spectra = tuple(Spectrum.of(0.5 * (k + k.mT)) for k in K)
        parts.append(ProcessBasis(kernel, own, count, Z, spectra))
    return LatentBasis(tuple(priors), dict(params), tuple(parts))


def components_of(block: Block) -> list[int]:
    """Number of components of each process."""
    return [W.shape[-1] for W in block.operators]


def chunked(blocks: Iterable[Block], samples: int) -> Iterator[Block]:
    """The samples of blocks in blocks of at most so many."""
    for block in blocks:
        for first in range(0, len(block.target), samples):
            yield rows_of(block, slice(first, first + samples))


def rows_of(block: Block, own: slice | Tensor) -> Block:
    """Some of the samples of a block."""
    return Block(
        tuple({name: x[own] for name, x in f.items()} for f in block.features),
        tuple(W[own] for W in block.operators),
        block.target[own],
    )
