"""Neural-network baseline with sigmoid layers from (q, q̇, τ) to q̈ and no mechanical model (sec. 5.4)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn

from forcegp.constraints import ConstrainedSystem
from forcegp.data import Dataset
from forcegp.errors import ModelError
from forcegp.files import Record
from forcegp.forces.measurements import Observation, measurement_of
from forcegp.forces.quantities import FlatStates
from forcegp.gp.features import Standardization
from forcegp.models.base import AccelerationFit, FitProgress, Model
from forcegp.models.fit_result import FitResult
from forcegp.models.minibatch import BatchOptions, train
from forcegp.storage.model_file import ModelHeader
from forcegp.storage.system import take

KIND = "neural_network"
SHALLOW = BatchOptions(epochs=3000, batch=1024, learning_rate=0.03, patience=300)
DEEP = BatchOptions(epochs=300, batch=256, learning_rate=0.003)
"""Options for more than two hidden layers, which need smaller steps and more time per epoch."""


class NetworkSettings(Record):
    """Saved settings of a neural network."""

    hidden: tuple[int, ...]
    seed: int
    constant: tuple[str, ...]


class NeuralNetwork(Model["NetworkFit"]):
    """A feed-forward network of sigmoid layers on standardized (q, q̇, τ), trained on mean squared error.

    The network does not use contacts as inputs and does not predict covariances.

    Args:
        system: the robot and its contacts, which are used only for evaluation.
        hidden: widths of the hidden layers.
        seed: random seed for the initial weights, the held-out samples and the order of the batches.

    Raises:
        ModelError: a width is not positive.
    """

    kind = KIND

    def __init__(self, system: ConstrainedSystem, hidden: Sequence[int] = (80,), seed: int = 0) -> None:
        self._keep(locals())
        if any(width < 1 for width in hidden):
            raise ModelError("a hidden layer needs at least one unit", got=tuple(hidden))
        self.system = system
        self.hidden = tuple(hidden)
        self.seed = seed

    def fit(
        self,
        data: Dataset,
        *,
        options: BatchOptions | None = None,
        progress: FitProgress | None = None,
    ) -> NetworkFit:
        """Train with ADAM on batches, and keep the weights of the epoch with the smallest held-out error.

        Args:
            data: states and measured accelerations.
            options: training options. The default is `SHALLOW` or `DEEP`, depending on the number of layers.
            progress: a function called after each epoch.

        Returns:
            The fitted network. In its result, `evaluations` is the number of epochs, and `objective` is the
            held-out error of the standardized accelerations.

        Raises:
            ModelError, DataError: the data are incompatible with the model.
            NumericalError: training diverges.
        """
        measured, _ = measurement_of(Observation(data, noise_std=1.0), self.system)
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
        result = FitResult(**learned.outcome, constant_inputs=inputs.constant)
        network.requires_grad_(False)
        return NetworkFit(self.system, self.hidden, self.seed, network, inputs, outputs, result)


@dataclass(frozen=True, eq=False, repr=False)
class NetworkFit(AccelerationFit):
    """A trained network.

    Attributes:
        system: the robot and its contacts.
        hidden, seed: the layer widths and the random seed of the specification.
        network: the layers of the network.
        inputs, outputs: the standardization of (q, q̇, τ) and of q̈.
        result: the result of training.
    """

    system: ConstrainedSystem
    hidden: tuple[int, ...]
    seed: int
    network: nn.Sequential
    inputs: Standardization
    outputs: Standardization
    result: FitResult

    kind = KIND

    def accelerations(self, at: FlatStates, variance: bool) -> tuple[Tensor, None]:
        x = _stacked(self.inputs, {"q": at.q, "qd": at.qd, "tau": at.tau})
        return self.network(x) * self.outputs.std["qdd"] + self.outputs.mean["qdd"], None

    @classmethod
    def restored(
        cls, header: ModelHeader, tensors: Mapping[str, Tensor], system: ConstrainedSystem, source: str
    ) -> NetworkFit:
        settings = header.settings_as(NetworkSettings, source)
        robot = NeuralNetwork(system, settings.hidden, settings.seed).system.robot  # checks the widths
        widths = [3 * robot.nq, *settings.hidden, robot.nq]
        state = {}
        for layer, (before, after) in enumerate(pairwise(widths)):
            # Shapes are checked before the network is allocated.
            for name, shape in (("weight", (after, before)), ("bias", (after,))):
                key = f"{2 * layer}.{name}"
                state[key] = take(tensors, f"network.{key}", shape, robot.dtype, source)
        network = _network(system, settings.hidden)
        network.load_state_dict(state)
        scales = []
        for names, constant in ((("q", "qd", "tau"), settings.constant), (("qdd",), ())):
            mean, std = (
                {name: take(tensors, f"{part}.{name}", (robot.nq,), robot.dtype, source) for name in names}
                for part in ("mean", "std")
            )
            scales.append(Standardization(mean, std, constant))
        result = FitResult(True, 0, 0.0, 0.0, constant_inputs=settings.constant, message="loaded")
        network = network.requires_grad_(False)
        return cls(system, settings.hidden, settings.seed, network, scales[0], scales[1], result)

    def record(self) -> tuple[Record, dict[str, Tensor]]:
        settings = NetworkSettings(hidden=self.hidden, seed=self.seed, constant=self.inputs.constant)
        tensors = {f"network.{name}": value for name, value in self.network.state_dict().items()}
        for part in (self.inputs, self.outputs):
            for name in part.mean:
                tensors |= {f"mean.{name}": part.mean[name], f"std.{name}": part.std[name]}
        return settings, tensors


def _network(system: ConstrainedSystem, hidden: tuple[int, ...]) -> nn.Sequential:
    """Return the layers of the network before they are initialised."""
    robot = system.robot
    widths = [3 * robot.nq, *hidden]
    layers: list[nn.Module] = []
    for width, following in pairwise(widths):
        layers += [nn.Linear(width, following, dtype=robot.dtype, device=robot.device), nn.Sigmoid()]
    layers.append(nn.Linear(widths[-1], robot.nq, dtype=robot.dtype, device=robot.device))
    return nn.Sequential(*layers)


SIGMOID_GAIN = 4.0
"""Gain that preserves the variance of the signal between layers, the inverse slope of the sigmoid at 0."""


def _initialise(network: nn.Sequential, generator: torch.Generator) -> None:
    """Draw Glorot-normal weights, scaled for sigmoid layers, and set the biases to zero."""
    for layer in network:
        if isinstance(layer, nn.Linear):
            std = (2.0 / (layer.in_features + layer.out_features)) ** 0.5
            gain = 1.0 if layer is network[-1] else SIGMOID_GAIN
            draw = torch.randn(layer.weight.shape, dtype=torch.float64, generator=generator)
            with torch.no_grad():
                layer.weight.copy_(gain * std * draw)
                layer.bias.zero_()


def _stacked(scale: Standardization, states: dict[str, Tensor]) -> Tensor:
    """Return the concatenated standardized inputs, `(n, 3 nq)`."""
    return torch.cat(list(scale.apply(states).values()), dim=-1)
