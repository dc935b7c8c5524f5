"""Named kernel inputs, rows of samples, and feature maps φ(x) of kernels and random functions.

With unit noise variance, entries of the covariance K of whitened rows have rounding errors of about ε K_ii
with ε = 2.2e-16. Relative errors of standard deviations are thus about ε K_ii, or ε/r if data reduce a prior
variance to a fraction r. Compared with 80-bit results, they are 0.1 % at K_ii = 1e12, 0.5 % at r = 1e-13.
Variances of exact features are sums of squares, which do not cancel: 2e-15 at r = 1e-13.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from forcegp.errors import NumericalError, UnknownNameError

FLOOR = 0.01
"""Smallest scale of a column, relative to the typical scale of its input. Motions through the workspace have
larger values (0.034 for the torque of an arm's joint 5), and drift causes smaller ones."""
PRIOR_TO_NOISE = 1e6
"""Largest prior standard deviation of a row, in units of its noise."""
SMALLEST_FRACTION = 1e-13
"""Smallest ratio of posterior to prior variance that double precision resolves."""
Features = Mapping[str, Tensor]
"""Named kernel inputs: `(n, w)` if shared by all components, or `(n, k, w)` with one row per component."""


def stacked(x: Features, inputs: tuple[str, ...] | None) -> Tensor:
    """Concatenate the named features to shape `(n, w)`, or `(k, n, w)` if inputs differ between components.

    Raises:
        UnknownNameError: a feature is missing.
    """
    names = tuple(x) if inputs is None else inputs
    for name in names:
        if name not in x:
            raise UnknownNameError("kernel input", name, x)
    parts = [x[name] for name in names]
    if all(part.ndim == 2 for part in parts):
        return torch.cat(parts, dim=-1)
    k = next(part.shape[1] for part in parts if part.ndim == 3)
    wide = [part if part.ndim == 3 else part[:, None].expand(-1, k, -1) for part in parts]
    return torch.cat(wide, dim=-1).transpose(0, 1)


@dataclass(frozen=True)
class Standardization:
    """Shift and scale of each named input, x ↦ (x − mean)/std, determined from training data.

    The scale of a nearly constant column is not meaningful. Scales are therefore at least `FLOOR` times the
    root mean square of the standard deviations of all columns of the input. This root mean square is the
    common scale of the columns of a vector, so results barely depend on the orientation of the axes. Features
    with a meaningful zero, such as velocities, are scaled but not shifted.

    Columns that are constant up to rounding error have scale 1 (or that of their vector); see `constant`.
    """

    mean: Mapping[str, Tensor]
    std: Mapping[str, Tensor]
    constant: tuple[str, ...] = ()

    @classmethod
    def of(
        cls, features: Mapping[str, Tensor], vectors: Collection[str] = (), centred: bool = True
    ) -> Standardization:
        """Compute the mean and standard deviation of each column, or its root mean square if not centred.

        Args:
            features: named inputs `(n, w)`.
            vectors: names of the inputs that are vectors, whose columns are components.
            centred: whether to subtract the mean.
        """
        mean = {name: x.mean(0) if centred else torch.zeros_like(x[0]) for name, x in features.items()}
        std, constant = {}, []
        for name, x in features.items():
            spread = (x - mean[name]).square().mean(0).sqrt()
            fixed = spread <= 1e-12 * (1.0 + mean[name].abs())
            constant += [f"{name}[{i}]" for i in fixed.nonzero()[:, 0].tolist()]
            whole = spread.square().mean().sqrt()
            if name in vectors and not bool(fixed.all()):
                std[name] = whole.expand_as(spread).clone()
            else:
                std[name] = torch.where(fixed, 1.0, spread.clamp(min=FLOOR * whole))
        return cls(mean, std, tuple(constant))

    @classmethod
    def none(cls, features: Mapping[str, Tensor]) -> Standardization:
        """Return a standardization that leaves the inputs unchanged."""
        zero = {name: torch.zeros_like(x[0]) for name, x in features.items()}
        return cls(zero, {name: torch.ones_like(x) for name, x in zero.items()})

    def apply(self, features: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the standardized features."""
        return {name: (x - self.mean[name]) / self.std[name] for name, x in features.items()}


@dataclass(frozen=True)
class Block:
    """Samples with the same number of rows.

    Attributes:
        features: standardized kernel inputs `(n, w)` for each prior, keyed by name.
        operators: operator W `(n, r, components)` for each prior; one tensor if those of several are equal.
        target: whitened residual `(n, r)`.
    """

    features: tuple[Features, ...]
    operators: tuple[Tensor, ...]
    target: Tensor

    @property
    def rows(self) -> int:
        """Number of rows, n r."""
        return self.target.numel()

    def mapped(self, change: Callable[[Tensor], Tensor]) -> Block:
        """Return the block with changed operators and targets. Equal operators remain the same tensor."""
        changed = {id(W): change(W) for W in self.operators}
        return Block(self.features, tuple(changed[id(W)] for W in self.operators), change(self.target))


def points(features: Features) -> int:
    """Return the number of points in a dictionary of features."""
    return len(next(iter(features.values())))


def components_of(block: Block) -> list[int]:
    """Return the number of components of each process."""
    return [W.shape[-1] for W in block.operators]


def chunked(blocks: Iterable[Block], samples: int) -> Iterator[Block]:
    """Split blocks so that none exceeds a maximum number of samples."""
    for block in blocks:
        for first in range(0, len(block.target), samples):
            yield rows_of(block, slice(first, first + samples))


def rows_of(block: Block, index: slice | Tensor) -> Block:
    """Return the given samples of a block."""
    features = tuple({name: x[index] for name, x in f.items()} for f in block.features)
    return replace(block.mapped(lambda rows: rows[index]), features=features)


def rows_mean(latent_mean: Callable[[int, Features], Tensor], block: Block) -> Tensor:
    """Return the mean Σ_p W_p μ_p of the rows of each sample of a block, `(n, d)` (eq. 23).

    Args:
        latent_mean: function that returns μ_p `(n, components)` of process p at kernel inputs.
        block: samples; their targets are not used.
    """
    mean = torch.zeros_like(block.target)
    for p, (W, x) in enumerate(zip(block.operators, block.features, strict=True)):
        mean = mean + (W @ latent_mean(p, x)[..., None])[..., 0]
    return mean


Basis = Callable[[Features], Tensor]
"""Function x ↦ φ(x) `(k, n, f)`, or `(1, n, f)` if the features are common to all components."""


@dataclass(frozen=True, eq=False)
class FeatureTerm:
    """Features a_kf φ_f(x) of k components; the functions φ are often common to all components.

    Attributes:
        values: φ.
        scale: a `(k, f)`.
        waves: inputs, frequencies and phases if the functions are cosines, as in `fourier_features`.
    """

    values: Basis
    scale: Tensor
    waves: tuple[tuple[str, ...] | None, Tensor, Tensor] | None = None


@dataclass(frozen=True, eq=False)
class FeatureMap:
    """Concatenated terms φ(x) of a function f(x) = φ(x)ᵀw with w ~ N(0, I) and E[φ(x)ᵀφ(x′)] = k(x, x′).

    Attributes:
        terms: groups of features.
    """

    terms: tuple[FeatureTerm, ...]

    def basis(self, x: Features) -> Tensor:
        """Return φ(x) `(k, n, features)`."""
        parts = [term.scale[:, None] * term.values(x) for term in self.terms]
        return parts[0] if len(parts) == 1 else torch.cat(parts, dim=-1)

    def weighted(self, weights: Tensor) -> list[tuple[Basis, Tensor]]:
        """Return φ(x)ᵀw as weighted functions, given w `(k, features, samples)`."""
        parts = weights.split([term.scale.shape[-1] for term in self.terms], dim=1)
        pairs = zip(self.terms, parts, strict=True)
        return [(term.values, term.scale[..., None] * w) for term, w in pairs]

    def joined(self) -> FeatureTerm:
        """Combine all features into one term."""
        if len(self.terms) == 1:
            return self.terms[0]

        def values(x: Features) -> Tensor:
            parts = [term.values(x) for term in self.terms]
            most = max(map(len, parts))
            return torch.cat([part.expand(most, -1, -1) for part in parts], dim=-1)

        return FeatureTerm(values, torch.cat([term.scale for term in self.terms], dim=-1))

    def __add__(self, other: FeatureMap) -> FeatureMap:
        """Return the features of both maps, which represent the sum of two kernels."""
        return FeatureMap((*self.terms, *other.terms))

    def __mul__(self, other: FeatureMap) -> FeatureMap:
        """Return all pairs of features, which represent the product of two kernels."""
        a, b = self.joined(), other.joined()
        scale = (a.scale[:, :, None] * b.scale[:, None, :]).flatten(-2)

        def products(x: Features) -> Tensor:
            return (a.values(x)[..., :, None] * b.values(x)[..., None, :]).flatten(-2)

        return FeatureMap((FeatureTerm(products, scale),))

    def paired(self, other: FeatureMap, count: int, generator: torch.Generator) -> FeatureMap:
        """Return `count` random pairs of features, for the product of two kernels with many features each."""
        a, b = self.joined(), other.joined()
        sizes = a.scale.shape[-1], b.scale.shape[-1]
        pairs = torch.Generator().manual_seed(int(torch.randint(2**31, (1,), generator=generator)))
        i, j = (torch.randint(n, (count,), generator=pairs).to(a.scale.device) for n in sizes)
        scale = math.sqrt(sizes[0] * sizes[1] / count) * a.scale[:, i] * b.scale[:, j]
        return FeatureMap((FeatureTerm(lambda x: a.values(x)[..., i] * b.values(x)[..., j], scale),))


def require_resolved_noise(prior: Tensor) -> None:
    """Reject a prior whose variance is so large that double precision cannot resolve the noise.

    Args:
        prior: prior variance of a row, in units of the noise variance `()`.

    Raises:
        NumericalError: the prior exceeds `PRIOR_TO_NOISE` squared.
    """
    ratio = math.sqrt(float(prior))
    if ratio > PRIOR_TO_NOISE:
        raise NumericalError(
            "double precision does not resolve the noise relative to the prior",
            expected=f"a prior standard deviation at most {PRIOR_TO_NOISE:g} times that of the noise",
            got=f"{ratio:.3g} times",
            hint=f"remove outliers, or specify a noise at least {ratio / PRIOR_TO_NOISE:.2g} times as large",
        )


def require_resolved_variance(covariance: Tensor, prior: Tensor) -> Tensor:
    """Return a posterior covariance `(n, d, d)` after checking that rounding errors do not dominate it.

    Args:
        covariance: covariance of the rows of each sample.
        prior: prior variance of each row `(n, d)`.

    Raises:
        NumericalError: rounding errors dominate a variance.
    """
    variance = covariance.diagonal(dim1=-2, dim2=-1)
    lost = variance < SMALLEST_FRACTION * prior
    if bool(lost.any()):
        least = float((variance[lost] / prior[lost]).min())
        raise NumericalError(
            f"double precision does not resolve {int(lost.sum())} of {lost.numel()} predicted variances",
            expected=f"at least {SMALLEST_FRACTION:g} of the prior variance",
            got=f"{least:.2g} of it",
            hint="specify a larger noise, or remove outliers, which make the prior large",
        )
    return covariance


def fourier_features(inputs: tuple[str, ...] | None, omega: Tensor, phase: Tensor, std: Tensor) -> FeatureMap:
    """Return the random Fourier features σ √(2/F) cos(ωᵀx + φ) of a stationary kernel.

    Args:
        inputs: names of the inputs; `None` for all.
        omega: frequencies ω `(k, F, w)`, or `(1, F, w)` if they are common to all components.
        phase: phases φ `(k, F)` or `(1, F)`.
        std: standard deviations σ `(k,)`.
    """
    count = phase.shape[-1]
    scale = (math.sqrt(2.0 / count) * std)[:, None].expand(-1, count)
    turn, shift = omega.mT, phase[:, None, :]
    waves = inputs, omega, phase
    return FeatureMap((FeatureTerm(lambda x: torch.cos(stacked(x, inputs) @ turn + shift), scale, waves),))


def linear_features(
    x: Features, inputs: tuple[str, ...] | None, slope: Tensor, bias: Tensor | None = None
) -> FeatureMap:
    """Return the features of a linear kernel, which are slopes and, if given, a bias.

    Args:
        x: kernel inputs; only their widths are used.
        inputs: names of the inputs; `None` for all.
        slope: standard deviation of each slope `(k, w)`, or of all slopes `(k, 1)`.
        bias: standard deviation of the bias `(k,)`.
    """

    def values(x: Features) -> Tensor:
        line = stacked(x, inputs)
        line = line if line.ndim == 3 else line[None]
        return line if bias is None else torch.cat([line, line.new_ones(*line.shape[:2], 1)], dim=-1)

    scale = slope.expand(-1, stacked(x, inputs).shape[-1])
    scale = scale if bias is None else torch.cat([scale, bias[:, None]], dim=-1)
    return FeatureMap((FeatureTerm(values, scale),))


def constant_features(std: Tensor) -> FeatureMap:
    """Return one constant feature per component, with standard deviations `(k,)`."""
    return FeatureMap((FeatureTerm(lambda x: std.new_ones(1, stacked(x, None).shape[-2], 1), std[:, None]),))
