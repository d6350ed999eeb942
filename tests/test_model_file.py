"""Model files: what is written is read back as the same model, and what is wrong is said with the file's name."""

from __future__ import annotations

import copy
import math
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from morphologies import STRUCTURES, random_morphology

from equimus_ctrl.effects import AsymmetricLag, FirstOrderLag, TransportDelay
from equimus_ctrl.errors import ConfigError, EquimusError, ModelError
from equimus_ctrl.models.model import FORMAT, Model, model_from_dict, model_to_dict, nominal_model
from equimus_ctrl.presets import toml_text
from equimus_ctrl.robots.elastic.leg import MORPHOLOGIES, ideal_leg, nominal_leg
from equimus_ctrl.workflow import load_model, save_model


def through_toml(model: Model) -> Model:
    return model_from_dict(tomllib.loads(toml_text(model_to_dict(model))))


MODELS = [
    nominal_model(),
    Model(ideal_leg(), phase="stance"),
    Model(replace(nominal_leg(), name="my leg"), (TransportDelay("baa", 0.1), FirstOrderLag("maa", 0.25))),
    Model(nominal_leg().with_parameters({"hip.lower.angle": 0.4, "maa.stiffness": 280.0, "tilt": -0.1})),
    Model(ideal_leg(), (AsymmetricLag("maa", 0.1, 1 / 3),)),
    *(Model(random_morphology(name, 1, stops=True), phase="stance") for name in STRUCTURES),
    *(Model(random_morphology(name, 2)) for name in STRUCTURES),
]


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.name)
def test_a_model_comes_back_the_same(model: Model, tmp_path: Path) -> None:
    assert model_from_dict(model_to_dict(model)) == model
    assert through_toml(model) == model
    save_model(tmp_path / "deep" / "model.toml", model)
    assert load_model(tmp_path / "deep" / "model.toml") == model
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["model.toml"]


@settings(deadline=None, max_examples=40, derandomize=True)
@given(data=st.data())
def test_any_numbers_come_back_to_the_bit(data: st.DataObject) -> None:
    base = data.draw(st.sampled_from([nominal_leg(), random_morphology("branched", 0, stops=True)]))
    known = base.parameters()
    names = data.draw(st.lists(st.sampled_from(sorted(known)), unique=True, max_size=5))
    factor = st.floats(0.8, 1.2)
    delay = data.draw(st.floats(0, 2))
    values = {name: known[name] * data.draw(factor) for name in names}
    model = Model(base.with_parameters(values), (TransportDelay(base.actuator_names[0], delay),))
    assert through_toml(model) == model


def test_a_leg_known_by_name_is_written_by_what_differs() -> None:
    leg = nominal_leg().with_parameters({"maa.stiffness": 280.0})
    assert model_to_dict(Model(leg, (TransportDelay("baa", 0.1),), "stance")) == {
        "format": "equimus-ctrl/model/1",
        "name": "nominal_leg",
        "phase": "stance",
        "morphology": "nominal_leg",
        "parameters": {"maa.stiffness": 280.0},
        "effects": [{"effect": "transport_delay", "location": "baa", "delay": 0.1}],
    }


def test_an_empty_file_is_the_nominal_leg() -> None:
    assert model_from_dict({}) == nominal_model() == load_model(None)


@pytest.mark.parametrize("name", MORPHOLOGIES)
def test_a_leg_can_be_named(name: str) -> None:
    assert model_from_dict({"morphology": name}).morphology == MORPHOLOGIES[name]()


def test_the_example_of_the_documentation_is_read() -> None:
    text = """
    format = "equimus-ctrl/model/1"
    name = "my_leg"
    morphology = "nominal_leg"
    phase = "swing"

    [parameters]
    "maa.stiffness" = 280

    [[effects]]
    effect = "transport_delay"
    location = "baa"
    delay = 0.1
    """
    leg = replace(nominal_leg().with_parameters({"maa.stiffness": 280.0}), name="my_leg")
    assert model_from_dict(tomllib.loads(text)) == Model(leg, (TransportDelay("baa", 0.1),))


PLAIN: dict[str, Any] = model_to_dict(Model(random_morphology("mono_and_bi", 3, stops=True)))
"""Of a morphology spelt out."""

DELAY = {"effect": "transport_delay", "location": "drive0", "delay": 0.1}


def changed(*path: str | int, to: Any = None, drop: bool = False) -> dict[str, Any]:
    data = copy.deepcopy(PLAIN)
    part: Any = data
    for key in path[:-1]:
        part = part[key]
    if drop:
        del part[path[-1]]
    else:
        part[path[-1]] = to
    return data


def refusal(data: Any) -> EquimusError:
    with pytest.raises((ConfigError, ModelError)) as caught:
        model_from_dict(data, "leg.toml")
    assert "\n" not in str(caught.value)
    return caught.value


LINK = ("morphology", "links", 0)
JOINT = ("morphology", "joints", 0)

WRONG: list[tuple[dict[str, Any], str]] = [
    (changed("paramters", to={}), "leg.toml: there is no key 'paramters'; did you mean 'parameters'?"),
    (changed("format", to="equimus-ctrl/model/2"), f"leg.toml: format is 'equimus-ctrl/model/2', expected {FORMAT!r}"),
    (changed("phase", to="stanec"), "leg.toml: there is no phase 'stanec'; did you mean 'stance'? (known: stance,"),
    (changed("phase", to=3), "leg.toml: there is no phase '3' (known: stance, swing)"),
    (changed("name", to=3), "leg.toml: name is 3, expected a text"),
    (
        changed("morphology", to="nominal_lg"),
        "leg.toml: there is no morphology 'nominal_lg'; did you mean 'nominal_leg'",
    ),
    (changed("morphology", to=3), "leg.toml: morphology is 3, expected a name or a table"),
    (changed("parameters", to=3), "leg.toml: parameters: 3 is not a table of numbers"),
    (changed("parameters", to={"tilt": "0.1"}), "leg.toml: parameters: tilt is '0.1', expected a number"),
    (changed("parameters", to={"tilt": True}), "leg.toml: parameters: tilt is True, expected a number"),
    (
        changed("parameters", to={"drive0": {"area": 1e-4}}),
        "leg.toml: parameters: 'drive0' is a table; put a dotted name in quotes, such as \"maa.stiffness\" = 280",
    ),
    (changed("parameters", to={"drive0.aera": 1.0}), "no parameter 'drive0.aera'; did you mean 'drive0.area'?"),
    (changed("parameters", to={"drive0.area": -1.0}), "leg.toml: actuator 'drive0': area is -1, expected more than 0"),
    (changed(*LINK, "mass", drop=True), "leg.toml: morphology: links[0]: 'mass' is missing"),
    (changed(*LINK, "mas", to=1.0), "leg.toml: morphology: links[0]: there is no key 'mas'; did you mean 'mass'?"),
    (changed(*LINK, "mass", to="heavy"), "leg.toml: morphology: links[0]: mass is 'heavy', expected a number"),
    (changed(*LINK, "mass", to=True), "leg.toml: morphology: links[0]: mass is True, expected a number"),
    (changed(*LINK, "mass", to=[1.0]), "leg.toml: morphology: links[0]: mass is [1.0], expected a number"),
    (changed(*LINK, "name", to=3), "leg.toml: morphology: links[0]: name is 3, expected a text"),
    (changed(*JOINT, "lower", to=0.3), "leg.toml: morphology: joints[0]: lower is 0.3, expected a table"),
    (changed("morphology", "actuators", 0, "origin", to=[0.1]), "actuators[0]: origin is [0.1], expected a table"),
    (changed("morphology", "foot", drop=True), "leg.toml: morphology: 'foot' is missing"),
    (changed("morphology", "links", to=["thigh"]), "leg.toml: morphology: links[0] is 'thigh', expected a table"),
    (changed("effects", to={}), "leg.toml: effects is {}, expected [[effects]] tables"),
    (changed("effects", to=["transport_delay"]), "leg.toml: effects is ['transport_delay'], expected [[effects]]"),
    (changed("effects", to=[{"effect": "transport_delay"}]), "leg.toml: an [[effects]] table lacks 'location'"),
    (changed("effects", to=[{"location": "drive0"}]), "leg.toml: an [[effects]] table lacks 'effect'"),
    (changed("effects", to=[DELAY | {"effect": "delay"}]), "leg.toml: there is no effect 'delay'"),
    (
        changed("effects", to=[DELAY | {"dealy": 1.0}]),
        "leg.toml: effect transport_delay: there is no parameter 'dealy'",
    ),
    (changed("effects", to=[DELAY | {"delay": "0.1"}]), "leg.toml: transport_delay: delay is '0.1', expected a number"),
    (
        changed("effects", to=[{"effect": "transport_delay", "location": "drive0"}]),
        "leg.toml: effect transport_delay at 'drive0' lacks 'delay' [s]",
    ),
]


@pytest.mark.parametrize(("data", "message"), WRONG, ids=[message[:60] for _, message in WRONG])
def test_what_is_wrong_is_said_in_one_sentence(data: dict[str, Any], message: str) -> None:
    assert message in str(refusal(data))
    assert str(refusal(data)).startswith("leg.toml: ")


@pytest.mark.parametrize(
    "data",
    [
        changed("effects", to=[DELAY | {"delay": 5.0}]),
        changed("effects", to=[DELAY | {"delay": math.nan}]),
        changed("effects", to=[DELAY | {"location": "drvie0"}]),
        changed(*LINK, "mass", to=-1.0),
        changed("morphology", "links", to=[]),
        changed("morphology", "foot", to="foot"),
    ],
)
def test_a_value_that_cannot_be_is_said_with_the_files_name(data: dict[str, Any]) -> None:
    assert str(refusal(data)).startswith("leg.toml: ")


@pytest.mark.parametrize(
    ("data", "part"),
    [
        (changed(*JOINT, "lower", to=[{"angle": 0.1}]), "expected a table"),
        (changed("morphology", "links", to=PLAIN["morphology"]["links"][0]), "links"),
        (changed("morphology", "links", to="thigh"), "expected a list of tables"),
        (changed("morphology", "links", to=3), "expected a list of tables"),
    ],
)
def test_a_table_for_a_list_and_a_list_for_a_table_are_refused_as_such(data: dict[str, Any], part: str) -> None:
    assert part in str(refusal(data))


def test_files_that_are_not_there_or_not_toml_are_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"gone\.toml: there is no such file"):
        load_model(tmp_path / "gone.toml")
    with pytest.raises(ConfigError, match="cannot be read"):
        load_model(tmp_path)
    broken = tmp_path / "broken.toml"
    broken.write_text("name = ")
    with pytest.raises(ConfigError, match=r"broken\.toml: is not valid TOML"):
        load_model(broken)
    broken.write_bytes(b"name = '\xff'")
    with pytest.raises(ConfigError, match=r"broken\.toml: cannot be read"):
        load_model(broken)
    broken.write_text("phase = 'stan'")
    with pytest.raises(ConfigError, match=r"broken\.toml: there is no phase 'stan'"):
        load_model(broken)


def test_a_phase_that_does_not_exist_is_refused_in_python_too() -> None:
    with pytest.raises(ConfigError, match=r"nominal_leg: there is no phase 'stanec'; did you mean 'stance'\?"):
        Model(nominal_leg(), phase="stanec")  # type: ignore[arg-type]


def test_a_model_carries_the_name_of_its_robot() -> None:
    assert Model(replace(nominal_leg(), name="left leg")).name == "left leg"


@pytest.mark.parametrize("make", [list, tuple])
def test_effects_may_come_as_a_list(make: Callable[[Any], Any]) -> None:
    model = Model(nominal_leg(), make([TransportDelay("maa", 0.1)]))
    assert model == Model(nominal_leg(), (TransportDelay("maa", 0.1),))
    assert through_toml(model).effects == (TransportDelay("maa", 0.1),)
