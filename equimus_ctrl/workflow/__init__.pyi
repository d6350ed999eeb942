# What `equimus_ctrl.workflow` offers; read at run time too, so this list is the only one.
from .check import check as check
from .comparisons import compare as compare
from .diagnose import diagnose_recordings as diagnose_recordings
from .exports import (
    Export as Export,
    Written as Written,
    export_model as export_model,
    mjcf_of_model as mjcf_of_model,
)
from .hardware import (
    check_hardware as check_hardware,
    import_bag as import_bag,
    load_hardware as load_hardware,
    measure_delay as measure_delay,
    with_valve_delays as with_valve_delays,
)
from .identify import (
    identify_files as identify_files,
    identify_poses as identify_poses,
    identify_recordings as identify_recordings,
    sensitivity_of as sensitivity_of,
    simulator_of as simulator_of,
)
from .logs import (
    export_recordings as export_recordings,
    read_recording as read_recording,
    recorded_models as recorded_models,
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
from .prove import Proof as Proof, put_to_proof as put_to_proof
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
    score_recordings as score_recordings,
)
from .tuning import Tuned as Tuned, autotune as autotune, tune_pid as tune_pid
