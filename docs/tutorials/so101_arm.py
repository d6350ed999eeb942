# ---
# jupyter:
#   jupytext:
#     text_representation: {extension: .py, format_name: percent}
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # An SO-101
#
# You have a servo arm of five joints, its published model, and recordings of goals and positions. You estimate the
# servos' real stiffness, damping and friction, and see how much better the model predicts motions that were not fitted.
#
# The recordings are those of a real SO-101 (`isaac-sim2real/sage`, Apache-2.0), twelve motions of one to two minutes.
# They are not part of this project: this page reads them from the folder that `EQUIMUS_RECORDINGS` names, or from
# `../shared/recordings` beside the checkout. Yours go in their place: how to record them stands in [an
# SO-101](../so101.md#your-own-arm).

# %%
# %matplotlib inline
import warnings

import matplotlib.pyplot as plt
import numpy as np

import equimus_ctrl as eq
from equimus_ctrl.recordings.checks import RecordingWarning
from equimus_ctrl.recordings.locate import find_recordings

folder = find_recordings()
so101 = (
    folder / "so101" if folder is not None and (folder / "so101").is_dir() else None
)
if so101 is None:
    print("The recordings are not here, so the cells")
    print("below show nothing: name a folder that has")
    print("so101/ in it by EQUIMUS_RECORDINGS. What they")
    print("show is told in the page on the SO-101.")

# %% [markdown]
# ## The published model
#
# `so101.xml` is the published model without meshes. Its servos have a stiffness of 998 N·m/rad by its authors'
# estimate: every joint is where its goal is. The first 20 s of three motions are looked at here, and a fourth one
# judges.

# %%
LOOKED_AT = ["friction_gravity", "step_response", "velocity_ramp"]
JUDGING = "single_joint_wrist_pitch"
if so101 is not None:
    warnings.simplefilter("ignore", RecordingWarning)  # of currents, not compared
    model = eq.load_model(so101 / "so101.xml")
    joints = model.robot.joint_names
    trials = [eq.read_recording(so101 / f"{name}.csv", model) for name in LOOKED_AT]
    judging = eq.read_recording(so101 / f"{JUDGING}.csv", model)
    for trial in (*trials, judging):
        print(f"{trial.name:25s} {trial.time[-1]:5.1f} s")

# %% [markdown]
# ## Refit the servos
#
# A diagnosis refits the model's own parameters before it looks for anything else. How far joints stay behind their
# goals tells it that the servos are far softer than the model says, so their stiffness is estimated too; masses are
# taken to be known. Here it is ended by a budget of 50 s, so its verdict is *unfinished*; the refit is done by then.

# %%
if so101 is not None:
    found = eq.diagnose(
        trials,
        model,
        validation=["velocity_ramp"],
        window=(0, 20),
        budget=50,
        most=1,
        threads=1,
    )
    print("verdict:", found.verdict)
    published = model.robot.parameters()
    print("published → refitted (95 % interval)")
    for name, one in found.to_dict()["parameters"].items():
        none = None in (one["low"], one["high"])
        ends = "none" if none else f"{one['low']:.3g} to {one['high']:.3g}"
        print(f"{name} [{one['unit']}]")
        print(f"    {published[name]:.3g} → {one['value']:.3g} ({ends})")

# %% [markdown]
# Intervals hold for noise and for what these motions excite, not for physics that the model lacks: nothing loads the
# wrist's roll, so its stiffness is not identifiable, and rotor inertias show in quick motions alone. Other motions give
# values that differ by more than the intervals ([six against six](../so101.md#six-motions-against-the-other-six)).
#
# ## A motion that was not fitted

# %%
if so101 is not None:
    figure, axes = plt.subplots(
        2, 1, figsize=(9, 5), sharex=True, layout="constrained"
    )
    shown = joints.index("wrist_flex")
    seen = judging.time < 40
    time = judging.time[seen]
    measured = judging.position
    axes[0].plot(
        time, np.degrees(measured[seen, shown]), "k", linewidth=1, label="measured"
    )
    models = {"published": model, "refitted": found.refitted}
    rmse = {}
    for name, one in models.items():
        predicted = eq.predict(one, judging)
        rmse[name] = 1e3 * np.sqrt(((measured - predicted) ** 2).mean(axis=0))
        axes[0].plot(
            time, np.degrees(predicted[seen, shown]), linewidth=1, label=name
        )
        axes[1].plot(
            time, 1e3 * (measured - predicted)[seen, shown], linewidth=1, label=name
        )
    axes[0].set(
        ylabel="wrist_flex [°]",
        title=f"{judging.name}, simulated whole from its first row",
    )
    axes[1].set(xlabel="time [s]", ylabel="residual [mrad]")
    lines = axes[0].get_legend_handles_labels()
    figure.legend(*lines, loc="outside lower center", ncols=3)
    print("RMSE [mrad]  ", *models)
    for k, joint in enumerate(joints):
        errors = "".join(f"{rmse[name][k]:10.1f}" for name in models)
        print(f"{joint:13s}{errors}")

# %% [markdown]
# ## What else is missing
#
# With all twelve motions and some minutes, `diagnose` finds the table that the gripper touches, and says what it cannot
# explain ([an SO-101](../so101.md)).
#
# ```sh
# equimus-ctrl check so101 --model so101.xml
# equimus-ctrl diagnose so101 --model so101.xml --budget 540 --report report --write-model augmented.toml
# ```
