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
# The recordings are those of a real SO-101 (`isaac-sim2real/sage`, Apache-2.0), twelve motions of one to two minutes. They
# are not part of this project: this page reads them from the folder that `EQUIMUS_RECORDINGS` names, or from
# `../shared/recordings` beside the checkout. Yours go in their place: how to record them stands in
# [an SO-101](../so101.md#your-own-arm).

# %%
import matplotlib.pyplot as plt
import numpy as np

import equimus_ctrl as eq
from equimus_ctrl.recordings.locate import find_recordings

folder = find_recordings()
so101 = folder / "so101" if folder is not None and (folder / "so101").is_dir() else None
if so101 is None:
    print("The recordings are not here, so the cells below show nothing: name a folder that has so101/ in it by")
    print("EQUIMUS_RECORDINGS. What they show is told in the page on the SO-101 under Evidence.")

# %% [markdown]
# ## The published model
#
# `so101.xml` is the published model without meshes. Its servos have a stiffness of 998 N·m/rad by its authors' estimate:
# every joint is where its goal is. Three motions are fitted, one judges; each is cut to some seconds, to keep this page short.

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
# Masses are taken to be known. Free are each servo's stiffness and damping and each joint's friction; trials are cut into
# intervals with initial states of their own (multiple shooting), because errors grow along a motion.

# %%
if so101 is not None:
    found = eq.identify_recordings(
        fitted, model, free=["*.kp", "*.damping", "*.frictionloss", "*.armature"], window=(0.0, 16.0), threads=1
    )
    for name, estimate in found.estimates.items():
        print(f"{name:30s} {estimate.value:9.4g} ({estimate.low:.4g} to {estimate.high:.4g})")
