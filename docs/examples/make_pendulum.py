"""Recordings of a pendulum with physics that its model does not have: ``python docs/examples/make_pendulum.py``.

They are simulated, with 1 mrad of noise, and stand in ``docs/examples/pendulum``.
"""

from pathlib import Path

import numpy as np

from equimus_ctrl import workflow
from equimus_ctrl.effects import CoulombFriction
from equimus_ctrl.engines.mjcf import simulate_mjcf
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.models.model import Model
from equimus_ctrl.recordings import write
from equimus_ctrl.types import Recording

HERE = Path(__file__).resolve().parent
NOISE = 1e-3

robot = workflow.load_mjcf(HERE / "pendulum.xml")
real = Model(robot, (CoulombFriction("hinge", 0.1),))
rng = np.random.default_rng(7)
time = np.arange(0, 5, 0.01)
for k in range(4):
    f, size, start = rng.uniform(0.3, 0.9), rng.uniform(0.6, 1.4), rng.uniform(-1.2, 1.2)
    torque = size * np.sin(2 * np.pi * f * time) + 0.3 * size * np.sin(2 * np.pi * 2.3 * f * time + k)
    trial = Trial(f"run_{k + 1}", time, torque[:, None], torque[:1], 0.0, np.array([start]), time)
    angle = simulate_mjcf([real], [trial], threads=1)[0].position[0] + rng.normal(0, NOISE, (len(time), 1))
    notes = {"source": "docs/examples/make_pendulum.py"}
    recording = Recording(
        trial.name, time.round(6), torque[:, None].round(6), angle.round(6), ("motor",), ("hinge",), notes=notes
    )
    write(HERE / "pendulum" / f"{trial.name}.csv", recording)
