"""Options of the verbs, one class each: the command line offers its fields as options, the library takes it whole.

A default, its bounds and the line of help stand here and nowhere else.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from equimus_ctrl.options.autotune import AutotuneOptions
from equimus_ctrl.options.check import CheckOptions
from equimus_ctrl.options.compare import CompareOptions
from equimus_ctrl.options.diagnose import DiagnoseOptions
from equimus_ctrl.options.experiment import DesignOptions
from equimus_ctrl.options.experiment_run import RunExperimentsOptions
from equimus_ctrl.options.export import ExportOptions
from equimus_ctrl.options.fields import NAMES, SPAN, bounds_of, key_values
from equimus_ctrl.options.identify import IdentifyOptions
from equimus_ctrl.options.offers import OnCommandLine, offered, option, with_changes
from equimus_ctrl.options.prove import EXCITATIONS, KINDS, LEAST_DURATION, ProveOptions, Shard
from equimus_ctrl.options.score import MOST_RATE, ScoreOptions
from equimus_ctrl.options.sensitivity import SensitivityOptions
from equimus_ctrl.options.train import ALGORITHMS, UNSEEN_SEED, TrainOptions
from equimus_ctrl.options.validate import ValidateOptions

if TYPE_CHECKING:
    from equimus_ctrl.options.fields import Bounds as Bounds
    from equimus_ctrl.options.fields import Some as Some
    from equimus_ctrl.options.fields import Window as Window

__all__ = [
    "ALGORITHMS",
    "EXCITATIONS",
    "KINDS",
    "LEAST_DURATION",
    "MOST_RATE",
    "NAMES",
    "SPAN",
    "UNSEEN_SEED",
    "AutotuneOptions",
    "CheckOptions",
    "CompareOptions",
    "DesignOptions",
    "DiagnoseOptions",
    "ExportOptions",
    "IdentifyOptions",
    "OnCommandLine",
    "ProveOptions",
    "RunExperimentsOptions",
    "ScoreOptions",
    "SensitivityOptions",
    "Shard",
    "TrainOptions",
    "ValidateOptions",
    "bounds_of",
    "key_values",
    "offered",
    "option",
    "with_changes",
]
