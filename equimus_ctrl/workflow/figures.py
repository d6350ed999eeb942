"""Figures of whatever a verb found, as matplotlib's objects: nothing is shown or written, pyplot is not touched."""

from __future__ import annotations

from functools import singledispatch
from typing import TYPE_CHECKING, Any

from equimus_ctrl.diagnosis.results import Diagnosis
from equimus_ctrl.errors import ConfigError, unknown_name
from equimus_ctrl.experiments.results import Designed
from equimus_ctrl.identification.results import Identification, Identified, IdentifiedPoses
from equimus_ctrl.identification.sensitivity import Sensitivity
from equimus_ctrl.preflight.result import CheckResult
from equimus_ctrl.report import style
from equimus_ctrl.scenarios.comparison import Comparison
from equimus_ctrl.tuning.result import TuningResult
from equimus_ctrl.validation.validate import Validation
from equimus_ctrl.workflow.proofs import Proof
from equimus_ctrl.workflow.runs import ScenarioRun
from equimus_ctrl.workflow.tuning import Tuned

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def figures(found: Any) -> dict[str, Figure]:
    """Name → figure of all that there is to see of what a verb found.

    Args:
        found: by ``check``, ``compare``, ``design_experiment``, ``diagnose``, ``identify``, ``prove``,
            ``run_scenario``, ``sensitivity``, ``tune`` or ``validate``.

    Raises:
        ConfigError: for anything else.
    """
    return style.drawn(drawings(found))


def figure(found: Any, name: str | None = None) -> Figure:
    """One figure of what a verb found, the others not drawn.

    Args:
        found: see ``figures``.
        name: of the figure; the first by default.

    Raises:
        ConfigError: for a name that it has not, or something of which there are no figures.
    """
    known = drawings(found)
    if name is not None and name not in known:
        raise ConfigError(unknown_name("figure", name, known, type(found).__name__))
    drawn = known[name or next(iter(known))]()
    if drawn is None:
        raise ConfigError(f"{type(found).__name__}: there is nothing to draw as {name}")
    return drawn


@singledispatch
def drawings(found: Any) -> style.Drawings:
    """Name → what draws that figure of what a verb found.

    Raises:
        ConfigError: for something of which there are no figures.
    """
    known = sorted(own.__name__ for own in drawings.registry if own is not object)
    raise ConfigError(f"there are no figures of {type(found).__name__}, expected one of {', '.join(known)}")


@drawings.register
def _(found: CheckResult) -> style.Drawings:
    from equimus_ctrl.report.check_figure import check_figure

    return {"check": lambda: check_figure(found)}


@drawings.register
def _(found: Comparison) -> style.Drawings:
    from equimus_ctrl.report.comparison import comparison_drawings

    return comparison_drawings(found)


@drawings.register
def _(found: Designed) -> style.Drawings:
    from equimus_ctrl.report.experiment_figures import design_drawings

    return design_drawings(found)


@drawings.register
def _(found: Diagnosis) -> style.Drawings:
    from equimus_ctrl.report.diagnosis_figures import diagnosis_drawings

    return diagnosis_drawings(found)


@drawings.register
def _(found: Identification) -> style.Drawings:
    from equimus_ctrl.report.identification_figures import identification_drawings

    return identification_drawings(found)


@drawings.register
def _(found: Identified) -> style.Drawings:
    from equimus_ctrl.report.identification_figures import trials_drawings

    return trials_drawings(found)


@drawings.register
def _(found: IdentifiedPoses) -> style.Drawings:
    from equimus_ctrl.report.identification_figures import poses_drawings

    return poses_drawings(found)


@drawings.register
def _(found: Proof) -> style.Drawings:
    from equimus_ctrl.report.proof_figures import proof_drawings

    if found.experiments is None:
        return proof_drawings(found.score)
    from equimus_ctrl.report.proof_experiments import experiment_drawings

    return {**experiment_drawings(found.experiments), **proof_drawings(found.score)}


@drawings.register
def _(found: ScenarioRun) -> style.Drawings:
    from equimus_ctrl.report.run_figures import run_drawings

    label = f"{found.scenario.name}, {found.controller}"
    return run_drawings(found.run, found.scenario, found.score, found.kinematics, label)


@drawings.register
def _(found: Sensitivity) -> style.Drawings:
    from equimus_ctrl.report.sensitivity_figures import sensitivity_drawings

    return sensitivity_drawings(found)


@drawings.register
def _(found: Tuned) -> style.Drawings:
    return _tuning(found.result)


@drawings.register(TuningResult)
def _tuning(found: TuningResult) -> style.Drawings:
    from equimus_ctrl.report.tuning_figures import tuning_drawings

    return tuning_drawings(found)


@drawings.register
def _(found: Validation) -> style.Drawings:
    from equimus_ctrl.report.validation_figures import validation_drawings

    return validation_drawings(found)
