"""Residuals in a diagnosis: where they are, and those that no effect explains, as reports and records give them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from equimus_ctrl.diagnosis.coordinates import Coordinate, written
from equimus_ctrl.shown import Short
from equimus_ctrl.types import Array


@dataclass(frozen=True, eq=False, repr=False)
class Residuals(Short):
    """Measured − predicted of one state of the model.

    Attributes:
        train: for each segment fitted (m, nj) [rad or m].
        validation: for each validation segment (m, nj) [rad or m].
        test: for each test segment.
    """

    train: tuple[Array, ...]
    validation: tuple[Array, ...]
    test: tuple[Array, ...] = ()


@dataclass(frozen=True)
class ResidualLocation:
    """A place of the refitted model's residuals.

    Attributes:
        location: joint.
        share: of the excess residual variance, over all joints.
        when: in what phase of a trial it is largest.
        region: in what region of angles, speeds or commands.
    """

    location: str
    share: float
    when: str
    region: str

    def to_dict(self) -> dict[str, Any]:
        """As JSON data."""
        return dict(vars(self))


@dataclass(frozen=True, eq=False)
class ResidualForce:
    """An unstructured generalised force that explains residuals that no effect explains.

    Attributes:
        location: joint at which it acts most.
        share: of all that residual forces explain of the augmented model's residuals.
        coordinates: that it depends on.
        places: actuators or joints at which it acts.
        gain: by how much χ² falls in cross-validation, see ``residual_force.judged``.
        threshold: the least fall that counts.
        unit: of the force.
        axis: the coordinate of its curve; None where there is none.
        axis_unit: its unit; "" where there is none.
        x: (n,) the coordinate.
        force: (n,) the generalised force there.
        band: (n,) half width of its 95 % interval.
    """

    location: str
    share: float
    coordinates: tuple[Coordinate, ...]
    places: tuple[str, ...]
    gain: float
    threshold: float
    unit: str
    axis: Coordinate | None
    axis_unit: str
    x: Array
    force: Array
    band: Array

    @property
    def depends_on(self) -> str:
        """The coordinates as text, such as ``pos.hip·vel.hip``."""
        return written(self.coordinates)

    def to_dict(self) -> dict[str, Any]:
        """As JSON data."""
        curve = {"coordinate": str(self.axis), "unit": self.axis_unit, "force_unit": self.unit} | {
            key: [float(v) for v in getattr(self, key)] for key in ("x", "force", "band")
        }
        return {
            "location": self.location,
            "share": self.share,
            "depends_on": self.depends_on,
            "acts_at": list(self.places),
            "gain": self.gain,
            "threshold": self.threshold,
            "curve": curve if self.axis else None,
            "only_on": "",
        }


@dataclass(frozen=True)
class ResidualAboveNoise:
    """Residuals of a joint far above the noise, though neither an effect nor a residual force explains them.

    Attributes:
        location: the joint.
        share: of the excess residual variance, over all joints.
        excess: residual variance of the joint: mean squared residual over the noise's variance, minus 1.
        threshold: the least that counts.
        only_on: "validation" or "test" where they are so on such trials alone, on those of validation whatever the
            effects' parameters; "" for the trials fitted.
    """

    location: str
    share: float
    excess: float
    threshold: float
    only_on: Literal["", "validation", "test"] = ""

    @property
    def depends_on(self) -> str:
        """None of the coordinates tried."""
        return ""

    def to_dict(self) -> dict[str, Any]:
        """As JSON data, with the keys of a residual force; ``gain`` is the excess residual variance."""
        return {
            "location": self.location,
            "share": self.share,
            "depends_on": self.depends_on,
            "acts_at": [self.location],
            "gain": self.excess,
            "threshold": self.threshold,
            "curve": None,
            "only_on": self.only_on,
        }


Unexplained = ResidualForce | ResidualAboveNoise
"""A significant residual that no effect explains."""
