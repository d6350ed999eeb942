# ---
# jupyter:
#   jupytext:
#     text_representation: {extension: .py, format_name: percent}
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # My controller
#
# You write a controller in ten lines, run it on the EquiMus leg, find out what it cannot do, mend that, and compare it
# with the PID. It sees joint angles, at the sensor's rate and with its noise, and gives one pressure an actuator.
#
# ## The smallest one
#
# A controller has two methods. `init` gets a description of the plant (`spec`) and the first observation, and returns
# whatever the controller remembers. `step` returns a command and what is remembered next. This one holds the reference
# by the pressures that balance gravity and the actuators' stiffness there: feed-forward, without any feedback.

# %%
# %matplotlib inline
import matplotlib.pyplot as plt
import numpy as np

import equimus_ctrl as eq


class FeedForward:
    def init(self, spec, observation):
        return eq.Kinematics(spec.model, spec.phase)

    def step(self, observation, reference, kinematics):
        wanted = reference.position(observation.time)
        return kinematics.static_pressure(wanted), kinematics


done = eq.run_scenario("hold", FeedForward, options={"hip": "80", "knee": "30"})
hip, knee = 1e3 * done.score.tracking.rmse
print(f"RMSE: hip {hip:.1f}, knee {knee:.1f} mrad")


# %% [markdown]
# `hold` brings the leg to a pose and keeps it there. How that went is in `done.run`: times, true and measured angles,
# commands, the reference.


# %%
def shown(runs, title):
    figure, axes = plt.subplots(
        1, 2, figsize=(9, 3), sharex=True, layout="constrained"
    )
    for k, joint in enumerate(("hip", "knee")):
        for name, done in runs.items():
            axes[k].plot(
                done.run.time, np.degrees(done.run.position[:, k]), label=name
            )
        axes[k].plot(
            done.run.time,
            np.degrees(done.run.reference[:, k]),
            "k--",
            linewidth=1,
            label="reference",
        )
        axes[k].set(xlabel="time [s]", ylabel=f"{joint} [°]")
    lines = axes[0].get_legend_handles_labels()
    figure.legend(*lines, loc="outside lower center", ncols=3)
    figure.suptitle(title)


shown({"feed-forward": done}, "No error is seen, so none is corrected")

# %% [markdown]
# On a leg that is as the model says, feed-forward gets there. A real one never is. With a payload of 100 g at the foot,
# which no controller is told of, it does not:

# %%
load = eq.PayloadMass("foot", mass=0.1)
pose = {"hip": "80", "knee": "30"}
loaded = eq.run_scenario("hold", FeedForward, effects=[load], options=pose)
hip, knee = 1e3 * loaded.score.tracking.rmse
print(f"RMSE: hip {hip:.1f}, knee {knee:.1f} mrad")

# %% [markdown]
# ## Feedback
#
# Each actuator gets more pressure in proportion to the length that is missing, and to the integral of that. The
# integral is what evolves, so it lives in the state, and a run can be repeated bit for bit. While a command is beyond
# what the valves give, the integral waits (anti-windup).


# %%
class Spring:
    stiffness = 300.0  # N per metre of missing length
    rate = 600.0  # N/s per metre

    def init(self, spec, observation):
        limits = spec.command_low, spec.command_high
        return (
            eq.Kinematics(spec.model, spec.phase),
            limits,
            np.zeros(2),
            observation.time,
        )

    def step(self, observation, reference, state):
        kinematics, (low, high), integral, before = state
        wanted = reference.position(observation.time)
        missing = kinematics.lengths(wanted) - kinematics.lengths(
            observation.position
        )
        area = np.array(
            [actuator.area for actuator in kinematics.morphology.actuators]
        )
        command = (
            kinematics.static_pressure(wanted)
            + (self.stiffness * missing + integral) / area
        )
        free = (command > low) & (command < high)
        integral = integral + free * self.rate * missing * (
            observation.time - before
        )
        return command, (kinematics, (low, high), integral, observation.time)


sprung = eq.run_scenario("hold", Spring, effects=[load], options=pose)
shown(
    {"feed-forward": loaded, "with feedback": sprung},
    "100 g at the foot that the model does not have",
)

# %% [markdown]
# ## Does it keep what plants expect?
#
# `check_controller` drives a plant with it and says what it keeps to, or raises an error that says what it does not: a
# finite command for each actuator, the same from the same state, an answer to measurements that are late or missing.

# %%
checked = eq.testing.check_controller(Spring)
print(*checked.kept, sep="\n")
print("notes:", *checked.notes, sep="\n- ")

# %% [markdown]
# ## Beside the PID
#
# `compare` drives all through the same scenario under the same conditions: with noise, with perturbed legs, with a dead
# time between a command and its pressure. Errors are of the true angles, here while the foot goes round a circle.

# %%
conditions = ["nominal", "noisy", "perturbed", "unmodelled_delay"]
found = eq.compare(
    ["foot_circle"],
    [FeedForward, Spring, "pid"],
    conditions,
    draws=1,
    scenario_options={"duration": "8"},
)
print("RMSE of hip / knee [mrad]")
for condition in conditions:
    print(condition)
    for entry in found.entries:
        if entry.condition == condition:
            error = entry.failure or "{:5.1f} / {:5.1f}".format(
                *(1e3 * entry.error.rmse)
            )
            print(f"  {entry.controller:11s} {error}")

# %% [markdown]
# Feedback lowers what feed-forward leaves, and the PID is far ahead of both on the model it knows: it feeds forward the
# forces that the motion needs, not only those of rest, and its gains were tuned on an ensemble of perturbed legs. A
# dead time that it does not know of costs it most of that lead.
#
# ## From the command line
#
# The same class in a file, say `mine.py`, takes part in every verb:
#
# ```sh
# equimus-ctrl run triangle --controller mine.py:Spring --noise 0.001
# equimus-ctrl compare triangle -c mine.py:Spring -c pid
# ```
#
# Where to go from here: observers ([the control laws](../control_laws.md#the-observer)), velocities
# ([control](../control.md#a-controller-that-senses-more)), a controller with settings that
# `autotune` can search ([extending](../../CONTRIBUTING.md#a-controller)).
