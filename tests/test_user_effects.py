"""Effects from a user's own file: one short class, and every verb and both engines know it."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from morphologies import integrate

from equimus_ctrl import presets
from equimus_ctrl.cli.main import main
from equimus_ctrl.effects import REGISTRY, Effect, ShapingEffect, make, parameter, register
from equimus_ctrl.engines.batch import simulate
from equimus_ctrl.engines.trials import Trial
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.models.kinematics import Kinematics
from equimus_ctrl.models.model import Model
from equimus_ctrl.plants.mujoco_plant import MujocoPlant
from equimus_ctrl.robots.elastic.leg import nominal_leg
from equimus_ctrl.types import Array, Start
from equimus_ctrl.workflow import load_plugins

DRAG = Path(__file__).resolve().parents[1] / "docs" / "examples" / "drag.py"
TEXT = DRAG.read_text(encoding="utf-8")
ATTACHED = "quadratic_drag:knee:coefficient=0.02"


@pytest.fixture(autouse=True)
def registry() -> Iterator[None]:
    before = dict(REGISTRY)
    yield
    REGISTRY.clear()
    REGISTRY.update(before)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_example_is_short() -> None:
    assert len([line for line in TEXT.splitlines() if line.strip()]) < 25


@pytest.mark.slow
def test_from_a_run_to_the_coefficient_that_was_in_it(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    drag = str(DRAG)
    quiet = ["--no-figures", "--json"]
    chirp = ["run", "chirp", "--set", "duration=7", "--record", "rec", *quiet]
    assert main([*chirp, "--effects", drag, "--effect", ATTACHED]) == 0
    Path("start.toml").write_text(
        'morphology = "nominal_leg"\n[[effects]]\neffect = "quadratic_drag"\nlocation = "knee"\ncoefficient = 0.001\n'
    )
    with_model = ["--model", "start.toml", "--effects", drag]
    capsys.readouterr()
    assert main(["score", "rec", *with_model, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rmse_rad"]["knee"] > 5e-3
    free = ["--free", "knee.*", "--folds", "0", "--write-model", "found.toml", "-o", "out"]
    assert main(["identify", "rec", *with_model, *free, *quiet]) == 0
    rows = json.loads(capsys.readouterr().out)["trials"]["parameters"]
    found = next(row for row in rows if row["name"] == "knee.quadratic_drag.coefficient")
    assert found["unit"] == "N·m·s²/rad²"
    assert found["value"] == pytest.approx(0.02, rel=2e-3)
    for engine in ("reduced", "mujoco"):
        assert main(["score", "rec", "--model", "found.toml", "--effects", drag, "--engine", engine, "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["rmse_rad"]["knee"] < 3e-5
    pattern = ["--parameter", "*drag*", "--share", "50", "-o", "out2", *quiet]
    assert main(["sensitivity", "rec", *with_model, *pattern]) == 0
    assert json.loads(capsys.readouterr().out)["parameters"]
    assert main(["list", "effects", "--effects", drag, "--json"]) == 0
    assert "quadratic_drag" in {row["name"] for row in json.loads(capsys.readouterr().out)["effects"]}


def test_it_takes_part_in_a_closed_loop(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    hold = ["run", "hold", "-c", "pid", "--set", "duration=1", "--no-figures", "--json"]
    rmse = []
    for own in ([], ["--effects", str(DRAG), "--effect", "quadratic_drag:hip:coefficient=2"]):
        assert main([*hold, *own]) == 0
        rmse.append(json.loads(capsys.readouterr().out)["rmse_rad"])
    assert rmse[0] != rmse[1]


@pytest.mark.slow
def test_the_example_is_the_drag_that_it_says() -> None:
    load_plugins([DRAG])
    leg = nominal_leg()
    model = Model(leg, (make("quadratic_drag", "knee", {"coefficient": 0.05}),))
    k, start, pressure = Kinematics(leg), np.array([1.3, 0.9]), np.array([18e3, 9e3])
    times = np.arange(60) / 120

    def acceleration(t: float, q: Array, v: Array) -> Array:
        return k.acceleration(q, v, pressure, [0.0, -0.05 * v[1] * abs(v[1])])

    expected, _ = integrate(acceleration, start, np.zeros(2), times)
    trial = Trial("t", np.zeros(1), pressure[None], pressure, 0.0, start, times)
    np.testing.assert_allclose(simulate([model], [trial], threads=1)[0].position[0], expected, rtol=0, atol=1e-7)
    plant = MujocoPlant(model)
    seen = [plant.reset(Start(position=start, command=pressure)).position]
    seen += [plant.step(pressure).position for _ in times[1:]]
    np.testing.assert_allclose(seen, expected, rtol=0, atol=5e-5)


# --- other kinds --------------------------------------------------------------------------------------------------

OTHERS = """
from dataclasses import dataclass
import numpy as np
from equimus_ctrl.effects import BodyEffect, SensorEffect, ShapingEffect, ValveEffect, parameter, register

@register
@dataclass(frozen=True)
class Leak(ShapingEffect):
    name, summary, order = "leak", "a share of the pressure is lost", 3
    share: float = parameter("1", 0.0, 1.0, "that is lost")
    def shape(self, commands, own):
        return (1 - self.share) * commands[:, own]

@register
@dataclass(frozen=True)
class Slow(ValveEffect):
    name, summary, exclusive = "slow", "fills slowly", "lag"
    time: float = parameter("s", 0.0, 1.0, "of filling")
    def apply(self, valve):
        valve[1] = self.time

@register
@dataclass(frozen=True)
class Heavy(BodyEffect):
    name, summary, sits_at = "heavy", "a link of another mass", ("link",)
    factor: float = parameter("1", 0.1, 10.0, "on the mass")
    def changes(self, robot):
        return {f"{self.location}.mass": self.factor * robot.link(self.location).mass}

@register
@dataclass(frozen=True)
class Mirror(SensorEffect):
    name, summary = "mirror", "the encoder is mounted the wrong way round"
    about: float = parameter("rad", -4.0, 4.0, "angle at which it is right")
    def apply(self, sensor):
        sensor[0], sensor[1] = 2 * self.about, -1.0
"""


def test_every_kind_of_effect_works_in_both_engines(folder: Path) -> None:
    Path("others.py").write_text(OTHERS)
    assert load_plugins(["others.py"]) == ("leak", "slow", "heavy", "mirror")
    start, times = np.array([1.3, 0.9]), np.arange(60) / 120
    before, after = np.array([12e3, 4e3]), np.array([18e3, 9e3])
    trial = Trial("t", np.zeros(1), after[None], before, 0.0, start, times)
    plain = simulate([Model(nominal_leg())], [trial], threads=1)[0].position[0]
    for name, place, value in (
        ("leak", "maa", 0.4),
        ("slow", "maa", 0.2),
        ("heavy", "calf", 3.0),
        ("mirror", "hip", 1.0),
    ):
        key = next(iter(REGISTRY[name].parameter_info()))
        model = Model(nominal_leg(), (make(name, place, {key: value}),))
        expected = simulate([model], [trial], threads=1)[0].position[0]
        plant = MujocoPlant(model)
        seen = [plant.reset(Start(position=start, command=before)).position]
        seen += [plant.step(after).position for _ in times[1:]]
        np.testing.assert_allclose(seen, expected, rtol=0, atol=2e-5, err_msg=name)
        assert np.abs(expected - plain).max() > 0.02, name


# --- what goes wrong ----------------------------------------------------------------------------------------------

LAW = """
    @classmethod
    def {}:
        return p["coefficient"]
"""
WRONG = {
    "x = 1": "registers nothing; put @register above an effect's class, or call register_",
    "1 / 0": "fails when it is loaded: ZeroDivisionError: division by zero",
    "import no_such_module": "fails when it is loaded: ModuleNotFoundError: No module named 'no_such_module'",
    TEXT.replace("quadratic_drag", "creep"): "effect creep: there is one of that name already, in equimus_ctrl.effects",
    TEXT.replace(
        "@dataclass(frozen=True)\n", ""
    ): "is no dataclass; put @dataclass(frozen=True) between it and @register",
    TEXT.replace('"quadratic_drag"', '"quadratic drag"'): "name is 'quadratic drag', expected a plain name",
    TEXT.replace('name = "quadratic_drag"', ""): "lacks 'name'",
    TEXT.replace('("joint",)', '"joint"'): "sits_at is 'joint', expected a tuple of joint, actuator",
    TEXT.replace('("joint",)', '("foot",)'): "sits_at is ('foot',), but a force acts at a joint or an actuator",
    TEXT.replace('neutral = {"coefficient": 0.0}', ""): "neutral must give values of some of coefficient",
    TEXT.replace('{"coefficient": 0.0}', '{"coefficient": 0.1}'): "it still exerts a force with its neutral parameters",
    TEXT.replace(
        'parameter("N·m·s²/rad²", 0.0, 10.0, "torque at 1 rad/s")', "1.0"
    ): "parameters are made with parameter(",
    TEXT.replace(
        'p["coefficient"]', 'p["size"]'
    ): "its law is no CasADi expression of its arguments, with casadi.if_else",
    TEXT.replace(
        "return -", "return rate if rate > 0 else -"
    ): "its law is no CasADi expression of its arguments, with",
    TEXT.replace(
        "    coefficient", "    n_states = 1\n    coefficient"
    ): "state_rate gives 0 and rest_state 0 values, exp",
    TEXT + LAW.format("more_area(cls, x, rest, p)"): "sits_at is ('joint',), but only an actuator has an area that may",
    TEXT + LAW.format("friction_of_load(cls, load, speed, p)"): "but only an MJCF robot has friction of loads",
}


@pytest.mark.parametrize("text", WRONG, ids=[message[:30] for message in WRONG.values()])
def test_a_wrong_file_ends_in_a_sentence_and_changes_nothing(
    text: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = dict(REGISTRY)
    Path("own.py").write_text(text)
    assert main(["list", "effects", "--effects", "own.py"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("equimus-ctrl: own.py: ")
    assert WRONG[text] in said
    assert said.count("\n") == 1
    assert before == REGISTRY


@pytest.mark.parametrize(
    "verb", [["run", "hold"], ["score", "x"], ["identify", "x"], ["sensitivity", "x"], ["list", "effects"]]
)
def test_every_verb_says_that_a_file_is_not_there(
    verb: list[str], folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*verb, "--effects", "nowhere.py"]) == 2
    assert capsys.readouterr().err == "equimus-ctrl: nowhere.py: there is no such file\n"


def test_a_file_loaded_again_replaces_what_it_registered(folder: Path) -> None:
    path = Path("own.py")
    path.write_text(TEXT)
    assert load_plugins([path, path]) == ("quadratic_drag",)
    first = REGISTRY["quadratic_drag"]
    path.write_text(TEXT.replace("quadratic_drag", "drag"))
    assert load_plugins([path]) == ("drag",)
    assert "quadratic_drag" not in REGISTRY and "drag" in REGISTRY
    path.write_text("1 / 0")
    with pytest.raises(ConfigError, match="own.py: fails"):
        load_plugins([path])
    assert "drag" in REGISTRY
    other = Path("other.py")
    other.write_text(TEXT.replace("quadratic_drag", "drag"))
    with pytest.raises(
        ConfigError, match="other.py: effect drag: there is one of that name already, in equimus_user_own"
    ):
        load_plugins([other])
    register(first)
    assert REGISTRY["quadratic_drag"] is first


def test_an_effect_of_no_kind_is_refused_by_those_that_simulate() -> None:
    class Odd(Effect):
        name, side, sits_at, summary = "odd", "force", ("joint",), "of no kind"

    assert not Odd.simulated
    with pytest.raises(ConfigError, match="effect class Odd: is no dataclass"):
        register(Odd)


def test_a_discontinuous_parameter_is_one_of_the_effects_and_positive() -> None:
    """A grid that is even in its logarithm has no values below 0."""

    @dataclass(frozen=True)
    class Jump(ShapingEffect):
        name, summary, order, discontinuous = "jump", "commands below a level are lost", 7, ("level",)
        level: float = parameter("Pa", -1.0, 1e4, "of a command")

    with pytest.raises(
        ConfigError, match="discontinuous parameter 'level' has a lower bound of -1, expected at least 0"
    ):
        register(Jump)

    @dataclass(frozen=True)
    class Other(ShapingEffect):
        name, summary, order, discontinuous = "other", "commands below a level are lost", 7, ("lewel",)
        level: float = parameter("Pa", 0.0, 1e4, "of a command")

    with pytest.raises(ConfigError, match="there is no discontinuous parameter 'lewel'; did you mean"):
        register(Other)

    @dataclass(frozen=True)
    class Even(ShapingEffect):
        name, summary, order, even = "even", "commands below a level are lost", 7, ("lewel",)
        level: float = parameter("Pa", 0.0, 1e4, "of a command")

    with pytest.raises(ConfigError, match="there is no even parameter 'lewel'; did you mean"):
        register(Even)


def test_the_documents_show_the_example() -> None:
    assert math.isclose(float(ATTACHED.rpartition("=")[2]), 0.02)
    for name in ("physics.md", "formats.md"):
        assert "examples/drag.py" in (DRAG.parents[1] / name).read_text(encoding="utf-8")
    assert presets.load_script(DRAG)
