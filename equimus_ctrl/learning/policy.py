"""A policy as a file: network, normalisation, and what it was trained for, in one archive.

``policy.json`` names robot, task and settings; ``network.npz`` holds arrays. A checkpoint has ``training.bin`` and
``training.npz`` beside them, to go on with. Nothing that is read here is code.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from equimus_ctrl.errors import ConfigError
from equimus_ctrl.learning.network import Network, Normalisation
from equimus_ctrl.learning.observing import Sight, sight_of, sight_to_dict
from equimus_ctrl.types import Array, PlantSpec

SCHEMA = "equimus-ctrl/policy/1"
ABOUT, ARRAYS, STATE, STATE_ARRAYS = "policy.json", "network.npz", "training.bin", "training.npz"
MOST_BYTES = 2_000_000_000
"""Of one part of an archive, unpacked."""


@dataclass(frozen=True)
class Suited:
    """The robot that a policy is for, and what it sees of it.

    Attributes:
        robot: its name.
        joints: names, in order.
        actuators: names, in order.
        command_low: lowest commands.
        command_high: highest ones.
        joint_low: lower ends of the joints' ranges [rad or m].
        joint_high: upper ends.
        control_dt: time between two commands [s].
        history: how many measurements and commands it sees.
        privileged: whether it sees what no sensor shows.
        task: that it was trained for.
        sight: what of the task it sees; None where no controller has that.
        blind: what it is then, a phrase.
    """

    robot: str
    joints: tuple[str, ...]
    actuators: tuple[str, ...]
    command_low: tuple[float, ...]
    command_high: tuple[float, ...]
    joint_low: tuple[float, ...]
    joint_high: tuple[float, ...]
    control_dt: float
    history: int
    privileged: bool
    task: str
    sight: Sight | None
    blind: str = ""

    @classmethod
    def to(cls, spec: PlantSpec, **more: Any) -> Suited:
        """Of a plant's spec."""
        limits: dict[str, Any] = {key: _floats(getattr(spec, key)) for key in LIMITS}
        return cls(joints=spec.joints, actuators=spec.actuators, control_dt=spec.control_dt, **limits, **more)

    def check(self, spec: PlantSpec, where: str) -> int:
        """How many of a plant's control periods make one of the policy's.

        Raises:
            ConfigError: where the plant is another robot, or its control rate does not fit.
        """
        for what, own, given in (("joints", self.joints, spec.joints), ("actuators", self.actuators, spec.actuators)):
            if own != given:
                raise ConfigError(
                    f"{where}: the policy is for {self.robot}, whose {what} are {', '.join(own)}; this robot's are "
                    f"{', '.join(given)}"
                )
        for key in LIMITS:
            if not _same(getattr(self, key), getattr(spec, key)):
                raise ConfigError(
                    f"{where}: the policy is for {self.robot} with {key} {_shown(getattr(self, key))}, this robot's "
                    f"are {_shown(getattr(spec, key))}"
                )
        ratio = self.control_dt / spec.control_dt
        if round(ratio) < 1 or abs(ratio - round(ratio)) > 1e-6:
            raise ConfigError(
                f"{where}: the policy acts {1 / self.control_dt:g} times a second, this plant {1 / spec.control_dt:g} "
                "times; expected that or a whole multiple of it"
            )
        return round(ratio)


LIMITS = ("command_low", "command_high", "joint_low", "joint_high")


def _floats(values: Any) -> tuple[float, ...]:
    return tuple(float(value) for value in values)


def _shown(values: Any) -> str:
    return ", ".join(f"{value:g}" for value in values)


def _same(one: Any, other: Any) -> bool:
    return np.shape(one) == np.shape(other) and bool(np.allclose(one, other, rtol=1e-9, atol=1e-12))


class Acting(Protocol):
    """What acts on observations, and says what it is for."""

    @property
    def suited(self) -> Suited:
        """What it is for."""
        ...

    def act(self, observed: NDArray[np.floating[Any]]) -> Array:
        """(n, na) actions within ±1, of observations (n, size).

        Raises:
            ConfigError: for observations of another size, or that are not finite.
        """
        ...


@dataclass(frozen=True, eq=False)
class Policy:
    """Actions from observations.

    Attributes:
        network: of normalised observations.
        normalisation: of these.
        suited: what it is for.
        record: how it was trained, as JSON data.
    """

    network: Network
    normalisation: Normalisation
    suited: Suited
    record: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.normalisation.mean.size != self.network.inputs or self.network.outputs != len(self.suited.actuators):
            raise ConfigError(
                f"the policy takes {self.network.inputs} numbers and gives {self.network.outputs}; it was normalised "
                f"for {self.normalisation.mean.size} and is for {len(self.suited.actuators)} actuators"
            )

    def act(self, observed: NDArray[np.floating[Any]]) -> Array:
        """(n, na) actions within ±1, of observations (n, size), without exploring.

        Raises:
            ConfigError: for observations of another size, or that are not finite.
        """
        checked(observed, self.network.inputs)
        return np.clip(self.network(self.normalisation(observed)), -1.0, 1.0).astype(np.float64)

    def about(self) -> dict[str, Any]:
        """All but the weights, as JSON data."""
        own = {key: getattr(self.suited, key) for key in Suited.__dataclass_fields__}
        sight = None if self.suited.sight is None else sight_to_dict(self.suited.sight)
        scale = self.normalisation
        return {
            "schema": SCHEMA,
            "for": {**own, "sight": sight},
            "activations": self.network.activations,
            "normalisation": {
                "epsilon": scale.epsilon, "clip": scale.clip, "mean": scale.mean.tolist(),
                "variance": scale.variance.tolist(),
            },
            "record": self.record,
        }  # fmt: skip

    def to_bytes(self, state: bytes | None = None, arrays: Mapping[str, Array] | None = None) -> bytes:
        """The archive; with the state of training a checkpoint. The same policy gives the same bytes."""
        about = self.about()
        for name in ("mean", "variance"):  # as arrays, to the last bit
            del about["normalisation"][name]
        layers: dict[str, Any] = {f"weight.{k}": own for k, own in enumerate(self.network.weights)}
        layers |= {f"bias.{k}": own for k, own in enumerate(self.network.biases)}
        scale = {"mean": self.normalisation.mean, "variance": self.normalisation.variance}
        parts = {ABOUT: json.dumps(about, indent=1).encode(), ARRAYS: _packed({**layers, **scale})}
        if state is not None:
            parts |= {STATE: state, STATE_ARRAYS: _packed(dict(arrays or {}))}
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w") as archive:
            for name, data in parts.items():
                archive.writestr(zipfile.ZipInfo(name), data, zipfile.ZIP_DEFLATED)
        return buffer.getvalue()

    @classmethod
    def from_bytes(cls, data: bytes, where: str) -> Policy:
        """What an archive holds.

        Raises:
            ConfigError: where it is none of ours, or damaged.
        """
        parts = _parts(data, where, (ABOUT, ARRAYS))
        try:
            about = json.loads(parts[ABOUT])
            if not isinstance(about, dict) or about.get("schema") != SCHEMA:
                raise ConfigError(f"{where}: its schema is {_schema(about)!r}, expected {SCHEMA!r}")
            arrays = _unpacked(parts[ARRAYS])
            activations = tuple(about["activations"])
            layers = range(len(activations))
            if "mean" not in arrays or "variance" not in arrays:
                raise ConfigError(
                    f"{where}: is without the normalisation of observations that it was trained with, and would see "
                    "other numbers than in training; expected a file as train writes it"
                )
            network = Network(
                tuple(np.asarray(arrays[f"weight.{k}"], np.float32) for k in layers),
                tuple(np.asarray(arrays[f"bias.{k}"], np.float32) for k in layers),
                activations,
            )
            normalisation = Normalisation(arrays["mean"], arrays["variance"], **about["normalisation"])
            return cls(network, normalisation, suited_of(about["for"], where), about["record"])
        except ConfigError as error:
            said = str(error)
            raise ConfigError(said if said.startswith(where) else f"{where}: {said}") from None
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise ConfigError(f"{where}: is damaged or not as train writes it ({error})") from None

    def recorded(self, record: Mapping[str, Any]) -> Policy:
        """The same with another record."""
        return replace(self, record=record)


def checked(observed: NDArray[np.floating[Any]], size: int) -> None:
    """See to it that observations are (n, size) and finite.

    Raises:
        ConfigError: where they are not.
    """
    if observed.shape[1:] != (size,):
        raise ConfigError(f"observations have shape {observed.shape}, the policy takes {size} each")
    if not np.isfinite(observed).all():
        k = int(np.flatnonzero(~np.isfinite(observed).all(axis=0))[0])
        raise ConfigError(f"number {k + 1} of what the policy sees is not finite")


def suited_of(data: Mapping[str, Any], where: str) -> Suited:
    """Of JSON data.

    Raises:
        ConfigError, KeyError, TypeError, ValueError: where it is not as ``Policy.about`` has it.
    """
    own = dict(data)
    own["sight"] = None if own["sight"] is None else sight_of(own["sight"], where)
    for key in ("joints", "actuators"):
        own[key] = tuple(map(str, own[key]))
    for key in LIMITS:
        own[key] = _floats(own[key])
    return Suited(**own)


def training_state(data: bytes, where: str) -> tuple[bytes, dict[str, Array]]:
    """What a checkpoint holds to go on with.

    Raises:
        ConfigError: where the file is a policy alone.
    """
    parts = _parts(data, where, (STATE, STATE_ARRAYS))
    try:
        return parts[STATE], _unpacked(parts[STATE_ARRAYS])
    except (KeyError, ValueError) as error:
        raise ConfigError(f"{where}: is damaged ({error})") from None


def _schema(about: Any) -> Any:
    return about.get("schema") if isinstance(about, dict) else None


def _packed(arrays: Mapping[str, Array]) -> bytes:
    """As npz without times, so that the same arrays give the same bytes."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, values in arrays.items():
            own = io.BytesIO()
            np.lib.format.write_array(own, np.asarray(values), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), own.getvalue())
    return buffer.getvalue()


def _unpacked(data: bytes) -> dict[str, Array]:
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as held:
            return {name: held[name] for name in held.files}
    except (OSError, zipfile.BadZipFile) as error:
        raise ValueError(str(error)) from None


def _parts(data: bytes, where: str, wanted: tuple[str, ...]) -> dict[str, bytes]:
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            names = archive.namelist()
            if wanted[0] not in names and "policy.pth" in names:
                raise ConfigError(
                    f"{where}: is a file of Stable-Baselines3's own, without the normalisation of observations and the "
                    "robot that it is for; expected one that train wrote"
                )
            for name in wanted:
                if name not in names:
                    raise ConfigError(f"{where}: has no {name}; expected a file that train wrote")
                if archive.getinfo(name).file_size > MOST_BYTES:
                    raise ConfigError(f"{where}: {name} is larger than {MOST_BYTES:,} bytes")
            return {name: archive.read(name) for name in wanted}
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError, OSError) as error:
        raise ConfigError(f"{where}: is no archive of a policy, or damaged ({error})") from None
