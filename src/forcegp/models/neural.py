"""The neural-network baseline: sigmoid layers from (q, q̇, τ) to q̈, blind to mechanics (section 5.4)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path

import torch
from torch import Tensor, nn

from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset
from forcegp.errors import ModelError
from forcegp.forces.measurements import Observation, measurement_of
from forcegp.gp.standardization import Standardization
from forcegp.models.base import FitProgress, FitResult, Model, Prediction, not_fitted, only_qdd
from forcegp.models.flat import flat_states
from forcegp.models.minibatch import BatchOptions, train

PAPER_ARCHITECTURES: tuple[tuple[int, ...], ...] = ((80,), (30, 20), (200, 200, 200, 200))
"""Widths of the hidden layers of the three networks of the paper."""
SHALLOW = BatchOptions(epochs=3000, batch=1024, learning_rate=0.03, patience=300)
DEEP = BatchOptions(epochs=300, batch=256, learning_rate=0.003)
"""For networks of more than two hidden layers, whose epochs take longer and whose steps must be smaller."""


class NeuralNetwork(Model):
    """A feed-forward network with sigmoid layers on standardized (q, q̇, τ), trained by mean squared error.

    Contacts are not an input, and there is no covariance.

    Args:
        system: robot and contacts; the contacts serve to evaluate the model, not to learn it.
        hidden: widths of the hidden layers.
        seed: of the initial weights, the held-out samples and the order of the batches.

    Raises:
        ModelError: a width is not positive.
    """

    kind = "neural_network"

    def __init__(self, system: ConstrainedSystem, hidden: Sequence[int] = (80,), seed: int = 0) -> None:
        if any(width < 1 for width in hidden):
            raise ModelError("a hidden layer needs at least one unit", got=tuple(hidden))
        self.system = system
        self.hidden = tuple(hidden)
        self.seed = seed
        self.network = _network(system, self.hidden)
        self.inputs: Standardization | None = None
        self.outputs: Standardization | None = None

    def fit(
        self,
        data: Dataset,
        *,
        options: BatchOptions | None = None,
        progress: FitProgress | None = None,
    ) -> FitResult:
        """Train with ADAM on batches; the weights of the best epoch on held-out samples are kept.

        Args:
            data: states and measured accelerations.
            options: how to train; `SHALLOW` or `DEEP` by default.
            progress: called after each epoch.

        Returns:
            The epochs as `evaluations`, and the held-out error of standardized accelerations.

        Raises:
            ModelError, DataError: the data do not fit the model.
            NumericalError: training diverges.
        """
        measured, _ = measurement_of(Observation(data, noise_std=1.0), self.system, 1.0)
        states = {"q": measured.q, "qd": measured.qd, "tau": measured.tau}
        inputs, outputs = Standardization.of(states), Standardization.of({"qdd": measured.values})
        x, y = _stacked(inputs, states), outputs.apply({"qdd": measured.values})["qdd"]
        generator = torch.Generator().manual_seed(self.seed)
        network = _network(self.system, self.hidden)
        _initialise(network, generator)

        def loss(tensors: Mapping[str, Tensor], rows: Tensor) -> Tensor:
            predicted = torch.func.functional_call(network, dict(tensors), (x[rows],))
            return nn.functional.mse_loss(predicted, y[rows])

        options = options or (DEEP if len(self.hidden) > 2 else SHALLOW)
        start = dict(network.named_parameters())
        learned = train(loss, start, len(x), options, generator, progress)
        network.load_state_dict(learned.tensors)
        self.adopt(network, inputs, outputs)
        return FitResult(
            converged=learned.converged,
            evaluations=learned.evaluations,
            seconds=learned.seconds,
            objective=learned.value,
            constant_inputs=inputs.constant,
            message=learned.message,
            history=tuple(learned.history),
        )

    def adopt(self, network: nn.Sequential, inputs: Standardization, outputs: Standardization) -> None:
        """Predict with given weights and standardizations from now on."""
        self.network = network.requires_grad_(False)
        self.inputs, self.outputs = inputs, outputs

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
    ) -> Prediction:
        """Accelerations; there is no covariance.

        Args:
            q, qd, tau: `(*batch, nq)` states.
            quantity: `qdd`, the only one that this model knows.
            active: without effect, since the model does not know of contacts.
            covariance: without effect, since the model knows no uncertainty.

        Returns:
            Mean `(*batch, nq)`.

        Raises:
            ModelError: the model has not been fitted, or another quantity is asked for.
            ShapeError: a state does not fit the robot.
        """
        only_qdd(self, quantity)
        if self.inputs is None or self.outputs is None:
            raise not_fitted(self)
        flat = flat_states(self.system, q, qd, tau, active)
        x = _stacked(self.inputs, {"q": flat.q, "qd": flat.qd, "tau": flat.tau})
        mean = self.network(x) * self.outputs.std["qdd"] + self.outputs.mean["qdd"]
        return Prediction(mean.reshape(*flat.batch, mean.shape[-1]), None, {"qdd": slice(0, mean.shape[-1])})

    def save(self, path: str | Path) -> None:
        """Write the model as a folder; `forcegp.load_model` reads it back exactly."""
        from forcegp.models.baseline_files import save_network

        save_network(self, path)


def _network(system: ConstrainedSystem, hidden: tuple[int, ...]) -> nn.Sequential:
    """The layers, with weights that are not drawn yet."""
    robot = system.robot
    widths = [3 * robot.nq, *hidden]
    layers: list[nn.Module] = []
    for width, following in pairwise(widths):
        layers += [nn.Linear(width, following, dtype=robot.dtype, device=robot.device), nn.Sigmoid()]
    layers.append(nn.Linear(widths[-1], robot.nq, dtype=robot.dtype, device=robot.device))
    return nn.Sequential(*layers)


SIGMOID_GAIN = 4.0
"""Inverse slope of the sigmoid at 0: with it the signal keeps its variance from layer to layer."""


def _initialise(network: nn.Sequential, generator: torch.Generator) -> None:
    """Glorot-normal weights, scaled for sigmoid layers, and biases of 0."""
    for layer in network:
        if isinstance(layer, nn.Linear):
            std = (2.0 / (layer.in_features + layer.out_features)) ** 0.5
            gain = 1.0 if layer is network[-1] else SIGMOID_GAIN
            draw = torch.randn(layer.weight.shape, dtype=torch.float64, generator=generator)
            with torch.no_grad():
                layer.weight.copy_(gain * std * draw)
                layer.bias.zero_()


def _stacked(scale: Standardization, states: dict[str, Tensor]) -> Tensor:
    """The standardized inputs side by side, `(n, 3 nq)`."""
    return torch.cat(list(scale.apply(states).values()), dim=-1)
