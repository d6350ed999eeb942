"""Control, simulation, identification and mismatch diagnosis of robots on MuJoCo.

Ten things to begin with (``import equimus_ctrl as eq``):

>>> model = eq.load_model("docs/examples/pendulum.xml")  # the EquiMus leg by default; any MJCF, URDF or model file
>>> trials = eq.read_recordings("docs/examples/pendulum", model)  # CSV, bags, MCAP, LeRobot, npz
>>> eq.check(trials, model, quick=True)  # what they are like, and what they could show
<Check of 4 recordings with pendulum: ...>
>>> eq.score(trials, model)  # how well the model predicts them
<RecordingsScore of pendulum on 4 trials: RMSE hinge ... mrad, fitted starts>
>>> found = eq.identify(trials, model, free=["*.damping"], folds=0)  # parameters, intervals, covariance, residuals
>>> found.covariance
<Covariance of 1 parameter: standard errors hinge.damping ...>
>>> diagnosis = eq.diagnose(trials, model, most=1)  # the physics that the model lacks
>>> diagnosis.corrected  # the augmented model, for all of these
<Model pendulum: 1 joint (hinge), 1 actuator (motor), 1 effect (... at hinge)>
>>> eq.run_scenario("hold", "pid")  # a controller in closed loop, scored
<ScenarioRun hold by pid on nominal_leg (mujoco), ...: tracking RMSE hip ..., knee ... rad, saturated ... %>
>>> eq.sensitivity(trials, model)  # which parameters matter to its predictions
<Sensitivity of pendulum to ... parameters: most to ...>
>>> eq.linearise(model)  # A, B, C and poles; .system for python-control
<Linearised of pendulum: 2 states, 1 input, 1 output; poles with real parts from ... to ... 1/s>
>>> eq.figure(diagnosis, "residuals")  # matplotlib; nothing is shown or written
<Figure size ... with ... Axes>
>>> table = found.to_dataframe()  # pandas; .to_dict() for JSON

Other verbs of the command ``equimus-ctrl``: ``eq.tune``, ``eq.compare``, ``eq.validate``, ``eq.prove``,
``eq.design_experiment``, ``eq.run_experiments``, ``eq.train``, ``eq.export_model``, ``eq.list_names``. Results are
frozen and show themselves in a line. Files are written where a place is named and nowhere else; what is there already
is replaced with ``force=True`` alone.
"""

from typing import Any

import lazy_loader as _lazy

__version__ = "0.1.0"

# Imported on first use: the command line answers --help without loading MuJoCo, CasADi and numba.
_offered, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
FORMER = {
    "diagnose_recordings": "diagnose",
    "score_recordings": "score",
    "sensitivity_of": "sensitivity",
}
"""Former names, which work until version 1, and the functions that have them."""


def __getattr__(name: str) -> Any:
    return _offered(FORMER.get(name, name))
