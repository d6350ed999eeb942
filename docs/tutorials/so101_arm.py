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
so101 = folder / "so101" if folder is not None and (folder / "so101").is_dir() else None
if so101 is None:
    print("The recordings are not here, so the cells below show nothing: name a folder that has so101/ in it by")
    print("EQUIMUS_RECORDINGS. What they show is told in the page on the SO-101 under Evidence.")

# %% [markdown]
# ## The published model
#
# `so101.xml` is the published model without meshes. Its servos have a stiffness of 998 N·m/rad by its authors'
# estimate: every joint is where its goal is. Three motions are fitted, one judges; each is cut to some seconds, to keep
# this page short.

# %%
FITTED, JUDGING = ["friction_gravity", "step_response", "single_joint_rotation"], "single_joint_wrist_pitch"
if so101 is not None:
    model = eq.load_model(so101 / "so101.xml")
    joints = model.robot.joint_names
    fitted = [eq.read_recording(so101 / f"{name}.csv", model) for name in FITTED]
    judging = eq.read_recording(so101 / f"{JUDGING}.csv", model)
    for trial in (*fitted, judging):
        print(f"{trial.name:26s} {trial.time[-1]:6.1f} s, {len(trial.time)} rows")

# %% [markdown]
# ## Identify the servos
#
# Masses are taken to be known, and the motors' currents, which were recorded too, are not compared. Free are each
# servo's stiffness `kp` and damping and each joint's dry friction. Trials are cut into intervals with free initial
# states (multiple shooting), because errors grow along a motion.

# %%
if so101 is not None:
    free = ["*.kp", "*.damping", "*.frictionloss"]
    warnings.simplefilter("ignore", RecordingWarning)  # of columns that are not compared
    bounds = {f"{joint}.kp": (2.0, 1000.0) for joint in joints}
    found = eq.identify_recordings(fitted, model, free=free, bounds=bounds, window=(0.0, 20.0), folds=0, threads=1)
    for row in found.to_dict()["parameters"]:
        ends = "no interval" if None in (row["low"], row["high"]) else f"{row['low']:.3g} to {row['high']:.3g}"
        print(f"{row['name']:26s} published {row['start']:6.3g}, identified {row['value']:6.3g} ({ends}) {row['unit']}")

# %% [markdown]
# An interval is honest about noise and about what these motions excite, not about physics that the model lacks: the
# residuals of a servo arm are autocorrelated over seconds. Different motions give values that differ by more than the
# intervals ([six against six](../so101.md#six-motions-against-the-other-six)).
#
# ## A motion that was not fitted

# %%
if so101 is not None:
    own = {"published": model, "identified": found.fit.model}
    figure, axes = plt.subplots(2, 1, figsize=(9, 5), sharex=True, layout="constrained")
    shown = joints.index("wrist_flex")
    seen = judging.time < 40
    axes[0].plot(judging.time[seen], np.degrees(judging.position[seen, shown]), "k", linewidth=1, label="measured")
    for name, one in own.items():
        predicted = eq.predict(one, judging)
        error = judging.position - predicted
        print(f"{name:11s} RMSE {(1e3 * np.sqrt((error**2).mean(axis=0))).round(1)} mrad")
        axes[0].plot(judging.time[seen], np.degrees(predicted[seen, shown]), linewidth=1, label=name)
        axes[1].plot(judging.time[seen], 1e3 * error[seen, shown], linewidth=1, label=name)
    axes[0].set(ylabel="wrist_flex [°]", title=f"{judging.name}, simulated whole from its first row")
    axes[1].set(xlabel="time [s]", ylabel="residual [mrad]")
    axes[0].legend()

# %% [markdown]
# ## What else is missing
#
# `diagnose` goes on from here: it finds the table that the gripper touches, and says what it cannot explain. With all
# twelve motions it takes minutes ([an SO-101](../so101.md)).
#
# ```sh
# equimus-ctrl check so101 --model so101.xml
# equimus-ctrl diagnose so101 --model so101.xml --budget 540 --report report --write-model augmented.toml
# ```
