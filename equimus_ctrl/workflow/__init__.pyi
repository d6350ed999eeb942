# What `equimus_ctrl.workflow` offers; read at run time too, so this list is the only one.
# No module here has the name of a function: the one would hide the other once both are imported.
from .checks import Check as Check, check as check
from .comparisons import compare as compare
from .diagnoses import diagnose as diagnose
from .experiment_runs import run_experiments as run_experiments
from .experiment_steps import ExperimentRun as ExperimentRun
from .experiments import (
    DesignFiles as DesignFiles,
    design_experiment as design_experiment,
    write_design as write_design,
)
from .exports import (
    Export as Export,
    Written as Written,
    export_model as export_model,
    mjcf_of_model as mjcf_of_model,
)
from .figures import figure as figure, figures as figures
from .hardware import (
    check_hardware as check_hardware,
    import_bag as import_bag,
    load_hardware as load_hardware,
    measure_delay as measure_delay,
    with_valve_delays as with_valve_delays,
)
from .identifications import (
    identify as identify,
    identify_poses as identify_poses,
    identify_recordings as identify_recordings,
    sensitivity as sensitivity,
    simulator_of as simulator_of,
)
from .learning import (
    make_env as make_env,
    make_episodes as make_episodes,
    make_sb3_env as make_sb3_env,
    make_vec_env as make_vec_env,
)
from .linearisations import Linearised as Linearised, linearise as linearise
from .listings import Listing as Listing, list_names as list_names
from .logs import (
    check_recordings as check_recordings,
    export_recordings as export_recordings,
    fetch_recordings as fetch_recordings,
    read_recording as read_recording,
    read_recordings as read_recordings,
    recorded_models as recorded_models,
    write_recording as write_recording,
    write_recordings as write_recordings,
)
from .mjcf import (
    FreeParameterFile as FreeParameterFile,
    load_mjcf as load_mjcf,
    mapping_of as mapping_of,
    offer as offer,
    parameter_rows as parameter_rows,
    read_free as read_free,
    read_recorded as read_recorded,
)
from .models import (
    by_group as by_group,
    load_elastic as load_elastic,
    load_model as load_model,
    renamed as renamed,
    save_model as save_model,
)
from .plugins import load_plugins as load_plugins
from .proofs import Proof as Proof, prove as prove
from .reports import write_report as write_report, write_video as write_video
from .runs import (
    ScenarioRun as ScenarioRun,
    load_controller as load_controller,
    load_scenario as load_scenario,
    recordings_of as recordings_of,
    run_scenario as run_scenario,
    scenario_names as scenario_names,
    listed_scenarios as listed_scenarios,
)
from .scores import (
    RecordingsScore as RecordingsScore,
    TrialScore as TrialScore,
    gather as gather,
    score as score,
)
from .training import (
    Trained as Trained,
    check_onnx as check_onnx,
    export_policy as export_policy,
    film_of_training as film_of_training,
    train as train,
    write_onnx as write_onnx,
    write_training as write_training,
)
from .tuning import Tuned as Tuned, TunedFiles as TunedFiles, tune as tune, tune_into as tune_into
from .validations import validate as validate
