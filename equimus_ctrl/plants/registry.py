"""The plants known by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from equimus_ctrl.effects.base import Effect
from equimus_ctrl.errors import ConfigError, NotAvailable
from equimus_ctrl.models.model import Model
from equimus_ctrl.plants.events import Event
from equimus_ctrl.plants.hardware.plant import HardwarePlant
from equimus_ctrl.plants.hardware.settings import HardwareSettings
from equimus_ctrl.plants.mujoco_plant import MujocoPlant
from equimus_ctrl.plants.replay import ReplayPlant
from equimus_ctrl.registry import Registry
from equimus_ctrl.types import Plant, Recording


@dataclass(frozen=True, eq=False)
class PlantRequest:
    """What a plant may be made of.

    Attributes:
        model: what is simulated, or what was recorded, or what the robot is.
        recording: to play.
        noise: standard deviation of white noise on each angle [rad].
        nominal: what controllers may compute with; the model by default.
        events: what befalls the robot while it runs; what was recorded takes no notice.
        hardware: how a real robot is reached.
        armed: whether commands are sent to it.
        record: new file for what it does.
        notes: of that recording, beside what the plant says of itself.
    """

    model: Model
    recording: Recording | None = None
    noise: float = 0.0
    nominal: Model | None = None
    events: Sequence[Event] = ()
    hardware: HardwareSettings | None = None
    armed: bool = False
    record: Path | None = None
    notes: Mapping[str, str] = field(default_factory=dict)


Carries = Literal["any", "model", "none"]


@dataclass(frozen=True)
class PlantEntry:
    """A plant known by name.

    Attributes:
        summary: one line for lists.
        make: makes it.
        real: whether it is no simulation: nothing repeats to the bit, and time is that of the wall; it needs
            ``PlantRequest.hardware`` and sends commands where it is ``armed``.
        effects: what it can carry: any that somebody attaches, those of the model alone, or none.
        refusal: what is said where somebody attaches others.
    """

    summary: str
    make: Callable[[PlantRequest], Plant]
    real: bool = False
    effects: Carries = "any"
    refusal: str = ""

    def check_effects(self, attached: Sequence[Effect], own: Sequence[Effect]) -> None:
        """Raise ConfigError where it cannot carry these effects.

        Args:
            attached: for this run.
            own: of the model.
        """
        carried = {"any": True, "model": not attached, "none": not (attached or own)}[self.effects]
        if not carried:
            raise ConfigError(self.refusal or f"effects cannot be attached to this plant ({self.summary})")


PLANTS: Registry[PlantEntry] = Registry("plant")


def register_plant(name: str, entry: PlantEntry) -> None:
    """Make a plant known by a name.

    Args:
        name: a plain one.
        entry: how it is made, and what is said of it.

    Raises:
        ConfigError: where the name is another's or no plain name.
    """
    PLANTS.add(name, entry)


def _mujoco(given: PlantRequest) -> Plant:
    return MujocoPlant(given.model, nominal=given.nominal, noise=given.noise, events=given.events)


def _replay(given: PlantRequest) -> Plant:
    if given.recording is None:
        raise NotAvailable("the replay plant plays the scenario's recording, and there is none")
    if given.noise:
        raise ConfigError("the replay plant shows what was measured; noise cannot be added to it")
    return ReplayPlant(given.recording, given.model.robot)


def _hardware(given: PlantRequest) -> Plant:
    if given.noise:
        raise ConfigError("a real robot has noise of its own; none can be added to it")
    if given.events:
        raise ConfigError("the scenario has events, which no program can bring about on a real robot")
    return HardwarePlant(
        given.model,
        given.hardware,
        armed=given.armed,
        nominal=given.nominal,
        record=given.record,
        notes=given.notes,
    )


register_plant(
    "mujoco",
    PlantEntry("the model in MuJoCo: 3-2-1 elements, or all that an XML has", _mujoco),
)
register_plant(
    "replay",
    PlantEntry(
        "the scenario's recording, played back; commands change nothing",
        _replay,
        effects="none",
        refusal="the replay plant plays a recording; effects cannot be attached to it",
    ),
)
register_plant(
    "hardware",
    PlantEntry(
        "a real robot over ROS 2's wire; commands are sent with --arm only",
        _hardware,
        real=True,
        effects="model",
        refusal="effects cannot be attached to a real robot; give what is known of it with --nominal FILE",
    ),
)


def make_plant(name: str, given: PlantRequest) -> Plant:
    """A plant by name.

    Raises:
        ConfigError: for an unknown name, or what it cannot have.
        NotAvailable: where it needs a recording or a transport that is not there.
    """
    return PLANTS.entry(name).make(given)
