"""Which model a verb takes: a file, with what was not measured held and what was not recorded left out."""
# ruff: noqa: RUF009 – options are fields, made as ``dataclasses.field`` makes them

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from equimus_ctrl.options import NAMES, option

if TYPE_CHECKING:
    from collections.abc import Sequence

    from equimus_ctrl.models.model import Model


@dataclass(frozen=True)
class ModelChoice:
    """The options by which a verb's model is chosen.

    Attributes:
        model: its file; None for the nominal leg.
        lock: joints of an MJCF robot to hold, ``JOINT`` or ``JOINT=POSITION``.
        ignore: actuators and loose objects to leave out.
        motors: whether each joint without an actuator gets a motor of its name.
        prescribe: joints whose motion was measured and is taken as it is.
        unmeasured: joints that no column tells of and that move by themselves.
    """

    model: Path | None = option(
        None,
        Path | None,
        "Model file (TOML), MJCF file (XML) or URDF; the nominal leg by default.",
        metavar="FILE",
    )
    lock: Sequence[str] = option(
        (), NAMES, "Hold a joint of an MJCF robot that was not measured.", metavar="JOINT[=POSITION]"
    )
    ignore: Sequence[str] = option(
        (),
        NAMES,
        "Leave out an actuator that was not recorded, or a loose object, a body with a free joint.",
        metavar="NAME",
    )
    motors: bool = option(
        False, bool, "Give each joint without an actuator a motor of its name, as of a URDF.", "--motors"
    )
    prescribe: Sequence[str] = option(
        (), NAMES, "A joint whose measured motion is an input, such as 'base_*'.", metavar="JOINT"
    )

    unmeasured: Sequence[str] = option(
        (), NAMES, "A joint without a column that moves by itself, such as 'finger_*'.", metavar="JOINT"
    )

    def read(self, recordings: Sequence[Path] = ()) -> Model:
        """The model.

        Args:
            recordings: that it is compared with.

        Raises:
            EquimusError: where the file cannot be read, or has no such joint or actuator.
        """
        from equimus_ctrl import workflow
        from equimus_ctrl.robots.mjcf.editing import lock_of

        held = dict(lock_of(text) for text in self.lock)
        return workflow.load_model(
            self.model,
            lock=held,
            ignore=self.ignore,
            motors=self.motors,
            prescribe=self.prescribe,
            unmeasured=self.unmeasured,
            recordings=recordings,
        )
