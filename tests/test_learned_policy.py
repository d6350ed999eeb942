"""Policies as files and as controllers, without the library that trains them."""

from __future__ import annotations

import io
import json
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from learning_cases import VALVES, arm, leg
from policy_cases import policy_for

from equimus_ctrl.cli.main import main
from equimus_ctrl.errors import ConfigError, ControllerError
from equimus_ctrl.learning.burst import POPULATION, Burst, bursts, search_burst
from equimus_ctrl.learning.episodes import Episodes
from equimus_ctrl.learning.evaluation import judge
from equimus_ctrl.learning.network import ACTIVATIONS, Network, Normalisation
from equimus_ctrl.learning.policy import Policy, training_state
from equimus_ctrl.learning.policy_controller import PolicyController
from equimus_ctrl.loop import run
from equimus_ctrl.models.model import Model
from equimus_ctrl.plants.mujoco_plant import MujocoPlant
from equimus_ctrl.types import Observation
from equimus_ctrl.workflow.learning import make_episodes
from equimus_ctrl.workflow.runs import load_controller, load_scenario, run_scenario

HOLD = {"hip": "80", "knee": "20", "duration": "0.5"}


@pytest.fixture
def hold() -> tuple[Episodes, Policy, Model]:
    model = leg(*VALVES)
    episodes = make_episodes("hold", 1, model, scenario=HOLD, integrator="RK4", threads=1)
    return episodes, policy_for(episodes, model), model


def test_what_is_written_is_read_and_the_same_bytes(hold: tuple[Episodes, Policy, Model]) -> None:
    policy = hold[1]
    data = policy.to_bytes()
    assert data == policy.to_bytes() == Policy.from_bytes(data, "x").to_bytes()
    seen = np.random.default_rng(1).normal(size=(9, policy.network.inputs))
    assert np.array_equal(policy.act(seen), Policy.from_bytes(data, "x").act(seen))
    assert Policy.from_bytes(data, "x").suited == policy.suited
    arrays = {"count.steps": np.array(7), "x": np.arange(3.0)}
    state, read = training_state(policy.to_bytes(b"state", arrays), "x")
    assert state == b"state" and read["count.steps"] == 7 and np.array_equal(read["x"], arrays["x"])
    with pytest.raises(ConfigError, match=r"x: has no training\.bin"):
        training_state(data, "x")


def test_the_network_is_its_formula() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(4, 3)).astype(np.float32), rng.normal(size=4).astype(np.float32)
    x = rng.normal(size=(5, 3)).astype(np.float32)
    line = x @ a.T + b
    known = {
        "identity": line, "tanh": np.tanh(line), "relu": np.maximum(line, 0),
        "elu": np.where(line > 0, line, np.exp(line) - 1), "leaky_relu": np.where(line > 0, line, 0.01 * line),
    }  # fmt: skip
    assert set(known) == set(ACTIVATIONS)
    for name, wanted in known.items():
        assert Network((a,), (b,), (name,))(x) == pytest.approx(wanted, abs=1e-6)
    for broken, sentence in (
        (lambda: Network((a,), (b,), ("tahn",)), "there is no activation 'tahn'; did you mean 'tanh'"),
        (lambda: Network((a, a), (b, b), ("tanh", "tanh")), "layer 2 has weights"),
        (lambda: Network((a * np.nan,), (b,), ("tanh",)), "layer 1 has weights that are not finite"),
        (lambda: Normalisation(np.zeros(2), np.array([1.0, -1.0])), "the normalisation of observations is not"),
    ):
        with pytest.raises(ConfigError, match=sentence):
            broken()


def test_a_controller_does_what_the_policy_does_in_its_environment(hold: tuple[Episodes, Policy, Model]) -> None:
    """Bit for bit: valves, history and reference are seen alike."""
    episodes, policy, model = hold
    episodes.begin(0, np.random.default_rng(0))
    positions = []
    for _ in range(episodes.periods):
        positions.append(episodes.plant.measured[0].copy())
        episodes.step(np.array([0]), policy.act(episodes.observation(np.array([0]))))
    scenario = load_scenario("hold", model.robot, effects=model.effects, options=HOLD)
    done = run(MujocoPlant(model), PolicyController(policy), scenario.reference, 0.5, start=scenario.start)
    assert np.array_equal(done.position, positions)


def test_a_kick_is_played_without_its_ball_as_with_it_until_it_is_hit() -> None:
    model = leg()
    episodes = make_episodes("kick", 1, model, integrator="RK4", duration=0.6, place=(3.0, 0.0, 0.0), threads=1)
    policy = policy_for(episodes, model, 4)
    episodes.begin(0, np.random.default_rng(0))
    positions = []
    for _ in range(episodes.periods):
        positions.append(episodes.plant.measured[0].copy())
        episodes.step(np.array([0]), policy.act(episodes.observation(np.array([0]))))
    scenario = load_scenario("hold", model.robot, options={"duration": "0.6"})
    done = run(MujocoPlant(model), PolicyController(policy), scenario.reference, 0.6, start=scenario.start)
    assert done.position == pytest.approx(np.array(positions), abs=1e-6) and np.ptp(done.position) > 0.1


def test_it_acts_at_its_own_rate(hold: tuple[Episodes, Policy, Model]) -> None:
    """On a plant of twice that rate commands hold for two periods; of another, it is refused."""
    model = leg()
    slow = make_episodes("hold", 1, model, scenario=HOLD, control=60.0, threads=1)
    done = run_scenario("hold", PolicyController(policy_for(slow, model)), model=model, options=HOLD)
    assert np.array_equal(done.run.command[::2], done.run.command[1::2]) and np.ptp(done.run.command) > 0
    odd = make_episodes("hold", 1, model, scenario=HOLD, control=80.0, threads=1)
    with pytest.raises(ConfigError, match=r"policy: the policy acts 80 times a second, this plant 120 times"):
        run_scenario("hold", PolicyController(policy_for(odd, model)), model=model, options=HOLD)


def test_another_robot_is_refused(hold: tuple[Episodes, Policy, Model]) -> None:
    policy = hold[1]
    other = arm()
    with pytest.raises(ConfigError, match=r"is for nominal_leg, whose joints are hip, knee; .* are shoulder, elbow"):
        run_scenario("hold", PolicyController(policy), model=other, options={"duration": "0.3"})
    wide = replace(policy, suited=replace(policy.suited, command_high=(9e4, 5e4)))
    with pytest.raises(ConfigError, match="with command_high 90000, 50000, this robot's are 50000, 50000"):
        run_scenario("hold", PolicyController(wide), model=leg(), options={"duration": "0.3"})


def test_what_no_controller_sees_is_refused() -> None:
    for more, sentence in (({"seen": True}, "sees where the ball is"), ({"privileged": True}, "what no sensor shows")):
        episodes = make_episodes("kick", 1, leg(), threads=1, **more)  # type: ignore[arg-type]
        with pytest.raises(ConfigError, match=sentence):
            PolicyController(policy_for(episodes, leg()))


def test_a_measurement_that_is_not_finite_is_a_sentence(hold: tuple[Episodes, Policy, Model]) -> None:
    episodes, policy, _ = hold
    spec, controller = episodes.plant.spec, PolicyController(policy, "mine.zip")
    at = Observation(0.0, np.zeros(2), 0.0, spec.command_low, np.zeros(2, dtype=bool))
    state = controller.init(spec, at)
    scenario = load_scenario("hold", leg().robot, options=HOLD)
    controller.step(at, scenario.reference, state)
    with pytest.raises(ControllerError, match=r"mine.zip: the measured positions at 0.000 s are \[nan, 0.0\]"):
        controller.step(replace(at, position=np.array([np.nan, 0.0])), scenario.reference, state)
    with pytest.raises(ConfigError, match="number 3 of what the policy sees is not finite"):
        policy.act(np.where(np.arange(policy.network.inputs) == 2, np.nan, 0.0)[None])


def changed(data: bytes, **parts: Any) -> bytes:
    """An archive with other parts; None leaves one out."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(buffer, "w") as new:
        held = {name: old.read(name) for name in old.namelist()}
        for name, value in (held | {key.replace("_", "."): own for key, own in parts.items()}).items():
            if value is not None:
                new.writestr(name, value)
    return buffer.getvalue()


def test_damaged_files_are_sentences(hold: tuple[Episodes, Policy, Model], tmp_path: Path) -> None:
    data = hold[1].to_bytes()
    about = json.loads(zipfile.ZipFile(io.BytesIO(data)).read("policy.json"))
    bare = io.BytesIO()
    arrays = np.load(io.BytesIO(zipfile.ZipFile(io.BytesIO(data)).read("network.npz")))
    np.savez(bare, **{name: arrays[name] for name in arrays.files if name not in ("mean", "variance")})
    theirs = io.BytesIO()
    with zipfile.ZipFile(theirs, "w") as archive:
        archive.writestr("policy.pth", b"")
    pickled = io.BytesIO()
    np.savez(pickled, mean=np.array([{}], dtype=object))
    for given, sentence in (
        (b"not an archive", "p.zip: is no archive of a policy, or damaged"),
        (data[:-200], "p.zip: is no archive of a policy, or damaged"),
        (changed(data, network_npz=None), "p.zip: has no network.npz"),
        (changed(data, network_npz=bare.getvalue()), "p.zip: is without the normalisation of observations"),
        (theirs.getvalue(), "p.zip: is a file of Stable-Baselines3's own, without the normalisation"),
        (changed(data, network_npz=pickled.getvalue()), "p.zip: is damaged or not as train writes it"),
        (changed(data, policy_json=b"{"), "p.zip: is damaged or not as train writes it"),
        (changed(data, policy_json=b'{"schema": "x/1"}'), "p.zip: its schema is 'x/1', expected 'equimus-ctrl/pol"),
        (changed(data, policy_json=json.dumps({**about, "for": {}}).encode()), "p.zip: is damaged or not as"),
        (changed(data, policy_json=json.dumps({**about, "activations": ["tanh"]}).encode()), "p.zip: the policy takes"),
    ):
        with pytest.raises(ConfigError) as refused:
            Policy.from_bytes(given, "p.zip")
        assert str(refused.value).startswith(sentence)


def test_it_is_named_on_the_command_line(
    hold: tuple[Episodes, Policy, Model], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mine.zip").write_bytes(hold[1].to_bytes())
    told = ["run", "hold", "--set", "duration=0.3", "--no-figures", "--json"]
    assert main([*told, "-c", "mine.zip"]) == 0
    assert json.loads(capsys.readouterr().out)["controller"] == "mine.zip"
    assert main([*told, "-c", "other.zip"]) == 2
    assert "other.zip: there is no such file" in capsys.readouterr().err
    scenario = load_scenario("hold", leg().robot, options=HOLD)
    with pytest.raises(ConfigError, match="controller mine.zip takes no settings file"):
        load_controller("mine.zip", scenario, Path("pid.toml"))


def test_judging_is_the_same_for_all() -> None:
    """The same robots, starts and noise, whoever acts."""
    episodes = make_episodes("kick", 3, leg(), control=60.0, randomise=0.2, noise=0.002, duration=0.5, threads=1)
    still = Burst(np.array([-1.0, -1.0]), np.array([-1.0, -1.0]), 0.0)
    kick = Burst(np.array([-1.0, 1.0]), np.array([-1.0, 1.0]), 0.0)
    first = judge(episodes, kick.act, 5)
    assert np.array_equal(first.info["robot"], [0, 1, 2]) and first.success is not None and first.success.all()
    nothing = judge(episodes, still.act, 5)
    assert np.all(nothing.returns < first.returns) and nothing.success is not None and not nothing.success.any()
    again = judge(episodes, kick.act, 5)
    assert np.array_equal(first.returns, again.returns) and len(set(first.returns)) == 3
    assert first.returns == pytest.approx(episodes.task.score.best)  # type: ignore[attr-defined]
    told = first.to_dict()
    assert told["return"] == pytest.approx(first.returns.mean()) and told["least"] == first.returns.min()


def test_a_burst_holds_one_command_then_another() -> None:
    burst = Burst(np.array([1.0, -1.0]), np.array([0.0, 0.5]), 1.25)
    assert np.allclose([bursts(burst.vector[None], k)[0] for k in range(3)], [[1, -1], [0.25, 0.125], [0, 0.5]])
    assert np.array_equal(Burst.of(burst.vector).then, burst.then)


def test_the_search_finds_a_better_burst_than_it_began_with() -> None:
    episodes = make_episodes("kick", 2 * POPULATION, leg(), control=60.0, duration=0.6, threads=2)
    _, begun = search_burst(episodes, 1, 1)
    burst, found = search_burst(episodes, 1, 6)
    assert found > max(begun, 0.3)
    assert judge(episodes, burst.act, 1).returns[0] == pytest.approx(found)
    with pytest.raises(ConfigError, match="there are 16 episodes, expected 24 or more"):
        search_burst(episodes, robots=np.zeros(3, dtype=int))
