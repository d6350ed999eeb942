# ---
# jupyter:
#   jupytext:
#     text_representation: {extension: .py, format_name: percent}
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # My MJCF robot, tuned and driven
#
# You take a robot described by MuJoCo's XML (MJCF), drive it with controllers that nobody has tuned for it, tune one,
# and take its tip along a path. At the end a robot with fewer actuators than joints swings up.
#
# ## The robot
#
# Any XML with hinges, slides, motors and servos will do, a URDF too. Here it is an arm of two joints, written on the
# spot.

# %%
# %matplotlib inline
import json
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import equimus_ctrl as eq

folder = Path(tempfile.mkdtemp())
(folder / "arm.xml").write_text("""
<mujoco model="arm">
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="upper" pos="0 0 1">
      <joint name="shoulder" axis="0 -1 0" range="-120 120" damping="0.05" armature="0.01"/>
      <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.025" mass="0.8"/>
      <body name="fore" pos="0 0 -0.3">
        <joint name="elbow" axis="0 -1 0" range="-5 140" damping="0.03" armature="0.008"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.25" size="0.02" mass="0.5"/>
        <site name="tip" pos="0 0 -0.25"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="shoulder_motor" joint="shoulder" ctrlrange="-12 12"/>
    <motor name="elbow_motor" joint="elbow" ctrlrange="-6 6"/>
  </actuator>
  <keyframe><key name="ready" qpos="0.5 0.9"/></keyframe>
</mujoco>
""")
arm = eq.load_model(folder / "arm.xml")
print("joints:   ", *arm.robot.joint_names)
print("actuators:", *arm.robot.actuator_names)

# %% [markdown]
# ## Driven at once
#
# Where nobody has tuned gains, they follow from the robot: the PID's poles are placed as fast as the control period and
# the usual dead time of drives allow, the LQR's and NMPC's weights follow from ranges and limits (Bryson's rule).
# `step` moves each joint by a step from the keyframe.

# %%
placed = eq.run_scenario("step", "pid", model=arm)
shoulder, elbow = 1e3 * placed.score.tracking.rmse
print(f"RMSE: shoulder {shoulder:.1f}, elbow {elbow:.1f} mrad")


# %%
def shown(runs, title):
    joints = len(next(iter(runs.values())).run.spec.joints)
    figure, axes = plt.subplots(
        1, joints, figsize=(9, 3), layout="constrained", squeeze=False
    )
    for k, axis in enumerate(axes[0]):
        for name, done in runs.items():
            axis.plot(
                done.run.time, np.degrees(done.run.position[:, k]), label=name
            )
        axis.plot(
            done.run.time,
            np.degrees(done.run.reference[:, k]),
            "k--",
            linewidth=1,
            label="reference",
        )
        axis.set(xlabel="time [s]", ylabel=f"{done.run.spec.joints[k]} [°]")
    lines = axes[0, 0].get_legend_handles_labels()
    figure.legend(*lines, loc="outside lower center", ncols=3)
    figure.suptitle(title)


shown({"placed gains": placed}, "A PID whose gains nobody has tuned")

# %% [markdown]
# ## Tuned
#
# `autotune` searches a controller's settings on an ensemble of robots that differ from the model as real ones do: other
# masses, other friction, drives that are late. Settings that are unstable on any of them can never be the result. Eight
# candidates are few; they show how it goes. Settings, a record and figures are written into a folder.

# %%
where = {"folder": folder / "tuning", "output": folder / "pid.toml"}
tuned = eq.tune(
    "pid", model=arm, scenarios=["track"], candidates=8, seed=7, workers=1, **where
)
print(f"{'':15s}   first   tuned")
for what, first, best in tuned.result.found()[2]:
    print(f"{what:15s} {first:7.3g} {best:7.3g}")
unseen = json.loads(tuned.record.read_text())["unseen"]
print("median cost on robots never tuned on:")
print(f"first {unseen['start_median']:.4f}, tuned {unseen['median']:.4f}")

# %% [markdown]
# With these settings, noise of 1 mrad on the angles and a dead time of 20 ms in the shoulder's drive that the
# controller does not know of:

# %%
late = [eq.TransportDelay("shoulder_motor", delay=0.02)]
runs = {
    "placed gains": eq.run_scenario(
        "track", "pid", model=arm, effects=late, noise=1e-3
    ),
    "tuned": eq.run_scenario(
        "track",
        "pid",
        model=arm,
        effects=late,
        noise=1e-3,
        settings=folder / "pid.toml",
    ),
}
figure, axes = plt.subplots(1, 2, figsize=(9, 3), sharey=True, layout="constrained")
for k, axis in enumerate(axes):
    for name, done in runs.items():
        axis.plot(
            done.run.time,
            1e3 * (done.run.truth - done.run.reference)[:, k],
            label=name,
        )
    axis.set(
        xlabel="time [s]",
        ylabel="tracking error [mrad]",
        title=arm.robot.joint_names[k],
    )
lines = axes[0].get_legend_handles_labels()
figure.legend(*lines, loc="outside lower center", ncols=2)
print("RMSE of shoulder / elbow [mrad]")
for name, done in runs.items():
    shoulder, elbow = 1e3 * done.score.tracking.rmse
    print(f"{name:12s} {shoulder:5.1f} / {elbow:5.1f}")

# %% [markdown]
# ## The tip along a triangle
#
# `track` takes a site along a path. Where the path lies and how large it is follows from what the site can reach,
# unless you say so.

# %%
options = {"site": "tip", "shape": "triangle"}
path = eq.run_scenario(
    "track",
    "pid",
    model=arm,
    effects=late,
    noise=1e-3,
    settings=folder / "pid.toml",
    options=options,
)
off = 1e3 * path.score.site.rmse[0]
print(f"RMSE of the tip's distance from its path: {off:.2f} mm")

# %% [markdown]
# ## Fewer actuators than joints
#
# A pole on a cart: one motor, two joints. Sampling MPC rolls plans out in MuJoCo, swings the pole up and balances it.

# %%
examples = next(
    place
    for place in (Path("docs/examples"), Path("../examples"))
    if place.is_dir()
)
cart = eq.load_model(examples / "cartpole.xml")
swing = eq.run_scenario(
    "swing_up",
    "sampling",
    model=cart,
    noise=1e-3,
    seed=1,
    options={"duration": "4"},
)
figure, axis = plt.subplots(figsize=(9, 3), layout="constrained")
axis.plot(swing.run.time, np.degrees(swing.run.position[:, 1]), label="pole [°]")
axis.plot(swing.run.time, 100 * swing.run.position[:, 0], label="cart [cm]")
axis.axhline(0, color="k", linewidth=0.8)
axis.set(xlabel="time [s]", title="Swing-up of a cart-pole: upright is 0°")
_ = axis.legend()

# %% [markdown]
# ## From the command line
#
# ```sh
# equimus-ctrl run step --model arm.xml --controller pid
# equimus-ctrl autotune pid --model arm.xml --scenario track
# equimus-ctrl run track --model arm.xml --set site=tip --set shape=triangle --video arm.gif
# equimus-ctrl compare hold step --model arm.xml
# ```
#
# Next: record the robot, and find out what its model lacks ([from a log to an augmented model](my_log.py)).
