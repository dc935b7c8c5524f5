"""Fitted models of accelerations alone, which know neither contacts nor forces."""

from __future__ import annotations

from abc import abstractmethod

import torch
from torch import Tensor

from forcegp.constraints import ConstrainedSystem
from forcegp.errors import ModelError
from forcegp.forces.quantities import FlatStates, flat_states
from forcegp.models.base import FittedModel, Prediction


class AccelerationFit(FittedModel):
    """Predicts accelerations of the system that it was fitted on."""

    @torch.no_grad()
    def predict(
        self,
        q: Tensor,
        qd: Tensor,
        tau: Tensor,
        quantity: str = "qdd",
        *,
        active: Tensor | None = None,
        covariance: bool = True,
        system: ConstrainedSystem | None = None,
    ) -> Prediction:
        """Mean and covariance of the accelerations; the covariance is diagonal.

        Args:
            q, qd, tau: `(*batch, nq)` states.
            quantity: `qdd`, the only one that this model knows.
            active: ignored, since the model knows no contacts.
            covariance: whether to compute the covariance, where the model has one.
            system: must be the model's own, since the model knows no forces.

        Returns:
            Mean `(*batch, nq)` and covariance `(*batch, nq, nq)`, without measurement noise.

        Raises:
            ModelError: another quantity, or another system, is asked for.
            ShapeError: a state does not fit the robot.
        """
        if quantity != "qdd":
            raise ModelError(
                f"a {self.kind!r} model predicts accelerations only",
                expected="qdd",
                got=quantity,
                hint="use StructuredGP for forces and multipliers",
            )
        if system is not None and system is not self.system:
            raise ModelError(
                f"a {self.kind!r} model knows no forces, so it cannot predict on another system",
                hint="use StructuredGP, or leave out `system`",
            )
        at = flat_states(self.system, q, qd, tau, active)
        mean, variance = self.accelerations(at, covariance)
        mean = mean.reshape(*at.batch, mean.shape[-1])
        spread = None if variance is None else torch.diag_embed(variance.reshape(mean.shape))
        return Prediction(mean, spread, {"qdd": slice(0, mean.shape[-1])})

    @abstractmethod
    def accelerations(self, at: FlatStates, variance: bool) -> tuple[Tensor, Tensor | None]:
        """Mean `(n, nq)` at states and, on request and where the model has one, variance `(n, nq)`."""
