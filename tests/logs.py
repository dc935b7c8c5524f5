"""Random logs for tests of the data layer."""

from __future__ import annotations

import torch

from forcegp.data import DataHeader, Dataset

JOINTS = ("shoulder", "elbow", "wrist")


def random_log(n: int = 60, joints: tuple[str, ...] = JOINTS, seed: int = 0, segments: int = 1) -> Dataset:
    """A log of random numbers with one contact and every kind of column."""
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, dtype=torch.float64, generator=generator)

    nq = len(joints)
    return Dataset(
        t=torch.arange(n, dtype=torch.float64) / 240.0,
        q=draw(n, nq),
        qd=draw(n, nq),
        tau=draw(n, nq),
        qdd=draw(n, nq),
        joint_names=joints,
        contact={"table": draw(n) > 0.0},
        extras={"Q_z": draw(n, nq)},
        contact_extras={"multiplier": {"table": draw(n)}, "F_I": {"table": draw(n, 3)}},
        segment=torch.arange(n) * segments // n,
        header=DataHeader(dt=1.0 / 240.0, noise_std=0.1, robot="arm", seed=seed, provenance=("drawn",)),
    )
