"""A sparse posterior as named tensors, to be saved and loaded.

The eigenvectors are kept with the sums: computed anew they may differ in sign or rotation, and the sums
belong to one choice.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from forcegp.errors import ModelError
from forcegp.gp.basis import LatentBasis, ProcessBasis, Spectrum, split
from forcegp.gp.kernels import Parameters, Process, sub
from forcegp.gp.sparse import SparsePosterior
from forcegp.gp.sums import Moments

INCOMPLETE = "a saved sparse posterior is not complete"
MOMENTS = ("v", "yy", "rows", "prior", "missed")


def tensors_of_posterior(posterior: SparsePosterior) -> dict[str, Tensor]:
    """Everything but processes and hyperparameters, by name."""
    tensors = {f"moments.{name}": getattr(posterior.moments, name) for name in MOMENTS}
    tensors |= {"L": posterior.L, "jitter": torch.tensor(posterior.jitter, dtype=torch.float64)}
    tensors |= tensors_of_basis(posterior.basis)
    # A copy of its own for each, as files do not keep views.
    return {name: x.detach().clone(memory_format=torch.contiguous_format) for name, x in tensors.items()}


def tensors_of_basis(basis: LatentBasis) -> dict[str, Tensor]:
    """Inducing points and eigenvectors, by name."""
    tensors: dict[str, Tensor] = {}
    for p, part in enumerate(basis.parts):
        tensors[f"{p}.components"] = torch.tensor(part.components)
        tensors |= {f"{p}.inducing.{name}": x for name, x in part.inducing.items()}
        for k, spectrum in enumerate(part.spectra):
            tensors[f"{p}.{k}.values"], tensors[f"{p}.{k}.vectors"] = spectrum.values, spectrum.vectors
            tensors[f"{p}.{k}.dropped"] = torch.tensor(spectrum.dropped)
    return tensors


def posterior_of_tensors(
    processes: Sequence[Process], params: Parameters, tensors: Mapping[str, Tensor]
) -> SparsePosterior:
    """The posterior that `tensors_of_posterior` was given.

    Args:
        processes: the processes.
        params: log-hyperparameters.
        tensors: as given by `tensors_of_posterior`.

    Raises:
        ModelError: a tensor is missing, or does not fit the processes.
    """
    basis = basis_of_tensors(processes, params, tensors)
    try:
        moments = Moments(*(tensors[f"moments.{name}"] for name in MOMENTS))
        L, jitter = tensors["L"], float(tensors["jitter"])
    except KeyError as error:
        raise ModelError(INCOMPLETE, expected=f"a tensor {error}") from None
    size = (basis.size, basis.size)
    if L.shape != size or moments.v.shape != size[:1] or moments.prior.shape != (len(processes),):
        raise ModelError(
            "a saved sparse posterior does not fit its processes",
            expected=f"{basis.size} basis functions of {len(processes)} processes",
            got=f"{len(moments.v)} of {len(moments.prior)}",
        )
    # Files are row-major; the factor is kept column-major, as LAPACK returns it.
    return SparsePosterior(basis, moments, L.mT.contiguous().mT, jitter)


def basis_of_tensors(
    processes: Sequence[Process], params: Parameters, tensors: Mapping[str, Tensor]
) -> LatentBasis:
    """The basis that `tensors_of_basis` was given.

    Raises:
        ModelError: a tensor is missing.
    """
    try:
        parts = tuple(_part(p, process, params, tensors) for p, process in enumerate(processes))
    except KeyError as error:
        raise ModelError(INCOMPLETE, expected=f"a tensor {error}") from None
    return LatentBasis(tuple(processes), dict(params), parts)


def _part(p: int, process: Process, params: Parameters, tensors: Mapping[str, Tensor]) -> ProcessBasis:
    inducing = sub(tensors, f"{p}.inducing")
    if not inducing:
        raise KeyError(f"{p}.inducing")
    components = int(tensors[f"{p}.components"])
    spectra = ()
    if f"{p}.0.values" in tensors:
        saved = [sub(tensors, f"{p}.{k}") for k in range(components)]
        spectra = tuple(Spectrum(s["values"], s["vectors"], int(s["dropped"])) for s in saved)
    return ProcessBasis(split(process.kernel), sub(params, process.prefix), components, inducing, spectra)
