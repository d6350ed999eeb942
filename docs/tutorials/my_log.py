# ---
# jupyter:
#   jupytext:
#     text_representation: {extension: .py, format_name: percent}
#   kernelspec: {display_name: Python 3, language: python, name: python3}
# ---

# %% [markdown]
# # From a log to an augmented model
#
# You have recordings of a robot and a model of it that does not fit. You check what the recordings can tell, diagnose
# which physics the model lacks, write the augmented model, and tune a controller on it.
#
# The robot is a pendulum with a motor. Its four recordings stand in `docs/examples/pendulum`: the motor's torque and
# the measured angle, 100 times a second. They are simulated (`make_pendulum.py` has what is missing from the model), so
# you can compare the answer with the truth. Logs of other programs (rosbag2, MCAP, LeRobot, CSV of any columns) are
# read in their place, see [logs](../logs.md).

# %%
# %matplotlib inline
import shutil
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt

import equimus_ctrl as eq
from equimus_ctrl.report.diagnosis_sentences import sentence
from equimus_ctrl.report.diagnosis_text import headline

examples = next(
    place
    for place in (Path("docs/examples"), Path("../examples"))
    if place.is_dir()
)
recordings = examples / "pendulum"
folder = Path(tempfile.mkdtemp())
shutil.copy(examples / "pendulum.xml", folder)
model = eq.load_model(folder / "pendulum.xml")

# %% [markdown]
# ## Check before anything else
#
# `check` fits nothing. It says what the recordings are like (clock, noise, dead times, clipping, rests) and which
# parameters and effects they could show at which size.

# %%
checked = eq.check(recordings, model, budget=10, threads=1)
for finding in checked.findings:
    print(f"{finding.severity}: {finding.sentence}")

# %%
checked.figure()

# %% [markdown]
# Right is the smallest size from which on each effect would be accepted: dry friction of some mN·m would show. A stop
# among the findings would mean that no answer can mean anything, and `diagnose` would refuse.
#
# ## Score the model as it is
#
# `score` predicts each recording from its own start, and compares.

# %%
before = eq.score(recordings, model)
print(f"RMSE of the initial model: {1e3 * before.rmse[0]:.1f} mrad")

# %% [markdown]
# ## Diagnose
#
# The diagnosis refits the model's own parameters first, so that a wrong mass is not called friction. Then it looks for
# effects that explain what is left, and accepts one only where it improves predictions of a held-out recording.

# %%
found = eq.diagnose(recordings, model, threads=1)
print(headline(found))
for finding in found.findings:
    print(sentence(finding, model))

# %%
figures = eq.figures(found)
figures["summary"]

# %%
figures["finding_1"]

# %% [markdown]
# ## Use the augmented model
#
# The augmented model is the refitted one with the effects found. It is a model like any other: every verb takes it.

# %%
eq.save_model(folder / "augmented.toml", found.corrected)
print((folder / "augmented.toml").read_text())
after = eq.score(recordings, eq.load_model(folder / "augmented.toml"))
print(f"RMSE, initial model:   {1e3 * before.rmse[0]:5.1f} mrad")
print(f"RMSE, augmented model: {1e3 * after.rmse[0]:5.1f} mrad")

# %% [markdown]
# The score is of all four recordings. The diagnosis's error above is smaller: it is of the held-out one, and what
# MuJoCo's physics step does to simulated recordings is taken off it ([machines](../machines.md)).
#
# A controller that computes with the augmented model pushes against the friction it knows of. Both runs are on the
# augmented model; the first controller knows the initial one, the second the augmented one.

# %%
move = {"waypoints": "hinge=40; hinge=-20; hinge=0"}
runs = {
    "knows the initial model": eq.run_scenario(
        "track", "pid", model=found.corrected, nominal=model, options=move
    ),
    "knows the augmented model": eq.run_scenario(
        "track", "pid", model=found.corrected, options=move
    ),
}
figure, axis = plt.subplots(figsize=(9, 3), layout="constrained")
for name, done in runs.items():
    axis.plot(
        done.run.time,
        1e3 * (done.run.position - done.run.reference)[:, 0],
        label=name,
    )
    print(f"{name}: RMSE {1e3 * done.score.tracking.rmse[0]:.2f} mrad")
axis.set(xlabel="time [s]", ylabel="tracking error [mrad]")
_ = axis.legend()

# %% [markdown]
# ## From the command line
#
# ```sh
# equimus-ctrl check docs/examples/pendulum --model docs/examples/pendulum.xml
# equimus-ctrl diagnose docs/examples/pendulum --model docs/examples/pendulum.xml --write-model augmented.toml
# equimus-ctrl autotune pid --model augmented.toml --scenario step
# equimus-ctrl export augmented.toml --output augmented.xml
# ```
#
# With `--report DIR` a page with all figures is written. How far such an answer can be trusted on your robot,
# `equimus-ctrl prove` tells ([the proof](../proof.md)).
