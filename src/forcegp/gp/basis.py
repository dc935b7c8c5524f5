"""Basis functions of latent components: whitened covariances with inducing points, and exact features.

Sums and products of linear kernels have a few exact features φ, with k(x, x′) = φ(x)ᵀφ(x′). The rest of a
kernel, that is, every product with a stationary factor, is approximated with inducing points Z. Let R be the
truncated square root of the inverse of their covariance, R Rᵀ = K_zz⁺. Then the weights of the features V(x)
= Rᵀk(Z, x) have a standard normal prior, and V(x)ᵀV(x′) = k(x, Z) K_zz⁺ k(Z, x′).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, reduce
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from forcegp.gp.factor import Spectrum
from forcegp.gp.features import Block, FeatureMap, Features, points, rows_mean
from forcegp.gp.kernels import Constant, Kernel, Linear, Parameters, Process, Product, Sum, sides, sub

EXACT: tuple[type[Kernel], ...] = (Linear, Constant)
"""Elementary kernels for which `draw` returns all features, whatever the requested number."""


@dataclass(frozen=True)
class KernelPart:
    """A kernel that consists of factors of another kernel, with its log-hyperparameters."""

    kernel: Kernel
    params: Parameters

    def features(self, x: Features) -> FeatureMap:
        """Return the features φ of a finite part, such that φ(x)ᵀφ(x′) equals the kernel exactly."""
        # This draw uses no random numbers, so any generator can be passed.
        return self.kernel.draw(self.params, x, 1, torch.Generator())


@dataclass(frozen=True)
class KernelSplit:
    """A kernel split into a finite part (sums and products of linear kernels) and the rest."""

    finite: KernelPart | None
    rest: KernelPart | None


def split(kernel: Kernel, params: Parameters) -> KernelSplit:
    """Split a kernel into its finite part and the rest, expanding products of sums if necessary."""
    finite, rest = _terms(KernelPart(kernel, params))
    return KernelSplit(_sum(finite), _sum(rest))


def _terms(part: KernelPart) -> tuple[list[KernelPart], list[KernelPart]]:
    """Return the terms that have finitely many features, and the other terms."""
    kernel = part.kernel
    if isinstance(kernel, EXACT):
        return [part], []
    if not isinstance(kernel, Sum):
        return [], [part]
    both = (_terms(KernelPart(side, theta)) for side, theta in kernel.parts(part.params))
    (finite_left, rest_left), (finite_right, rest_right) = both
    if not isinstance(kernel, Product):
        return finite_left + finite_right, rest_left + rest_right
    if not finite_left or not finite_right:
        return [], [part]
    finite = [_join(Product, a, b) for a in finite_left for b in finite_right]
    rest = [_join(Product, a, b) for a in finite_left for b in rest_right]
    rest += [_join(Product, a, b) for a in rest_left for b in finite_right + rest_right]
    return finite, rest


def _join(kind: type[Sum], left: KernelPart, right: KernelPart) -> KernelPart:
    return KernelPart(kind(left.kernel, right.kernel), sides(left.params, right.params))


def _sum(terms: list[KernelPart]) -> KernelPart | None:
    return reduce(lambda a, b: _join(Sum, a, b), terms) if terms else None


@dataclass(frozen=True, eq=False)
class ProcessBasis:
    """Basis functions of the components of one process.

    Attributes:
        kernel: covariance of each component.
        params: log-hyperparameters of the kernel.
        components: number of components.
        inducing: kernel inputs of the inducing points; empty if there are none.
        spectra: eigendecomposition of K_zz for each component.
    """

    kernel: Kernel
    params: dict[str, Tensor]
    components: int
    inducing: Features
    spectra: tuple[Spectrum, ...]

    def __getstate__(self) -> dict[str, Any]:
        """Return the fields without cached functions, which other processes compute anew."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @cached_property
    def split(self) -> KernelSplit:
        """The finite part and the rest of the kernel."""
        return split(self.kernel, self.params)

    @cached_property
    def roots(self) -> Tensor:
        """R of each component `(components, m, width)`, padded with zero columns to equal width."""
        kept = [spectrum.root for spectrum in self.spectra]
        most = max(R.shape[1] for R in kept)
        return torch.stack([torch.nn.functional.pad(R, (0, most - R.shape[1])) for R in kept])

    @cached_property
    def to_inducing(self) -> Callable[[Features], Tensor] | None:
        """Function x ↦ k(x, Z) `(components, n, m)` for the rest; `None` if there are no inducing points."""
        rest = self.split.rest
        if rest is None or not points(self.inducing):
            return None
        return rest.kernel.towards(rest.params, self.inducing)

    @cached_property
    def finite(self) -> FeatureMap | None:
        """The exact features of the finite part, or `None` if there is none."""
        return None if self.split.finite is None else self.split.finite.features(self.inducing)

    @cached_property
    def finite_size(self) -> int:
        """Number of exact features of each component."""
        return self.finite.basis(self.inducing).shape[-1] if self.finite is not None else 0

    @cached_property
    def used(self) -> Tensor:
        """Mask `(components, width)` of the values that are basis functions rather than padding."""
        width = (self.roots.shape[-1] if self.spectra else 0) + self.finite_size
        used = torch.ones(self.components, width, dtype=torch.bool)
        for k, spectrum in enumerate(self.spectra):
            used[k, len(spectrum.values) - spectrum.dropped : width - self.finite_size] = False
        return used

    @cached_property
    def columns(self) -> Tensor:
        """Positions of the basis functions among the values of all components."""
        device = next(iter(self.inducing.values())).device
        return self.used.reshape(-1).nonzero()[:, 0].to(device)

    def values(self, features: Features) -> tuple[Tensor, Tensor]:
        """Return V(x) `(components, n, width)`, padded with zeros, and |V|² due to the inducing points."""
        if self.to_inducing is None:
            none = next(iter(features.values())).new_zeros(self.components, points(features), 0)
            return none if self.finite is None else self.finite.basis(features), none.sum(-1)
        # V(x) = Rᵀ k(Z, x), |V|² = k(x, Z) K_zz⁻¹ k(Z, x)
        whitened = self.to_inducing(features) @ self.roots
        explained = torch.linalg.vecdot(whitened, whitened)
        if self.finite is None:
            return whitened, explained
        return torch.cat([whitened, self.finite.basis(features)], dim=-1), explained

    def rows(self, W: Tensor, values: Tensor) -> Tensor:
        """Return the rows W_i V_iᵀ of n samples, in terms of the basis functions, `(n d, Σ sizes)`.

        Args:
            W: operators `(n, d, components)`.
            values: V at the samples, as returned by `values`.
        """
        # Φ_i = W_i V_iᵀ
        whole = W[..., None] * values.transpose(0, 1)[:, None]
        whole = whole.reshape(W.shape[0] * W.shape[1], self.used.numel())
        return whole if bool(self.used.all()) else whole.index_select(1, self.columns)

    def fold(self, weights: Tensor) -> tuple[Tensor, Tensor]:
        """Convert weights of basis functions to weights of k(x, Z) and of the exact features.

        Args:
            weights: weights `(Σ sizes, s)` of the basis functions of this process.

        Returns:
            Weights `(components, m, s)` and `(components, features, s)`.
        """
        filled = weights.new_zeros(self.used.numel(), weights.shape[1])
        filled[self.columns] = weights
        filled = filled.unflatten(0, self.used.shape)
        width = filled.shape[1] - self.finite_size
        # V(x)ᵀ w = k(x, Z) (R w)
        on_kernel = self.roots @ filled[:, :width] if self.spectra else filled[:, :0]
        return on_kernel, filled[:, width:]

    def mean(self, features: Features, folded: tuple[Tensor, Tensor]) -> Tensor:
        """Return V(x)ᵀ w `(n, components)` for weights that `fold` has converted."""
        on_kernel, on_features = folded
        mean = on_kernel.new_zeros(self.components, points(features), 1)
        if self.to_inducing is not None:
            mean = self.to_inducing(features) @ on_kernel
        if self.finite is not None:
            mean = mean + self.finite.basis(features) @ on_features
        return mean[..., 0].mT

    def missed(self, variance: Tensor, explained: Tensor) -> Tensor:
        """Return the residual variance k(x, x) − |V(x)|² ≥ 0 of the approximated part, `(components, n)`.

        Negative values, which are rounding errors, are set to zero.
        """
        return (variance - explained).clamp(min=0.0)

    @cached_property
    def rest_variance(self) -> Callable[[Features], Tensor]:
        """Function that maps x to the prior variance `(components, n)` of the approximated part."""
        rest = self.split.rest
        if rest is None:
            return lambda x: next(iter(x.values())).new_zeros(self.components, points(x))
        return rest.kernel.variance(rest.params)


@dataclass(frozen=True, eq=False)
class LatentBasis:
    """Concatenated basis functions of all components of all processes.

    Attributes:
        processes: the processes.
        params: all log-hyperparameters.
        parts: basis functions of each process.
    """

    processes: tuple[Process, ...]
    params: dict[str, Tensor]
    parts: tuple[ProcessBasis, ...]

    @cached_property
    def columns(self) -> tuple[slice, ...]:
        """Positions of the basis functions of each component, in the order of the processes."""
        sizes = [size for part in self.parts for size in part.used.sum(-1).tolist()]
        ends = torch.tensor([0, *sizes]).cumsum(0).tolist()
        return tuple(slice(a, b) for a, b in pairwise(ends))

    @cached_property
    def components(self) -> tuple[slice, ...]:
        """Positions of each process's components among all components."""
        ends = torch.tensor([0, *(part.components for part in self.parts)]).cumsum(0).tolist()
        return tuple(slice(a, b) for a, b in pairwise(ends))

    @cached_property
    def size(self) -> int:
        """Total number of basis functions."""
        return self.columns[-1].stop

    def tensors(self) -> dict[str, Tensor]:
        """Return the inducing points and eigenvectors, keyed by name.

        Eigenvectors are saved with the sums, since recomputed ones may differ in sign or by a rotation.
        """
        tensors: dict[str, Tensor] = {}
        for p, part in enumerate(self.parts):
            tensors[f"{p}.components"] = torch.tensor(part.components)
            tensors |= {f"{p}.inducing.{name}": x for name, x in part.inducing.items()}
            for k, spectrum in enumerate(part.spectra):
                tensors[f"{p}.{k}.values"], tensors[f"{p}.{k}.vectors"] = spectrum.values, spectrum.vectors
                tensors[f"{p}.{k}.dropped"] = torch.tensor(spectrum.dropped)
        return tensors

    @classmethod
    def of_tensors(
        cls, processes: Sequence[Process], params: Parameters, tensors: Mapping[str, Tensor]
    ) -> LatentBasis:
        """Restore a basis from `tensors`.

        Raises:
            KeyError: a tensor is missing.
        """
        parts = []
        for p, process in enumerate(processes):
            inducing, components = sub(tensors, f"{p}.inducing"), int(tensors[f"{p}.components"])
            if not inducing:
                raise KeyError(f"{p}.inducing")
            saved = [sub(tensors, f"{p}.{k}") for k in range(components if f"{p}.0.values" in tensors else 0)]
            spectra = tuple(Spectrum(s["values"], s["vectors"], int(s["dropped"])) for s in saved)
            process_params = sub(params, process.prefix)
            parts.append(ProcessBasis(process.kernel, process_params, components, inducing, spectra))
        return cls(tuple(processes), dict(params), tuple(parts))

    def of_process(self, p: int) -> slice:
        """Return the positions of the basis functions of process p."""
        slices = self.columns[self.components[p]]
        return slice(slices[0].start, slices[-1].stop)

    def mean(self, block: Block, weights: Tensor) -> Tensor:
        """Return Φ w `(n, r)` for weights w `(size,)`, without Φ."""
        each = [part.fold(weights[self.of_process(p), None]) for p, part in enumerate(self.parts)]
        return rows_mean(lambda p, features: self.parts[p].mean(features, each[p]), block)

    def rows(self, block: Block) -> Tensor:
        """Express the rows of a block in terms of the basis functions, Φ `(n r, size)`."""
        each = zip(self.parts, block.operators, block.features, strict=True)
        return torch.cat([part.rows(W, part.values(x)[0]) for part, W, x in each], dim=-1)


def latent_basis(
    processes: Sequence[Process], params: Parameters, inducing: Sequence[Features], components: Sequence[int]
) -> LatentBasis:
    """Return the basis functions of processes with given inducing points.

    Args:
        inducing: kernel inputs of the inducing points for each process; there may be none.
        components: number of components of each process.
    """
    parts = []
    for process, Z, count in zip(processes, inducing, components, strict=True):
        part = ProcessBasis(process.kernel, sub(params, process.prefix), count, Z, ())
        if (rest := part.split.rest) is not None and points(Z):
            # K_zz = U Λ Uᵀ
            K = rest.kernel.covariance(rest.params, Z, Z)
            part = replace(part, spectra=tuple(Spectrum.of(0.5 * (k + k.mT)) for k in K))
        parts.append(part)
    return LatentBasis(tuple(processes), dict(params), tuple(parts))
