"""What an engine says about itself: how it simulates, what that costs, and what its physics step does to the results.

An engine is no trait of a robot: one robot may be simulated by several, and one engine may simulate several kinds.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

from equimus_ctrl.engines.motion import Motion
from equimus_ctrl.engines.trials import Predicted, Trial
from equimus_ctrl.models.model import Model
from equimus_ctrl.types import Array

EngineName = Literal["reduced", "mujoco"]


@dataclass(frozen=True)
class Discretisation:
    """The error of a physics step that counts beside the sensors' noise.

    Attributes:
        step: the step that all is simulated with [s].
        finer: how many steps take the place of one where its error is looked at.
    """

    step: float
    finer: int


class ForceResponse(Protocol):
    """A model's motions through trials, and how small generalised forces along them change what is measured."""

    @property
    def motions(self) -> tuple[Motion, ...]:
        """One for each trial."""
        ...

    def response(self, torques: Sequence[Array]) -> list[Array]:
        """For each trial (m, nj, k) the change of the measured positions by forces (m − 1, nj, k), to first order."""
        ...

    def inner_response(self, torques: Sequence[Array]) -> list[Array]:
        """The same (m, 2 nj, k) of the true positions and rates."""
        ...

    def drive_response(self, torques: Sequence[Array]) -> list[Array]:
        """The same (m, na, k) of the forces of each command's actuator, before the gear."""
        ...


class Engine(ABC):
    """Predicts positions for given commands, parameters and effects, many models and trials at once.

    Attributes:
        name: as reports and the command line call it.
        reason: why it was taken, as a phrase; empty where there is nothing to choose.
        batched: models that are simulated at once share the work, so one more costs next to nothing, and has the same
            rounding as its neighbours: derivatives are differences from a base that is simulated along with them.
        costly: a simulation of all trials takes so long that a coarse fit takes derivatives from a longer step, and end
            where little is gained.
        responds_by: how ``ForceResponse`` is found: by the linearised equations of motion along a motion
            (``"linearised"``), or by simulating every small force (``"simulated"``).
    """

    name: EngineName
    reason: str = ""
    batched: bool
    costly: bool
    responds_by: Literal["linearised", "simulated"]

    def to_dict(self) -> dict[str, str]:
        """As JSON data: which it is, and why it was taken."""
        return {"name": self.name, "reason": self.reason}

    @property
    def sentence(self) -> str:
        """For a person: which it is, and why it was taken."""
        return f"Engine: {self.name}" + (f" ({self.reason})." if self.reason else ".")

    @property
    def step(self) -> float | None:
        """The physics step that it takes [s], where that is known."""
        return None

    @property
    def discretisation(self) -> Discretisation | None:
        """Of a step whose error counts: it would be taken for missing physics, and widens intervals.

        None where the error is far below the sensors' noise.
        """
        return None

    @abstractmethod
    def simulate(
        self, models: Sequence[Model], trials: Sequence[Trial], starts: Sequence[Array], threads: int | None = None
    ) -> list[Predicted]:
        """Every model through every trial.

        Args:
            models: of one robot, with whatever parameters and effects.
            trials: what is done.
            starts: for each trial (k, 2 nj) true positions and velocities at its start, one row a model.
            threads: as many as there are cores by default; results do not depend on it.

        Returns:
            One ``Predicted`` for each trial.
        """

    def coarser(self) -> Engine | None:
        """A faster one for what need not be exact, such as screening; None where there is none."""
        return None

    def finer(self) -> Engine | None:
        """A slower one with less discretisation error, to compare alternatives by; None where there is none."""
        return None

    def with_finer_step(self) -> Engine:
        """The same with ``discretisation.finer`` steps in the place of one.

        Raises:
            NotImplementedError: where its discretisation error does not count.
        """
        raise NotImplementedError(f"the error of the {self.name} engine's step does not count")

    def without_step_error(self) -> Engine:
        """An engine that is, as far as is known, free of discretisation error; itself where its own does not count."""
        return self
