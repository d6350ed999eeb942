"""The plants known by name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from equimus_ctrl.errors import ConfigError, NotAvailable, unknown_name
from equimus_ctrl.models.model import Model
from equimus_ctrl.plants.events import Event
from equimus_ctrl.plants.mujoco_plant import MujocoPlant
from equimus_ctrl.plants.replay import ReplayPlant
from equimus_ctrl.types import Plant, Recording


@dataclass(frozen=True)
class PlantEntry:
    """A plant known by name.

    Attributes:
        summary: one line for lists.
        make: (model, recording or None, noise, nominal or None, events) → plant.
    """

    summary: str
    make: Callable[[Model, Recording | None, float, Model | None, Sequence[Event]], Plant]


def _mujoco(
    model: Model, recording: Recording | None, noise: float, nominal: Model | None, events: Sequence[Event]
) -> Plant:
    return MujocoPlant(model, nominal=nominal, noise=noise, events=events)


def _replay(
    model: Model, recording: Recording | None, noise: float, nominal: Model | None, events: Sequence[Event]
) -> Plant:
    if recording is None:
        raise NotAvailable("the replay plant plays the scenario's recording, and there is none")
    if noise:
        raise ConfigError("the replay plant shows what was measured; noise cannot be added to it")
    return ReplayPlant(recording, model.morphology)


PLANTS: dict[str, PlantEntry] = {
    "mujoco": PlantEntry("the model in MuJoCo, its actuators as 3-2-1 elements", _mujoco),
    "replay": PlantEntry("the scenario's recording, played back; commands change nothing", _replay),
}


def make_plant(
    name: str,
    model: Model,
    recording: Recording | None = None,
    noise: float = 0.0,
    nominal: Model | None = None,
    events: Sequence[Event] = (),
) -> Plant:
    """A plant by name.

    Args:
        name: see ``PLANTS``.
        model: what is simulated, or what was recorded.
        recording: to play.
        noise: standard deviation of white noise on each angle [rad].
        nominal: what controllers may compute with; the model by default.
        events: what befalls the robot while it runs; what was recorded takes no notice.

    Raises:
        ConfigError: for an unknown name.
        NotAvailable: where it needs a recording that is not there.
    """
    if name not in PLANTS:
        raise ConfigError(unknown_name("plant", name, PLANTS))
    return PLANTS[name].make(model, recording, noise, nominal, events)
