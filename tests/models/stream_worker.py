"""What each process of the test of a distributed fit does."""

from __future__ import annotations

from pathlib import Path

import torch
import torch.distributed as dist
from safetensors.torch import save_file

import forcegp
from forcegp.data import stream
from forcegp.forces.priors.joint import JointFrictionPrior
from forces.cases import two_contacts

PIECE = 16


def model(inference: str = "sparse") -> forcegp.StructuredGP:
    """A model with finite priors, whose fits are exact and fast."""
    return forcegp.StructuredGP(
        two_contacts(),
        "analytical",
        [JointFrictionPrior()],
        noise=forcegp.Noise(acceleration=0.1, torque=0.2),
        inference=inference,
    )


def run(rank: int, processes: int, folder: str) -> None:
    """Fit to the pieces of this process, and write the posterior that all of them share."""
    torch.set_num_threads(1)
    stream.PIECE_ROWS = PIECE
    store = Path(folder) / "store"
    dist.init_process_group("gloo", init_method=store.as_uri(), rank=rank, world_size=processes)
    log = forcegp.StreamedDataset((Path(folder) / "log.parquet",), distributed=True)
    fit = model().fit(log, learn=[])
    latent = fit.posterior.latent
    likelihood = torch.tensor(fit.log_marginal_likelihood, dtype=torch.float64)
    save_file({"weights": latent.weights, "likelihood": likelihood}, Path(folder) / f"{rank}.safetensors")  # type: ignore[attr-defined]
    dist.destroy_process_group()
