"""What the commands do, as functions of a library: load a model, run a scenario, score, tune, identify."""

from equimus_ctrl.identification.results import Identification, Identified, IdentifiedPoses, Judged
from equimus_ctrl.scenarios.comparison import Comparison, Condition
from equimus_ctrl.workflow.compare import compare
from equimus_ctrl.workflow.diagnose import diagnose_recordings
from equimus_ctrl.workflow.hardware import check_hardware, import_bag, load_hardware, measure_delay, with_valve_delays
from equimus_ctrl.workflow.identify import (
    identify_files,
    identify_poses,
    identify_recordings,
    sensitivity_of,
    simulator_of,
)
from equimus_ctrl.workflow.mjcf import FreeParameterFile, load_mjcf, offer, parameter_rows, read_free
from equimus_ctrl.workflow.models import load_elastic, load_model, renamed, save_model
from equimus_ctrl.workflow.plugins import load_plugins
from equimus_ctrl.workflow.prove import Proof, put_to_proof
from equimus_ctrl.workflow.runs import (
    ScenarioRun,
    TunedPid,
    load_controller,
    load_scenario,
    recordings_of,
    run_scenario,
    scenario_entries,
    tune_pid,
)
from equimus_ctrl.workflow.scores import RecordingsScore, TrialScore, gather, score_recordings

__all__ = [
    "Comparison",
    "Condition",
    "FreeParameterFile",
    "Identification",
    "Identified",
    "IdentifiedPoses",
    "Judged",
    "Proof",
    "RecordingsScore",
    "ScenarioRun",
    "TrialScore",
    "TunedPid",
    "check_hardware",
    "compare",
    "diagnose_recordings",
    "gather",
    "identify_files",
    "identify_poses",
    "identify_recordings",
    "import_bag",
    "load_controller",
    "load_elastic",
    "load_hardware",
    "load_mjcf",
    "load_model",
    "load_plugins",
    "load_scenario",
    "measure_delay",
    "offer",
    "parameter_rows",
    "put_to_proof",
    "read_free",
    "recordings_of",
    "renamed",
    "run_scenario",
    "save_model",
    "scenario_entries",
    "score_recordings",
    "sensitivity_of",
    "simulator_of",
    "tune_pid",
    "with_valve_delays",
]
