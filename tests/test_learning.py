"""Learning environments: one robot, many robots, the same trajectories."""

from __future__ import annotations

import re
import sys
import warnings
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from learning_cases import ARM, FORCES, SENSORS, VALVES, arm, leg
from rival_legs import delays

from equimus_ctrl.errors import ConfigError, EquimusError, ModelError, NotAvailable
from equimus_ctrl.identification.noise import JointNoise
from equimus_ctrl.learning.kick import KickScore
from equimus_ctrl.learning.randomisation import Diagnosed, Spread
from equimus_ctrl.models.ball import Ball
from equimus_ctrl.workflow import learning

gymnasium = pytest.importorskip("gymnasium", reason="Gymnasium is not installed (extra rl)")
from gymnasium.utils.env_checker import check_env  # noqa: E402
from gymnasium.vector import SyncVectorEnv  # noqa: E402

KICKS: dict[str, dict[str, Any]] = {
    "nominal": {},
    "valves": {"model": leg(*VALVES, *SENSORS), "noise": 0.002},
    "forces": {"model": leg(*VALVES[:1], *FORCES), "noise": 0.002, "scatter": 0.02},
    "spread": {"randomise": 0.2, "robots": 5, "privileged": True},
    "diagnosed": {"randomise": "diagnosis", "diagnosis": delays(), "robots": 6},
}
TASKS: dict[str, dict[str, Any]] = {
    **{f"kick {name}": {"task": "kick", "control": 60.0, "duration": 0.5, **own} for name, own in KICKS.items()},
    "hold": {"task": "hold", "scenario": {"hip": "80", "knee": "20", "duration": "0.4"}, "noise": 0.001},
    "arm hold": {"task": "hold", "model": arm(), "scenario": {"shoulder": "30", "duration": "0.4"}},
    "arm track": {"task": "track", "model": arm(), "scenario": {"duration": "2.4"}, "privileged": True, "control": 25.0},
    "arm kick": {
        "task": "kick", "model": arm(xml=ARM.replace("range=\"-1.2 1.2\"", "range=\"0 1.2\"")), "duration": 0.4,
        "place": (0.12, 0.0, 0.15), "kicker": "hand",
    },
    "swing up": {"task": "swing_up", "model": "docs/examples/cartpole.xml", "scenario": {"duration": "0.5"}},
}  # fmt: skip


def made(name: str, make: Any = learning.make_env, **more: Any) -> Any:
    return make(**{**TASKS[name], **more})


@pytest.fixture(autouse=True)
def _here(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> None:
    monkeypatch.chdir(request.config.rootpath)


def episode(env: Any, seed: int | None, actions: np.ndarray) -> list[Any]:
    observed, info = env.reset(seed=seed)
    rows = [(observed, 0.0, False, False, info)]
    for action in actions:
        rows.append(env.step(action))
        if rows[-1][2] or rows[-1][3]:
            break
    return rows


@pytest.mark.parametrize("name", TASKS)
def test_gymnasium_has_nothing_to_say(name: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(made(name), skip_render_check=True)


@pytest.mark.parametrize("name", TASKS)
def test_a_seed_gives_the_same_bits(name: str) -> None:
    """Whatever was done before; another seed gives others, where anything is drawn."""
    env = made(name)
    actions = np.random.default_rng(5).uniform(-1, 1, (80, *env.action_space.shape))
    first = episode(env, 7, actions)
    episode(env, 11, actions[::-1])
    again, fresh = episode(env, 7, actions), episode(made(name), 7, actions)
    for one, other, third in zip(first, again, fresh, strict=True):
        assert np.array_equal(one[0], other[0]) and np.array_equal(one[0], third[0])
        assert one[1:] == other[1:] == third[1:]
    drawn = any(key in TASKS[name] for key in ("noise", "randomise", "scatter"))
    assert np.array_equal(first[0][0], episode(env, 8, actions)[0][0]) != drawn or "randomise" in TASKS[name]


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
@pytest.mark.parametrize("name", TASKS)
def test_many_go_as_each_alone(name: str, mode: str) -> None:
    """The same observations, rewards, ends and infos, bit for bit, over several episodes, as Gymnasium's own."""
    n = 3
    many = made(name, learning.make_vec_env, num_envs=n, autoreset_mode=mode, threads=2)
    apart = SyncVectorEnv([lambda: made(name)] * n, autoreset_mode=gymnasium.vector.AutoresetMode(mode))
    assert many.observation_space == apart.observation_space and many.action_space == apart.action_space
    (one, infos), (other, told) = many.reset(seed=3), apart.reset(seed=3)
    assert np.array_equal(one, other)
    _alike(infos, told)
    rng, ends = np.random.default_rng(2), 0
    for _ in range(many.episodes.periods + 25):
        actions = rng.uniform(-1.2, 1.2, many.action_space.shape).astype(np.float32)
        one, other = many.step(actions), apart.step(np.clip(actions, -1, 1))
        for ours, theirs in zip(one[:4], other[:4], strict=True):
            assert np.array_equal(ours, theirs)
        _alike(one[4], other[4], one[2] | one[3])
        ends += int((one[2] | one[3]).sum())
    assert ends >= n


def _alike(ours: dict[str, Any], theirs: dict[str, Any], over: Any = None) -> None:
    """Infos as Gymnasium makes them of those of single environments."""
    assert set(theirs) <= set(ours)
    for key, values in theirs.items():
        if isinstance(values, dict):
            _alike(ours[key], values)
        elif values.dtype == object:
            assert all(np.array_equal(a, b) for a, b in zip(ours[key], values, strict=True))
        else:
            assert np.array_equal(ours[key], values), key


@pytest.mark.parametrize("name", TASKS)
def test_actions_span_the_range_and_observations_stay_within_theirs(name: str) -> None:
    env = made(name)
    spec = env.unwrapped.episodes.plant.spec
    scaling = env.unwrapped.episodes.scaling
    assert np.allclose(scaling.command(-np.ones(len(spec.actuators))), spec.command_low)
    assert np.allclose(scaling.command(np.ones(len(spec.actuators))), spec.command_high)
    assert np.allclose(scaling.action(scaling.command(np.array([0.3] * len(spec.actuators)))), 0.3)
    for action in (-1.0, 1.0):
        for row in episode(env, 1, np.full((40, len(spec.actuators)), action)):
            assert row[0] in env.observation_space


def test_it_ends_by_the_task_or_by_time_and_says_which() -> None:
    env = learning.make_env("kick", control=60.0, gone=0.02)
    rows = episode(env, 0, np.tile([-1.0, 1.0], (200, 1)))
    assert rows[-1][2:4] == (True, False)
    assert sum(row[1] for row in rows) == pytest.approx(env.episodes.task.score.best[0])
    still = episode(env, 0, np.tile([-1.0, -1.0], (200, 1)))
    assert still[-1][2:4] == (False, True) and len(still) == 91 and still[-1][1] == 0.0
    with pytest.raises(ConfigError, match="more than 90 control periods"):
        env.step(np.zeros(2))


def test_observations_are_a_sensors() -> None:
    """Noise, delay and offset; the true pose is there for the privileged alone."""
    seen = learning.make_env("hold", leg("sensor_offset:knee:offset=0.1"), history=2).reset(seed=0)[0]
    bare = learning.make_env("hold", history=2).reset(seed=0)[0]
    half = np.ptp([own.angle for own in (leg().robot.joints[1].lower, leg().robot.joints[1].upper)]) / 2
    assert seen[:4] - bare[:4] == pytest.approx([0, 0.1 / half, 0, 0.1 / half], abs=1e-6)
    noisy = learning.make_env("hold", noise=0.01)
    drawn = np.array([noisy.reset(seed=k)[0][1] for k in range(300)])
    assert drawn.std() == pytest.approx(0.01 / half, rel=0.15)
    whole = learning.make_env("hold", leg("sensor_offset:knee:offset=0.1"), history=2, privileged=True).reset(seed=0)[0]
    assert len(whole) == len(seen) + 6
    assert whole[len(seen) + 1] == pytest.approx(bare[1], abs=1e-6)


def test_robots_are_drawn_from_what_a_diagnosis_leaves_open() -> None:
    rivals = delays()
    draws = Diagnosed(rivals, 200, 0)
    models = [draws.model(k) for k in range(200)]
    names = [model.effects[0].name for model in models]
    assert 70 < names.count("sensor_delay") < 130  # two explanations, equally likely
    late = np.array([next(iter(model.effects[0].parameters().values())) for model in models])
    assert late.std() == pytest.approx(0.1 * 0.04, rel=0.5) and abs(late.mean() - 0.04) < 2e-3
    assert [draws.model(3), models[3]][0].parameters() == models[3].parameters()
    env = learning.make_env("kick", randomise="diagnosis", diagnosis=rivals, robots=4)
    assert env.episodes._noise == rivals.noise[:2]  # as diagnosed
    kinds = {env.reset(options={"robot": k})[1]["robot"] for k in range(4)}
    assert kinds == {0, 1, 2, 3}


def test_noise_is_as_correlated_as_diagnosed() -> None:
    noise = (JointNoise(1e-3, 0.02, 0.1), JointNoise(0.005))
    rivals = replace(delays(), noise=noise)
    episodes = learning.make_episodes("kick", 32, randomise="diagnosis", diagnosis=rivals, robots=1, threads=1)
    for row in range(32):
        episodes.begin(row, np.random.default_rng(row))
    drawn, dt = episodes._drawn, episodes.plant.spec.control_dt
    assert drawn.std(axis=(0, 1)) == pytest.approx([own.sigma for own in noise], rel=0.1)
    products = (drawn[:, 1:] * drawn[:, :-1]).mean(axis=(0, 1)) / drawn.var(axis=(0, 1))
    assert products == pytest.approx([np.exp(-dt / 0.1), 0.0], abs=0.04)


def test_a_share_changes_what_varies_alike() -> None:
    draws = Spread(leg(), 0.2, 50, 1)
    stiff = np.array([draws.model(k).parameters()["maa.stiffness"] for k in range(50)]) / 265.82
    assert 0.8 <= stiff.min() < 0.85 and 1.15 < stiff.max() <= 1.2


def test_a_kick_is_scored_by_its_linear_velocity() -> None:
    score = KickScore(2, np.array([1.0, 0.0, 0.0]))
    for row in (0, 1):
        score.begin(row)
    ten = np.radians(10)
    velocity = np.zeros((2, 3, 3))
    velocity[0] = [[0.5, 0, 0], [2 * np.cos(ten), 0, 2 * np.sin(ten)], [1.0, 0, 0]]
    velocity[1] = [[-1, 0, 0], [-2, 0, 0], [0, 0, 0]]
    force = np.zeros((2, 3, 3))
    force[0, 1] = [3.0, 0.0, 4.0]
    score.add(np.arange(2), velocity, force)
    assert score.speed == pytest.approx([2 * np.cos(ten), 0])
    assert score.miss == pytest.approx([ten, np.pi])
    assert score.best == pytest.approx([2 * (np.cos(ten) - np.sin(ten)), 0])
    assert score.force == pytest.approx([5.0, 0.0])
    score.add(np.array([0]), 0.1 * velocity[:1], force[:1])
    assert score.speed[0] == pytest.approx(2 * np.cos(ten))  # the best stays


def test_the_leg_kicks_the_ball_and_momentum_agrees() -> None:
    env = learning.make_env("kick", control=60.0, ball=Ball(mass=0.1))
    rows = episode(env, 0, np.tile([-1.0, 1.0], (90, 1)))
    info = rows[-1][4]
    assert 0.3 < info["ball_speed"] < 10 and info["kick_force"] > 1.0
    assert info["kick_force"] * 0.1 > 0.1 * info["ball_speed"]  # force over less than 0.1 s


def test_gymnasium_makes_them_by_name() -> None:
    env = gymnasium.make("equimus_ctrl/Kick-v0", control=60.0, duration=0.5)
    assert env.reset(seed=0)[0].shape == env.observation_space.shape
    env = gymnasium.make("equimus_ctrl/Hold-v0", scenario={"hip": "80", "duration": "0.5"}, max_episode_steps=5)
    assert len(episode(env, 0, np.zeros((40, 2)))) == 6
    many = gymnasium.make_vec("equimus_ctrl/Track-v0", num_envs=2, model=arm(), threads=1)
    assert many.reset(seed=0)[0].shape[0] == 2 and type(many.unwrapped).__name__ == "RobotVectorEnv"


def test_pictures_show_robot_and_ball() -> None:
    env = learning.make_env("kick", render_mode="rgb_array", control=60.0)
    env.reset(seed=0)
    before = env.render()
    for _ in range(60):
        env.step(np.array([-1.0, 1.0]))
    after = env.render()
    assert before.shape == after.shape == (360, 480, 3) and before.dtype == np.uint8
    orange = [(np.abs(p.astype(int) - [217, 89, 38]).sum(axis=2) < 30).nonzero()[1].mean() for p in (before, after)]
    assert abs(orange[1] - orange[0]) > 5  # the ball has moved
    many = learning.make_vec_env("kick", 2, render_mode="rgb_array")
    many.reset(seed=0)
    assert len(many.render()) == 2


def test_without_a_screen_a_window_is_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    with pytest.raises(NotAvailable, match="no screen for a window; render_mode='rgb_array' gives pictures"):
        learning.make_env("kick", render_mode="human").reset(seed=0)


WRONG: dict[str, tuple[Any, str]] = {
    "task": (lambda: learning.make_env("kik"), "no task 'kik'; did you mean 'kick'"),
    "setting": (lambda: learning.make_env("kick", nois=0.1), "no setting 'nois'; did you mean 'noise'"),
    "noise": (lambda: learning.make_env("kick", noise=-1.0), "noise is -1 rad or m, expected 0 to 1"),
    "history": (lambda: learning.make_env("kick", history=0), "history is 0, expected 1 to"),
    "control": (lambda: learning.make_env("kick", control=77.0), "480 Hz is not a whole multiple of 77 Hz"),
    "mode": (lambda: learning.make_env("kick", render_mode="rgb"), "no render mode 'rgb' (known: human, rgb_array)"),
    "randomise": (lambda: learning.make_env("kick", randomise="diag"), "randomise is 'diag', expected a share"),
    "no diagnosis": (lambda: learning.make_env("kick", randomise="diagnosis"), "without a diagnosis, expected its record"),
    "other robot": (
        lambda: learning.make_env("hold", arm(), randomise="diagnosis", diagnosis=delays().to_dict()), "no record of"
    ),
    "kicker": (lambda: learning.make_env("kick", kicker="knee"), "'knee' is no site or body, known are"),
    "gap": (lambda: learning.make_env("kick", gap=-1.0), "gap is -1 m, expected at least 0"),
    "no limits": (lambda: learning.make_env("hold", "docs/examples/pendulum.xml"), "motor goes from -inf to inf"),
    "events": (lambda: learning.make_env("push"), "something befalls the robot"),
    "envs": (lambda: learning.make_vec_env("kick", 0), "number of environments is 0, expected at least 1"),
    "autoreset": (lambda: learning.make_vec_env("kick", 1, autoreset_mode="Now"), "no autoreset mode 'Now'"),
    "window": (lambda: learning.make_vec_env("kick", 1, render_mode="human"), "have no window"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_what_cannot_be_is_a_sentence(name: str) -> None:
    build, said = WRONG[name]
    with pytest.raises(EquimusError) as caught:
        build()
    assert said in str(caught.value) and "\n" not in str(caught.value)


def test_wrong_actions_and_resets_are_sentences() -> None:
    env = learning.make_env("kick", control=60.0)
    with pytest.raises(ConfigError, match="environment 0 is stepped before it was reset"):
        env.step(np.zeros(2))
    with pytest.raises(ConfigError, match="robot is 1, expected a whole number from 0 to 0"):
        env.reset(seed=0, options={"robot": 1})
    with pytest.raises(ConfigError, match="no option 'robt'; did you mean 'robot'"):
        env.reset(seed=0, options={"robt": 1})
    env.reset(seed=0)
    with pytest.raises(ConfigError, match=r"actions have shape \(1, 3\), expected \(1, 2\)"):
        env.step(np.zeros(3))
    with pytest.raises(ConfigError, match=r"action of environment 0 is \[nan  ?0.\], not finite"):
        env.step(np.array([np.nan, 0.0]))
    many = learning.make_vec_env("kick", 2, control=60.0)
    many.reset(seed=0)
    with pytest.raises(ConfigError, match=r"actions have shape \(2,\), expected \(2, 2\)"):
        many.step(np.zeros(2))


def test_a_robot_that_loses_its_numbers_ends_its_episode() -> None:
    """Without NaN in what is observed or rewarded; the others go on."""
    wild = arm(xml=ARM.replace('kp="20"', 'kp="1e9"').replace('damping="0.3"', 'damping="0"'))
    many = learning.make_vec_env("hold", 2, wild, scenario={"duration": "0.5"})
    many.reset(seed=0)
    ends = np.zeros(2, dtype=bool)
    for k in range(30):
        observed, reward, terminated, _, infos = many.step(np.array([[(-1.0) ** k] * 2, [0.0, 0.0]]))
        assert np.isfinite(observed).all() and np.isfinite(reward).all()
        ends |= terminated
        assert np.array_equal(terminated, infos["diverged"] & terminated)
    assert ends[0]


def test_where_nothing_can_kick_or_rests_it_is_asked_for() -> None:
    bare = re.sub(r"<geom type[^>]*/>", '<inertial pos="0 0 -0.1" mass="0.3" diaginertia="1e-3 1e-3 1e-3"/>', ARM)
    with pytest.raises(ModelError, match="body 'lower' is to touch a ball, but has no geom"):
        learning.make_env("kick", arm(xml=bare), kicker="hand").reset(seed=0)
    unlimited = re.sub(r' ctrlrange="-1.1 1.1"', "", ARM).replace('range="-1.2 1.2"', "")
    with pytest.raises(ConfigError, match=r"second goes from -inf to inf"):
        learning.make_env("kick", arm(xml=unlimited), kicker="hand", place=(0.1, 0, 0.1))
    with pytest.raises(ConfigError, match="expected the ball's place"):
        learning.make_env("kick", arm(xml=unlimited), kicker="hand")
