"""What a policy computes: layers of linear maps, without the library that trained them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.errors import ConfigError, unknown_name
from equimus_ctrl.types import Array

Single = NDArray[np.float32]


def _elu(x: Single) -> Single:
    return np.where(x > 0, x, np.expm1(np.minimum(x, 0)))


ACTIVATIONS: dict[str, Callable[[Single], Single]] = {
    "identity": lambda x: x,
    "tanh": np.tanh,
    "relu": lambda x: np.maximum(x, 0),
    "elu": _elu,
    "leaky_relu": lambda x: np.where(x > 0, x, np.float32(0.01) * x),
}
"""Name → function of the elements."""


@dataclass(frozen=True, eq=False)
class Normalisation:
    """Observations o as (o − mean)/√(variance + epsilon), within ±clip.

    Attributes:
        mean: (size,).
        variance: (size,).
        epsilon: added to it.
        clip: what is beyond is the nearest.

    Raises:
        ConfigError: for values that cannot be.
    """

    mean: Array
    variance: Array
    epsilon: float = 1e-8
    clip: float = 10.0

    def __post_init__(self) -> None:
        fits = self.mean.ndim == 1 and self.mean.shape == self.variance.shape
        if not (fits and np.isfinite(self.mean).all() and np.all(self.variance >= 0)):
            raise ConfigError("the normalisation of observations is not one finite mean and variance for each")

    def __call__(self, observed: NDArray[np.floating[Any]]) -> Single:
        """(n, size) of (n, size)."""
        scaled = (observed - self.mean) / np.sqrt(self.variance + self.epsilon)
        return np.asarray(np.clip(scaled, -self.clip, self.clip), dtype=np.float32)


@dataclass(frozen=True, eq=False)
class Network:
    """y = f(W y + b), layer by layer.

    Attributes:
        weights: (outputs, inputs) of each layer.
        biases: (outputs,) of each.
        activations: f of each, of ``ACTIVATIONS``.

    Raises:
        ConfigError: for layers that do not fit each other, are not finite, or an unknown activation.
    """

    weights: tuple[Single, ...]
    biases: tuple[Single, ...]
    activations: tuple[str, ...]

    def __post_init__(self) -> None:
        if not len(self.weights) == len(self.biases) == len(self.activations) > 0:
            raise ConfigError("the network has other numbers of weights, biases and activations, expected one a layer")
        wide: int | None = None
        for k, (weight, bias, name) in enumerate(zip(self.weights, self.biases, self.activations, strict=True)):
            if name not in ACTIVATIONS:
                raise ConfigError(unknown_name("activation", name, ACTIVATIONS, f"layer {k + 1}"))
            if weight.ndim != 2 or bias.shape != weight.shape[:1] or wide not in (None, weight.shape[1]):
                raise ConfigError(
                    f"layer {k + 1} has weights {weight.shape} and biases {bias.shape}, which do not fit each other or "
                    "the layer before"
                )
            if not (np.isfinite(weight).all() and np.isfinite(bias).all()):
                raise ConfigError(f"layer {k + 1} has weights that are not finite")
            wide = weight.shape[0]

    @property
    def inputs(self) -> int:
        """How many numbers go in."""
        return int(self.weights[0].shape[1])

    @property
    def outputs(self) -> int:
        """How many come out."""
        return int(self.weights[-1].shape[0])

    def __call__(self, given: Single) -> Single:
        """(n, outputs) of (n, inputs)."""
        for weight, bias, name in zip(self.weights, self.biases, self.activations, strict=True):
            given = ACTIVATIONS[name](given @ weight.T + bias).astype(np.float32)
        return given
