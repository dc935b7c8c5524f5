"""The collapsed variational bound on the likelihood of whitened rows, with its gradient in closed form.

−F = ½ [Σ y² − vᵀA⁻¹v + log|A| + rows log 2π + Σ tr W(k − VᵀV)Wᵀ] (Titsias 2009). The samples are passed
over twice, once for the sums and once for the gradient, in memory that does not grow with their number.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property

import torch
from torch import Tensor

from forcegp.gp.basis import ProcessBasis, latent_basis, split
from forcegp.gp.features import Block, Features, components_of, rows_of
from forcegp.gp.kernels import Parameters, Process
from forcegp.gp.likelihood import Gradient, Valued, with_gradient
from forcegp.gp.sparse import SparsePosterior
from forcegp.gp.sums import CHUNK_SAMPLES, Moments, accumulate, normal_terms


def bound_of(sums: Moments, posterior: SparsePosterior) -> Tensor:
    """The negative bound from the sums `()`."""
    # −F = ½ [Σ y² − vᵀA⁻¹v + log|A| + rows log 2π + Σ tr W(k − VᵀV)Wᵀ], log|A| = 2 Σ log L_ii
    fit = sums.yy - sums.v @ posterior.weights
    log_determinant = 2.0 * posterior.L.diagonal().abs().log().sum()
    return 0.5 * (fit + log_determinant + sums.rows * math.log(2.0 * math.pi) + sums.missed.sum())


def negative_bound(
    processes: Sequence[Process], params: Parameters, blocks: Sequence[Block], inducing: Sequence[Features]
) -> Tensor:
    """Negative collapsed bound, differentiable in hyperparameters, kernel inputs, operators and targets.

    It is no smaller than the exact negative log likelihood, and equals it where inducing points are the data.
    The inducing points are constants.

    Args:
        processes: the processes.
        params: log-hyperparameters, `<process>.<name>`.
        blocks: whitened rows.
        inducing: kernel inputs of the inducing points of each process.

    Returns:
        The scalar.

    Raises:
        NumericalError: the sums are not finite.
    """

    def value(params: Parameters, blocks: Sequence[Block]) -> Valued:
        basis = latent_basis(processes, params, inducing, components_of(blocks[0]))
        sums = accumulate(basis, blocks)
        posterior = SparsePosterior.of(basis, sums)
        return bound_of(sums, posterior), lambda deep: _BoundGradient(posterior, deep).over(blocks)

    return with_gradient(value, params, blocks)


class _BoundGradient:
    """Derivatives of the negative bound, added up chunk by chunk.

    With D = ½(A⁻¹ + mmᵀ) the derivative for V_k of one sample is 2 Σ_l S_kl D_kl V_l − m_k c_k − S_kk V_k,
    and that for S_kl is V_kᵀD_kl V_l + ½ δ_kl (k − |V|²).
    """

    def __init__(self, posterior: SparsePosterior, deep: bool) -> None:
        self.basis, self.deep = posterior.basis, deep
        # m = A⁻¹v, D = ½ (A⁻¹ + m mᵀ)
        self.m = posterior.weights
        self.D = 0.5 * torch.addr(torch.cholesky_inverse(posterior.L), self.m, self.m)
        self.total: Gradient = {}
        # By process, Σ k(Z, x) ∂F/∂V `(components, m, kept)`: the derivative for R.
        self.roots = [
            torch.zeros_like(part.roots) if part.spectra else self.m[:0] for part in self.basis.parts
        ]

    def over(self, blocks: Sequence[Block]) -> Gradient:
        """The derivatives over all samples."""
        for g, block in enumerate(blocks):
            chunks = []
            for first in range(0, len(block.target), CHUNK_SAMPLES):
                chunks.append(self._chunk(rows_of(block, slice(first, first + CHUNK_SAMPLES))))
            if self.deep and chunks:
                for place in chunks[0]:
                    self.total[(place[0], g, *place[1:])] = torch.cat([chunk[place] for chunk in chunks])
        for part, prior, dR in zip(self.basis.parts, self.basis.processes, self.roots, strict=True):
            if part.spectra:
                self._through_inducing(part, prior.prefix, dR)
        return self.total

    def _chunk(self, block: Block) -> Gradient:
        """Add the derivatives for hyperparameters; return those for the block's own tensors."""
        V, _, missed = self.basis.evaluate(block.features)
        W, S, c = normal_terms(block)
        gradient: Gradient = {}
        dV = self._basis_gradient(V, S, c)
        if self.deep:
            # dS_kl = V_kᵀ D_kl V_l + ½ δ_kl (k − |V|²), dc_k = −m_kᵀ V_k
            columns = self.basis.columns
            dS = torch.stack([self._by_component(V * (V[:, l] @ self.D[l])) for l in columns], dim=-1)
            dS = 0.5 * (dS + dS.mT) + 0.5 * torch.diag_embed(missed)
            dc = -self._by_component(V * self.m)
            # dW = 2 W dS + y dcᵀ, dy = y + W dc
            dW = 2.0 * W @ dS + block.target[..., None] * dc[:, None, :]
            for p, components in enumerate(self.basis.components):
                gradient["operator", p] = dW[..., components]
            gradient["target",] = block.target + (W @ dc[..., None])[..., 0]
        weight = torch.diagonal(S, dim1=0, dim2=1)
        for p in range(len(self.basis.parts)):
            gradient |= self._through_kernel(p, block.features[p], dV, 0.5 * weight)
        return gradient

    def _basis_gradient(self, V: Tensor, S: Tensor, c: Tensor) -> Tensor:
        """Derivative for V `(n, size)`."""
        # dV_k = 2 Σ_l S_kl D_kl V_l − m_k c_k − S_kk V_k
        owner, columns = self.basis.owner, self.basis.columns
        weight = torch.diagonal(S, dim1=0, dim2=1)
        dV = torch.addcmul(-self.m * c[:, owner], V * self.from_inducing, weight[:, owner], value=-1.0)
        twice, weighted = 2.0 * S, torch.empty_like(V)
        for k, of_k in enumerate(columns):
            for l, of_l in enumerate(columns):
                torch.mul(V[:, of_l], twice[k, l, :, None], out=weighted[:, of_l])
            dV[:, of_k].addmm_(weighted, self.D[:, of_k])
        return dV

    @cached_property
    def from_inducing(self) -> Tensor:
        """1 for basis functions of inducing points, whose squares are missed no more, else 0 `(size,)`."""
        chosen = []
        for part in self.basis.parts:
            position = part.columns % max(part.used.shape[1], 1)
            chosen.append(position < part.used.shape[1] - part.finite_size)
        return torch.cat(chosen).to(self.m)

    def _by_component(self, x: Tensor) -> Tensor:
        """Sums over the basis functions of each component, `(n, components)`."""
        return x.new_zeros(len(x), len(self.basis.columns)).index_add_(1, self.basis.owner, x)

    def _through_kernel(self, p: int, features: Features, dV: Tensor, weight: Tensor) -> Gradient:
        """Derivatives of one chunk through k(x, Z), φ(x) and k(x, x)."""
        part, prefix = self.basis.parts[p], self.basis.processes[p].prefix
        filled = dV.new_zeros(len(dV), part.used.numel())
        filled.index_copy_(1, part.columns, dV[:, self.basis.of_process(p)])
        filled = filled.unflatten(1, part.used.shape).transpose(0, 1)
        width = filled.shape[-1] - part.finite_size
        params, x = _leaves(part.params), _leaves(features, self.deep)
        outputs, gradients = [], []
        with torch.enable_grad():
            kernels = split(part.kernel, params)
            if (rest := kernels.rest) is not None:
                # d k(x, x) = ½ S_kk
                outputs.append(rest.kernel.diagonal(rest.params, x))
                gradients.append(weight[:, self.basis.components[p]].mT)
                if part.spectra:
                    # V = k(x, Z) R: dR += k(Z, x) dV, dk(x, Z) = dV Rᵀ
                    kernel = rest.kernel.covariance(rest.params, x, part.inducing)
                    self.roots[p] = self.roots[p] + kernel.detach().mT @ filled[..., :width]
                    outputs.append(kernel)
                    gradients.append(filled[..., :width] @ part.roots.mT)
            if kernels.finite is not None:
                outputs.append(kernels.finite.features(part.inducing).basis(x))
                gradients.append(filled[..., width:])
        return self._add(prefix, params, x if self.deep else {}, outputs, gradients, p)

    def _add(
        self,
        prefix: str,
        params: dict[str, Tensor],
        x: dict[str, Tensor],
        outputs: list[Tensor],
        gradients: list[Tensor],
        p: int = 0,
    ) -> Gradient:
        """Add what arrives at hyperparameters; return what arrives at kernel inputs."""
        leaves = {("param", f"{prefix}.{key}"): value for key, value in params.items()}
        leaves |= {("feature", p, key): value for key, value in x.items()}
        inputs = list(leaves.values())
        grads = torch.autograd.grad(outputs, inputs, gradients, allow_unused=True, materialize_grads=True)
        found = dict(zip(leaves, grads, strict=True))
        for place in [place for place in found if place[0] == "param"]:
            value = found.pop(place)
            self.total[place] = self.total[place] + value if place in self.total else value
        return found

    def _through_inducing(self, part: ProcessBasis, prefix: str, dR: Tensor) -> None:
        """Derivatives through K_zz."""
        params = _leaves(part.params)
        with torch.enable_grad():
            rest = split(part.kernel, params).rest
            assert rest is not None
            K = rest.kernel.covariance(rest.params, part.inducing, part.inducing)
        dK = torch.stack([s.pull_back(d) for s, d in zip(part.spectra, dR, strict=True)])
        self._add(prefix, params, {}, [K], [dK])


def _leaves(tensors: Parameters, requires_grad: bool = True) -> dict[str, Tensor]:
    return {key: value.detach().requires_grad_(requires_grad) for key, value in tensors.items()}
