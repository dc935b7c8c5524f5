"""What each process of the test of a distributed fit does."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist
from safetensors.torch import save_file

import forcegp
from forcegp.data import stream
from forcegp.errors import ModelError
from forcegp.forces.priors.joint import JointFrictionPrior
from forcegp.forces.problem import Totals, total_over
from forcegp.models import structured_stream
from forcegp.storage import checkpoint as checkpoints
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


def stopped(inner: Callable[..., object], *args: Any) -> object:
    """A pass that is interrupted after its second piece."""

    def after(total: Totals) -> None:
        args[-1](total)
        if total.pieces == 2:
            raise KeyboardInterrupt

    return inner(*args[:-1], after)


def run(rank: int, processes: int, folder: str, stops: bool = False) -> None:
    """Fit to the pieces of this process, and write the posterior that all of them share, or the error."""
    torch.set_num_threads(1)
    stream.PIECE_ROWS, checkpoints.INTERVAL = PIECE, 0.0
    store = Path(folder) / "store"
    dist.init_process_group("gloo", init_method=store.as_uri(), rank=rank, world_size=processes)
    own = Path(folder) / f"log.{rank}.parquet"
    log = forcegp.StreamedDataset((own if own.exists() else Path(folder) / "log.parquet",), distributed=True)
    checkpoint = Path(folder) / "fit.part" if (Path(folder) / "recorded").exists() else None
    structured_stream.total_over = partial(stopped, total_over) if stops else total_over
    try:
        fit = model().fit(log, learn=[], checkpoint=checkpoint)
    except (ModelError, KeyboardInterrupt) as error:
        (Path(folder) / f"{rank}.error").write_text(str(error))
        dist.destroy_process_group()
        return
    latent = fit.posterior.latent
    likelihood = torch.tensor(fit.result.log_marginal_likelihood, dtype=torch.float64)
    save_file({"weights": latent.weights, "likelihood": likelihood}, Path(folder) / f"{rank}.safetensors")  # type: ignore[attr-defined]
    dist.destroy_process_group()
