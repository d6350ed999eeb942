"""Many runs in MuJoCo at once: the exact motion, the bits of each run alone, other numbers in each, and what diverges."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from morphologies import STRUCTURES, integrate, random_morphology, random_poses
from mujoco_runs import FINE, rms, varied

from equimus_ctrl.engines.mujoco_batch import FAST_SETTINGS, MujocoBatch
from equimus_ctrl.errors import ConfigError, ModelError
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.mjcf import SolverSettings, compile_model, place
from equimus_ctrl.robots.elastic.leg import ideal_leg, nominal_leg
from equimus_ctrl.robots.elastic.morphology import JointStop, Morphology, Phase
from equimus_ctrl.types import Array

PHASES: tuple[Phase, ...] = ("swing", "stance")

every_phase = pytest.mark.parametrize("phase", PHASES)
every_structure = pytest.mark.parametrize("name", STRUCTURES)


def some_runs(m: Morphology, n: int, steps: int, seed: int = 0) -> tuple[Array, Array, Array]:
    rng = np.random.default_rng(seed)
    legged = "leg" in m.name
    q = rng.uniform([0.9, 0.2], [1.9, 1.2], (n, 2)) if legged else random_poses(m, rng, n)
    held = np.repeat(rng.uniform(0, 1e4, (n, 1, len(m.actuators))), steps, axis=1)
    return q, rng.normal(0, 1, (n, len(m.joints))), held


@pytest.mark.parametrize("make", [nominal_leg, ideal_leg])
def test_swing_step_responses_are_those_of_the_exact_model(make: Callable[[], Morphology]) -> None:
    """From rest in one pose of the workspace to the pressures that hold another, clear of the stops."""
    m = make().without_stops()
    k = Kinematics(m)
    poses = [([0.8, 0.4], [1.6, 0.6]), ([1.9, 1.2], [1.3, 0.8]), ([1.4, 0.9], [1.2, 0.4])]
    q0 = np.array([start for start, _ in poses])
    p = np.array([k.static_pressure(end) for _, end in poses])
    steps = 360
    q, _ = MujocoBatch(replace(m, command_low=-1e6, command_high=1e6)).run(
        q0, np.zeros_like(q0), np.repeat(p[:, None], steps, axis=1)
    )
    times = np.arange(steps + 1) * FAST_SETTINGS.timestep
    for i in range(len(poses)):
        pressure = p[i]
        exact, _ = integrate(
            lambda t, x, v, pressure=pressure: k.acceleration(x, v, pressure),
            q0[i],
            np.zeros(2),
            times,
            rtol=1e-8,
            atol=1e-10,
        )
        assert np.ptp(exact, axis=0).max() > 0.1
        assert rms(q[i] - exact) < 1e-4


@pytest.mark.parametrize(
    ("name", "phase"), [(name, "swing") for name in STRUCTURES] + [("mono_and_bi", "stance"), ("branched", "stance")]
)
def test_a_free_second_of_any_structure_is_that_of_the_exact_model(name: str, phase: Phase) -> None:
    m = random_morphology(name, 1)
    k = Kinematics(m, phase)
    q0, v0, p = some_runs(m, 1, 480)
    q, v = MujocoBatch(m, phase, FINE).run(q0, v0, p)
    exact_q, exact_v = integrate(
        lambda t, x, w: k.acceleration(x, w, p[0, 0]), q0[0], v0[0], np.linspace(0, 1, 25), rtol=1e-8, atol=1e-10
    )
    np.testing.assert_allclose(q[0, ::20], exact_q, atol=1e-5)
    np.testing.assert_allclose(v[0, ::20], exact_v, rtol=1e-3, atol=3e-3)


def test_stance_needs_the_harder_equalities_and_has_them() -> None:
    m = nominal_leg().without_stops()
    k = Kinematics(m, "stance")
    q0, v0 = np.array([[1.5, 0.5]]), np.zeros((1, 2))
    p = np.repeat(k.static_pressure([1.4, 0.6])[None, None], 120, axis=1)
    wide = replace(m, command_low=-1e6, command_high=1e6)
    times = np.arange(121) / 120
    exact, _ = integrate(lambda t, x, v: k.acceleration(x, v, p[0, 0]), q0[0], v0[0], times, rtol=1e-8, atol=1e-10)
    assert np.ptp(exact, axis=0).max() > 0.05
    errors = [
        rms(MujocoBatch(wide, "stance", replace(FAST_SETTINGS, softness=s)).run(q0, v0, p)[0][0] - exact)
        for s in (1.0, 0.01)
    ]
    assert errors[1] < 1e-4
    assert errors[1] < errors[0] / 3


@every_phase
@every_structure
def test_the_start_is_closed_as_the_plants_is(name: str, phase: Phase) -> None:
    m = random_morphology(name, 4, stops=True)
    batch = MujocoBatch(m, phase)
    q0, v0, _ = some_runs(m, 3, 1)
    qpos, qvel = batch._closed(q0, v0)
    data = mujoco.MjData(batch.mujoco_model)
    for i in range(3):
        place(batch.mujoco_model, data, Kinematics(m, phase), q0[i], v0[i])
        np.testing.assert_allclose(qpos[i], data.qpos, atol=1e-12)
        np.testing.assert_allclose(qvel[i], data.qvel, atol=1e-7)


def test_a_run_is_a_loop_of_steps() -> None:
    m = nominal_leg()
    q0, v0, p = some_runs(m, 2, 30)
    q, v = MujocoBatch(m).run(q0, v0, p)
    model = compile_model(m, "swing", FAST_SETTINGS)
    data = mujoco.MjData(model)
    for i in range(2):
        mujoco.mj_resetData(model, data)
        place(model, data, Kinematics(m), q0[i], v0[i])
        for k in range(30):
            data.ctrl[:] = p[i, k]
            mujoco.mj_step(model, data)
            np.testing.assert_allclose(q[i, k + 1], data.qpos[:2], rtol=1e-9)
            np.testing.assert_allclose(v[i, k + 1], data.qvel[:2], rtol=1e-6, atol=1e-8)


def test_the_bits_depend_neither_on_threads_nor_on_neighbours_nor_on_earlier_runs() -> None:
    m = ideal_leg()
    q0, v0, p = some_runs(m, 9, 60)
    single = MujocoBatch(m, threads=1)
    q, v = single.run(q0, v0, p)
    others = [MujocoBatch(m, threads=3).run(q0, v0, p), single.run(q0, v0, p)]
    for other in others:
        np.testing.assert_array_equal(other[0], q)
        np.testing.assert_array_equal(other[1], v)
    alone = single.run(q0[4:5], v0[4:5], p[4:5])
    np.testing.assert_array_equal(alone[0][0], q[4])


def test_the_first_row_is_the_start_and_pressures_are_held_step_by_step() -> None:
    m = nominal_leg()
    q0, v0, p = some_runs(m, 2, 10)
    p[1] = p[0]
    q0[1], v0[1] = q0[0], v0[0]
    p[1, 6:] += 3e4
    q, v = MujocoBatch(m).run(q0, v0, p)
    assert q.shape == v.shape == (2, 11, 2)
    np.testing.assert_array_equal(q[:, 0], q0)
    np.testing.assert_array_equal(v[:, 0], v0)
    np.testing.assert_array_equal(q[0, :7], q[1, :7])
    assert np.abs(q[0, 7:] - q[1, 7:]).min() > 0


def test_pressures_beyond_the_range_are_clipped() -> None:
    m = nominal_leg()
    q0, v0, p = some_runs(m, 2, 20)
    q0[1], v0[1] = q0[0], v0[0]
    p[0], p[1] = 50e3, 80e3
    q, _ = MujocoBatch(m).run(q0, v0, p)
    np.testing.assert_array_equal(q[0], q[1])


@pytest.fixture
def quiet(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> Callable[[], None]:
    """Checks that nothing was printed and no log written."""
    monkeypatch.chdir(tmp_path)

    def check() -> None:
        out = capfd.readouterr()
        assert (out.out, out.err) == ("", "")
        assert list(tmp_path.iterdir()) == []

    return check


@pytest.mark.parametrize("threads", [1, 2])
def test_a_run_that_diverges_is_marked_and_the_others_go_on(threads: int, quiet: Callable[[], None]) -> None:
    m = nominal_leg()
    q0, v0, p = some_runs(m, 4, 60)
    batch = MujocoBatch(m, threads=threads)
    good = batch.run(q0, v0, p)
    v0[1], v0[2, 0] = 990.0, 1e5
    q, v = batch.run(q0, v0, p)
    for i in (0, 3):
        np.testing.assert_array_equal(q[i], good[0][i])
        np.testing.assert_array_equal(v[i], good[1][i])
    assert np.isnan(q[2]).all() and np.isnan(v[2]).all()
    lost = np.isnan(q[1]).any(axis=1)
    assert not lost[0] and lost[-1]
    assert np.all(np.diff(lost.astype(int)) >= 0)
    np.testing.assert_array_equal(np.isnan(q[1]).all(axis=1), lost)
    np.testing.assert_array_equal(np.isnan(v[1]).all(axis=1), lost)
    again = batch.run(*some_runs(m, 4, 60))
    np.testing.assert_array_equal(again[0], good[0])
    quiet()


def test_what_mujoco_repeats_after_a_divergence_is_not_taken_for_rest(quiet: Callable[[], None]) -> None:
    """A step far too long for a damper: no row may equal the one before it."""
    m = nominal_leg().without_stops().with_parameters({"baa.damping": 600.0})
    q0, v0, p = some_runs(m, 6, 90)
    q, _ = MujocoBatch(m).run(q0, v0, p)
    lost = np.isnan(q).any(axis=2)
    assert lost.any()
    moving = np.any(np.diff(q, axis=1) != 0, axis=2)
    assert moving[~lost[:, 1:]].all()
    quiet()


def test_mujocos_own_warning_handler_is_put_back() -> None:
    heard: list[str] = []
    mujoco.set_mju_user_warning(heard.append)
    try:
        m = nominal_leg()
        MujocoBatch(m).run(np.array([[1.5, 0.5]]), np.array([[1e6, 0.0]]), np.zeros((1, 5, 2)))
        assert heard == []
        handler = mujoco.get_mju_user_warning()
        assert handler is not None
        handler("still here")
        assert heard == ["still here"]
    finally:
        mujoco.set_mju_user_warning(None)


def fields(model: mujoco.MjModel) -> dict[str, Array]:
    """All numeric arrays of a model but those of what is only drawn, and ``dof_length``, which only sleeping reads."""
    drawn = ("dof_length", "geom", "bvh", "vis", "cam", "light", "mat", "tex", "name", "mesh", "oct", "body_bvh")
    found = {n: getattr(model, n) for n in dir(model) if not n.startswith("_")}
    arrays = {n: a for n, a in found.items() if isinstance(a, np.ndarray) and not n.startswith(drawn)}
    arrays["gravity"] = model.opt.gravity
    return {n: np.array(a, dtype=np.float64) for n, a in arrays.items() if a.dtype.kind in "fiub"}


def with_unlike_stops(m: Morphology) -> Morphology:
    """The same robot with two stops at every joint that has one, unlike by nothing that counts, as a batch has them."""
    none = {"lower": JointStop(-1e3, 0.0, 0.0), "upper": JointStop(1e3, 0.0, 0.0)}
    joints = []
    for joint in m.joints:
        sides = {key: getattr(joint, key) or stop for key, stop in none.items() if joint.lower or joint.upper}
        if sides:
            sides["upper"] = replace(sides["upper"], damping=sides["upper"].damping + 1e-14)
        joints.append(replace(joint, **sides))
    return replace(m, joints=tuple(joints))


def assert_same_models(batch: MujocoBatch, morphologies: list[Morphology], phase: Phase) -> None:
    runs = batch._batch_of(len(morphologies))
    for i, m in enumerate(morphologies):
        expected = fields(compile_model(with_unlike_stops(m), phase, batch.settings))
        for key, found in fields(runs.get_model(i)).items():
            if key.endswith("sameframe"):  # a hint that saves the engine a transformation
                continue
            scale = max(np.abs(expected[key]).max(initial=0.0), 1e-12)
            np.testing.assert_allclose(found, expected[key], rtol=1e-8, atol=1e-12 * scale, err_msg=key)


@every_phase
@pytest.mark.parametrize("name", ["nominal_leg", *STRUCTURES])
def test_models_made_of_numbers_are_those_compiled(name: str, phase: Phase) -> None:
    m = nominal_leg() if name == "nominal_leg" else random_morphology(name, 2, stops=True)
    morphologies = varied(m, 3)
    assert_same_models(MujocoBatch.of(morphologies, phase), morphologies, phase)


@every_phase
def test_numbers_at_zero_in_one_run_do_not_shape_the_others(phase: Phase) -> None:
    """MuJoCo's compiler drops transformations that are none, which must not be lost on the next run."""
    m = nominal_leg()
    zero = {"thigh.com": 0.0, "calf.com": 0.0, "calf.inertia": 0.0, "base_mass": 0.0, "baa.origin.radius": 0.0}
    zero |= {"hip.lower.stiffness": 0.0, "hip.upper.stiffness": 0.0, "maa.stiffness": 0.0, "gravity": 0.0}
    plain = m.with_parameters(zero)
    for morphologies in ([plain, m], [m, plain]):
        batch = MujocoBatch.of(morphologies, phase)
        assert_same_models(batch, morphologies, phase)
        q0, v0, p = some_runs(m, 2, 60)
        q, _ = batch.run(q0, v0, p)
        for i, each in enumerate(morphologies):
            alone, _ = MujocoBatch(each, phase).run(q0[i : i + 1], v0[i : i + 1], p[i : i + 1])
            np.testing.assert_allclose(q[i], alone[0], atol=1e-8)


@every_phase
def test_a_run_of_a_mixed_batch_is_that_of_its_morphology_alone(phase: Phase) -> None:
    m = nominal_leg()
    morphologies = varied(m, 4)
    q0, v0, p = some_runs(m, 4, 120)
    q, v = MujocoBatch.of(morphologies, phase, threads=2).run(q0, v0, p)
    np.testing.assert_array_equal(q, MujocoBatch.of(morphologies, phase, threads=1).run(q0, v0, p)[0])
    for i, each in enumerate(morphologies):
        alone_q, alone_v = MujocoBatch(each, phase).run(q0[i : i + 1], v0[i : i + 1], p[i : i + 1])
        np.testing.assert_allclose(q[i], alone_q[0], atol=1e-7)
        np.testing.assert_allclose(v[i], alone_v[0], atol=1e-5)
    assert np.abs(q[0, -1] - q[1, -1]).max() > 1e-3


def test_a_batch_of_one_may_have_as_many_runs_as_wanted() -> None:
    m = nominal_leg()
    q0, v0, p = some_runs(m, 3, 5)
    np.testing.assert_allclose(MujocoBatch.of([m]).run(q0, v0, p)[0], MujocoBatch(m).run(q0, v0, p)[0], atol=1e-10)


def test_one_sided_stops_are_kept() -> None:
    m = nominal_leg()
    hip, knee = m.joints
    one = replace(m, joints=(replace(hip, lower=None), replace(knee, upper=None)))
    batch = MujocoBatch.of([one, one.with_parameters({"knee.lower.stiffness": 90.0})])
    assert_same_models(batch, list(batch.morphologies), "swing")


@every_phase
def test_a_batch_of_one_is_of_its_own_numbers(phase: Phase) -> None:
    """Numbers at zero too, in place of which the compiled model has others."""
    m = nominal_leg().with_parameters({"thigh.com": 0.0, "baa.insertion.radius": 0.0})
    batch = MujocoBatch.of([m], phase)
    assert_same_models(batch, [m], phase)
    q0, v0, p = some_runs(m, 2, 60)
    np.testing.assert_allclose(batch.run(q0, v0, p)[0], MujocoBatch(m, phase).run(q0, v0, p)[0], atol=1e-7)


@every_phase
def test_runs_may_have_stops_at_other_joints_and_on_other_sides(phase: Phase) -> None:
    m = nominal_leg()
    hip, knee = m.joints
    tight = replace(knee, lower=JointStop(0.79, 40.0, 0.1), upper=JointStop(0.82, 90.0, 0.4))
    robots = [m, m.without_stops(), replace(m, joints=(replace(hip, upper=None), tight))]
    robots.append(replace(m, joints=(hip, replace(knee, lower=None))))
    q0, v0, p = np.tile([1.3, 0.8], (4, 1)), np.zeros((4, 2)), np.tile([15e3, 2e3], (4, 480, 1))
    settings = replace(FAST_SETTINGS, timestep=1 / 480)
    q, _ = MujocoBatch.of(robots, phase, settings).run(q0, v0, p)
    reverse, _ = MujocoBatch.of(robots[::-1], phase, settings).run(q0, v0, p)
    np.testing.assert_array_equal(q, reverse[::-1])
    for i, robot in enumerate(robots):
        alone, _ = MujocoBatch(robot, phase, settings).run(q0[i : i + 1], v0[i : i + 1], p[i : i + 1])
        np.testing.assert_allclose(q[i], alone[0], atol=1e-7)
    assert np.abs(q[2] - q[1]).max() > 0.01


def test_what_cannot_be_in_one_batch_is_said() -> None:
    m = nominal_leg()
    with pytest.raises(ModelError, match="at least one morphology"):
        MujocoBatch.of([])
    with pytest.raises(ModelError, match="morphology 1, 'one_joint_0', differs"):
        MujocoBatch.of([m, random_morphology("one_joint", 0)])
    with pytest.raises(ModelError, match="actuator 'maa': mass is 0"):
        MujocoBatch.of([m, m.with_parameters({"maa.mass": 0.0})])


def test_wrong_inputs_end_in_a_sentence() -> None:
    m = nominal_leg()
    batch = MujocoBatch(m)
    q0, v0, p = some_runs(m, 2, 5)
    for bad in [(q0[0], v0, p), (q0, v0[:1], p), (q0, v0, p[:, 0]), (q0, v0, p[:, :0]), (q0[:0], v0[:0], p[:0])]:
        with pytest.raises(ConfigError, match="has shape"):
            batch.run(*bad)
    with pytest.raises(ConfigError, match=r"nominal_leg: q0 has shape \(2, 2\), expected \(3, 2\)"):
        MujocoBatch.of([m, m, m]).run(q0, v0, p)
    p[1, 3, 0] = math.nan
    with pytest.raises(ConfigError, match="nominal_leg: pressure of run 1 holds numbers that are not finite"):
        batch.run(q0, v0, p)
    with pytest.raises(ConfigError, match="threads is 0, expected at least 1"):
        MujocoBatch(m, threads=0)


def test_an_actuator_without_length_is_named() -> None:
    m = nominal_leg().without_stops()
    ends = m.actuators[0]
    folded = replace(ends, insertion=replace(ends.insertion, radius=0.06, angle=0.0))
    batch = MujocoBatch(replace(m, actuators=(folded, m.actuators[1])))
    with pytest.raises(ModelError, match="run 1: actuator 'maa' has no length at the start"):
        batch.run(np.array([[1.0, 0.5], [0.0, 0.5]]), np.zeros((2, 2)), np.zeros((2, 3, 2)))


def test_softness_scales_how_far_an_equality_gives_way() -> None:
    """A link hung from its insertion alone: the end's distance from it in the first instant."""
    m = nominal_leg()
    soft = SolverSettings(timestep=1 / 480, integrator="RK4")
    gaps = []
    for settings in (soft, replace(soft, softness=0.1)):
        model = compile_model(m, "swing", settings)
        data = mujoco.MjData(model)
        place(model, data, Kinematics(m), np.array([1.2, 0.6]))
        data.ctrl[:] = 2e4
        for _ in range(240):
            mujoco.mj_step(model, data)
        gaps.append(np.linalg.norm(data.site("maa/end").xpos - data.site("maa/insertion").xpos))
    assert gaps[1] == pytest.approx(0.1 * gaps[0], rel=0.05)


@pytest.mark.parametrize("softness", [0.0, -1.0, math.nan, math.inf])
def test_softness_must_be_positive(softness: float) -> None:
    with pytest.raises(ModelError, match="softness is"):
        compile_model(nominal_leg(), "swing", SolverSettings(softness=softness))


def test_a_stop_of_its_own_stiffness_is_felt_in_each_run() -> None:
    m = nominal_leg()
    stiff = replace(m.joints[1], lower=JointStop(-0.035, 600.0, 1.0), upper=JointStop(2.0, 600.0, 1.0))
    fine = SolverSettings(timestep=1 / 1200, integrator="RK4")
    batch = MujocoBatch.of([m, replace(m, joints=(m.joints[0], stiff))], settings=fine)
    q0 = np.tile([1.2, 0.0], (2, 1))
    q, _ = batch.run(q0, np.zeros((2, 2)), np.tile([0.0, 5e4], (2, 3600, 1)))
    depth = -0.035 - q[:, -1, 1]
    assert depth[0] > 1e-3
    assert depth[0] == pytest.approx(3 * depth[1], rel=0.02)
