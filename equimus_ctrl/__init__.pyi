# What `import equimus_ctrl as eq` offers; read at run time too, so this list is the only one.
from . import testing as testing
from .controllers.lqr import LqrController as LqrController, LqrSettings as LqrSettings
from .controllers.nmpc import NmpcController as NmpcController, NmpcSettings as NmpcSettings
from .controllers.open_loop import OpenLoopController as OpenLoopController
from .controllers.pid import PidController as PidController
from .controllers.pid_settings import PidGains as PidGains, PidSettings as PidSettings
from .controllers.registry import (
    ControllerEntry as ControllerEntry,
    ControllerRequest as ControllerRequest,
    register_controller as register_controller,
)
from .controllers.sampling import SamplingController as SamplingController
from .controllers.sampling_settings import SamplingSettings as SamplingSettings
from .controllers.search_space import Range as Range, SearchSpace as SearchSpace
from .effects import (
    AsymmetricLag as AsymmetricLag,
    Backlash as Backlash,
    BodyEffect as BodyEffect,
    CoulombFriction as CoulombFriction,
    Creep as Creep,
    Curve as Curve,
    Cutoff as Cutoff,
    DeadZone as DeadZone,
    Effect as Effect,
    FillingFlow as FillingFlow,
    FirstOrderLag as FirstOrderLag,
    ForceEffect as ForceEffect,
    GravityTilt as GravityTilt,
    Hysteresis as Hysteresis,
    NarrowingArea as NarrowingArea,
    NonlinearStiffness as NonlinearStiffness,
    ParallelSpring as ParallelSpring,
    PayloadMass as PayloadMass,
    PayloadOffCentre as PayloadOffCentre,
    RateLimit as RateLimit,
    Saturation as Saturation,
    SensorDelay as SensorDelay,
    SensorEffect as SensorEffect,
    SensorOffset as SensorOffset,
    SensorScale as SensorScale,
    ShapingEffect as ShapingEffect,
    Share as Share,
    Size as Size,
    StribeckFriction as StribeckFriction,
    SupplyCoupling as SupplyCoupling,
    Description as Description,
    TransportDelay as TransportDelay,
    ValveEffect as ValveEffect,
    parameter as parameter,
    register as register,
)
from .engines.batch import simulate as simulate
from .engines.mujoco_batch import MujocoBatch as MujocoBatch
from .engines.trials import Trial as Trial
from .engines.predict import measured_start as measured_start, predict as predict
from .errors import (
    ConfigError as ConfigError,
    ControllerError as ControllerError,
    EquimusError as EquimusError,
    ModelError as ModelError,
    NotAvailable as NotAvailable,
    RecordingError as RecordingError,
    SimulationDiverged as SimulationDiverged,
)
from .estimation.observer import Observer as Observer, ObserverSettings as ObserverSettings
from .models.accelerations import accelerations as accelerations
from .learning.randomisation import Draws as Draws
from .learning.settings import EnvSettings as EnvSettings, KickSettings as KickSettings
from .learning.tasks import Task as Task
from .models.ball import Ball as Ball, add_ball as add_ball
from .models.kinematics import Kinematics as Kinematics
from .models.mjcf import (
    SolverSettings as SolverSettings,
    add_elastic_actuator as add_elastic_actuator,
    build_spec as build_spec,
    close_elements as close_elements,
    compile_model as compile_model,
)
from .models.model import Model as Model, nominal_model as nominal_model
from .models.symbolic import symbolic_model as symbolic_model
from .options import (
    AutotuneOptions as AutotuneOptions,
    CheckOptions as CheckOptions,
    CompareOptions as CompareOptions,
    DesignOptions as DesignOptions,
    DiagnoseOptions as DiagnoseOptions,
    ExportOptions as ExportOptions,
    IdentifyOptions as IdentifyOptions,
    ProveOptions as ProveOptions,
    RunExperimentsOptions as RunExperimentsOptions,
    ScoreOptions as ScoreOptions,
    SensitivityOptions as SensitivityOptions,
    TrainOptions as TrainOptions,
    Shard as Shard,
    ValidateOptions as ValidateOptions,
)
from .plants.batch import BatchPlant as BatchPlant
from .plants.events import Load as Load, PointForce as PointForce, Push as Push
from .plants.hardware.plant import HardwarePlant as HardwarePlant
from .plants.hardware.settings import HardwareSettings as HardwareSettings
from .plants.mujoco_plant import MujocoPlant as MujocoPlant, PlantRates as PlantRates
from .plants.registry import (
    PlantEntry as PlantEntry,
    PlantRequest as PlantRequest,
    register_plant as register_plant,
)
from .plants.replay import ReplayPlant as ReplayPlant
from .recordings import (
    Mapping as Mapping,
    StaticPoses as StaticPoses,
    read_mapping as read_mapping,
    read_static_poses as read_static_poses,
)
from .robots.base import Robot as Robot, RobotTraits as RobotTraits
from .robots.elastic.leg import ideal_leg as ideal_leg, nominal_leg as nominal_leg
from .robots.elastic.morphology import (
    ElasticActuator as ElasticActuator,
    Joint as Joint,
    JointStop as JointStop,
    Link as Link,
    Morphology as Morphology,
    Point as Point,
)
from .robots.mjcf.robot import MjcfRobot as MjcfRobot
from .robots.reading import shown_pose as shown_pose
from .scenarios.comparison import Condition as Condition
from .scenarios.references import (
    FunctionReference as FunctionReference,
    HoldReference as HoldReference,
    SampledReference as SampledReference,
    foot_path as foot_path,
    joint_path as joint_path,
    minimum_jerk as minimum_jerk,
    pose_of_foot as pose_of_foot,
    poses_of_foot as poses_of_foot,
)
from .scenarios.registry import register_scenario as register_scenario
from .scenarios.scenario import (
    Arrival as Arrival,
    CommandProfile as CommandProfile,
    Scenario as Scenario,
    ScenarioContext as ScenarioContext,
)
from .scenarios.scoring import Score as Score, score_run as score_run
from .loop import run as run
from .types import (
    Controller as Controller,
    Observation as Observation,
    Plant as Plant,
    PlantSpec as PlantSpec,
    Recording as Recording,
    Reference as Reference,
    Run as Run,
    Start as Start,
)
from .identification.estimates import Covariance as Covariance, TrialResiduals as TrialResiduals
from .workflow import (
    check as check,
    check_hardware as check_hardware,
    check_recordings as check_recordings,
    compare as compare,
    design_experiment as design_experiment,
    diagnose as diagnose,
    export_model as export_model,
    export_policy as export_policy,
    export_recordings as export_recordings,
    fetch_recordings as fetch_recordings,
    figure as figure,
    figures as figures,
    identify as identify,
    identify_poses as identify_poses,
    identify_recordings as identify_recordings,
    linearise as linearise,
    list_names as list_names,
    load_hardware as load_hardware,
    load_model as load_model,
    load_plugins as load_plugins,
    make_env as make_env,
    make_sb3_env as make_sb3_env,
    make_vec_env as make_vec_env,
    measure_delay as measure_delay,
    prove as prove,
    read_recording as read_recording,
    read_recordings as read_recordings,
    run_experiments as run_experiments,
    run_scenario as run_scenario,
    save_model as save_model,
    score as score,
    sensitivity as sensitivity,
    train as train,
    tune as tune,
    validate as validate,
    write_design as write_design,
    write_recording as write_recording,
    write_recordings as write_recordings,
    write_report as write_report,
    write_video as write_video,
)

__version__: str
