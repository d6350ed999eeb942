# ---
# jupyter:
#   jupytext:
#     text_representation: {extension: .py, format_name: percent}
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # The EquiMus leg, from paper to augmented model
#
# Zhu et al. ("EquiMus", 2025) published a pneumatic leg of two joints and two linear elastic actuators: a
# mono-articular one (MAA) across the hip, and a bi-articular one (BAA) across hip and knee. They also published a model
# of it and recordings. You look at the model, compare it with the recordings, find a law that a leg's model lacks, and
# drive with the augmented model.
#
# ## The published model

# %%
# %matplotlib inline
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import equimus_ctrl as eq
from equimus_ctrl.recordings.locate import leg_file
from equimus_ctrl.report.diagnosis_sentences import sentence

leg = eq.nominal_model()
print("mass, stiffness, area")
for own in leg.robot.actuators:
    area = 1e4 * own.area
    print(f"{own.name}: {own.mass:g} kg, {own.stiffness:g} N/m, {area:.2f} cm²")

# %% [markdown]
# Two models are made of this one description: a MuJoCo model whose actuators are 3-2-1 elements, which have the energy
# of real elastic rods, and the exact equations of motion, compiled. A sweep of pressures simulated by the first is
# predicted by the second to about a microradian:

# %%
folder = Path(tempfile.mkdtemp())
eq.run_scenario("chirp", record=folder / "sweep.csv", options={"duration": "8"})
hip, knee = 1e6 * eq.score(folder / "sweep.csv").rmse
print(f"RMSE: hip {hip:.2f}, knee {knee:.2f} µrad")

# %% [markdown]
# ## Beside the real leg
#
# The recordings are not part of this project. `equimus-ctrl recordings fetch` gets them, `EQUIMUS_RECORDINGS` names
# their folder.

# %%
triangle = leg_file("triangle")
if triangle is None:
    print(
        "The recordings are not here, so this cell shows nothing; the page on the real leg has its figures."
    )
else:
    trial = eq.read_recording(triangle, leg)
    predicted = eq.predict(leg, trial)
    error = trial.position - predicted
    hip, knee = 1e3 * np.sqrt(np.mean(error**2, axis=0))
    print(f"RMSE: hip {hip:.0f}, knee {knee:.0f} mrad")
    figure, axes = plt.subplots(1, 2, figsize=(9, 3), layout="constrained")
    for k, axis in enumerate(axes):
        axis.plot(trial.time, np.degrees(trial.position[:, k]), label="measured")
        axis.plot(trial.time, np.degrees(predicted[:, k]), label="model")
        axis.set(xlabel="time [s]", ylabel=f"{trial.joints[k]} [°]")
    figure.legend(
        *axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=2
    )

# %% [markdown]
# The model follows, late and with other amplitudes. What it lacks are laws of the valves: a threshold below which they
# stay shut, a flow that limits filling, dead times. That diagnosis takes minutes and is told in [the real
# leg](../real_leg.md).
#
# ## Find a missing law
#
# So that the answer can be compared with the truth, the leg here is a simulated one: its BAA's valve loses the first 4
# kPa of every command, and its angles are measured with 2 mrad of noise. The diagnosis is told nothing of that.

# %%
dead_zone = eq.DeadZone("baa", threshold=4000.0)
eq.run_scenario(
    "chirp",
    effects=[dead_zone],
    noise=2e-3,
    record=folder / "unknown.csv",
    options={"duration": "12"},
)
found = eq.diagnose(folder / "unknown.csv", threads=1)
print("verdict:", found.verdict)
for finding in found.findings:
    print(sentence(finding, found.model))

# %%
eq.figure(found, "summary")

# %% [markdown]
# ## Drive with the augmented model
#
# The same PID leads the foot round a circle on the leg with the dead zone: once it computes with the initial model,
# once with the augmented one. Drawn and scored is the circle, without the way to it.

# %%
options = {"duration": "8"}
runs = {
    "knows the initial model": eq.run_scenario(
        "foot_circle", "pid", effects=[dead_zone], options=options
    ),
    "knows the augmented model": eq.run_scenario(
        "foot_circle",
        "pid",
        effects=[dead_zone],
        nominal=found.corrected,
        options=options,
    ),
}
figure, axes = plt.subplots(1, 2, figsize=(9, 3), sharey=True, layout="constrained")
print("RMSE of hip / knee [mrad]")
for name, done in runs.items():
    hip, knee = 1e3 * done.score.tracking.rmse
    print(f"{name}: {hip:.1f} / {knee:.1f}")
    circle = done.run.time >= done.score.window[0]
    for k, axis in enumerate(axes):
        axis.plot(
            done.run.time[circle],
            1e3 * (done.run.position - done.run.reference)[circle, k],
            label=name,
        )
        axis.set(
            xlabel="time [s]",
            ylabel="tracking error [mrad]",
            title=done.run.spec.joints[k],
        )
_ = axes[0].legend()

# %% [markdown]
# ## From the command line
#
# ```sh
# equimus-ctrl run triangle                       # scored like the paper, where recordings are at hand
# equimus-ctrl run chirp --effect dead_zone:baa:threshold=4000 --noise 0.002 --record unknown
# equimus-ctrl diagnose unknown --report report --write-model augmented.toml
# equimus-ctrl run foot_circle --effect dead_zone:baa:threshold=4000 --controller pid --nominal augmented.toml
# ```
