"""Files of free parameters: what is offered and read, and what is wrong in one, said in a sentence."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from mjcf_models import CRANE, refusal

from equimus_ctrl.effects import CoulombFriction
from equimus_ctrl.identification.parameters import default_names, free_parameters
from equimus_ctrl.models.model import Model
from equimus_ctrl.workflow import offer, read_free


def test_a_file_of_free_parameters_offers_what_is_free_by_default(tmp_path: Path) -> None:
    model = Model(CRANE, (CoulombFriction("reach", 0.3),))
    path = tmp_path / "free.toml"
    offer(path, model)
    text = path.read_text()
    assert all(f'"{name}" = ' in text or f"{name} = " in text for name in model.parameters())
    given = read_free(path, model)
    chosen = free_parameters(model, given.names, given.bounds)
    usual = free_parameters(model)
    assert set(chosen.names) == set(default_names(model))
    assert {f.name: (f.low, f.high) for f in chosen.free} == {f.name: (f.low, f.high) for f in usual.free}


def free_of(tmp_path: Path, text: str, model: Model) -> Any:
    path = tmp_path / "free.toml"
    path.write_text(text)
    return read_free(path, model)


def test_numbers_are_freed_between_bounds_of_ones_own_or_of_their_kind(tmp_path: Path) -> None:
    model = Model(CRANE)
    given = free_of(tmp_path, '[free]\n"arm.mass" = [1, 3]\n"*.damping" = true\n"rod.mass" = false\n', model)
    assert set(given.names) == {"arm.mass", "shoulder.damping", "reach.damping"}
    assert given.bounds == {"arm.mass": (1.0, 3.0)}
    both = given.with_more(["tilt"], {"arm.mass": (1.5, 2.5)})
    assert both == ([*given.names, "tilt"], {"arm.mass": (1.5, 2.5)})


def test_a_pattern_frees_nothing_that_is_said_to_stay(tmp_path: Path) -> None:
    given = free_of(tmp_path, '[free]\n"*.damping" = true\n"reach.damping" = false\n', Model(CRANE))
    assert given.names == ("shoulder.damping",)


WRONG_FREE: dict[str, str] = {
    '[fre]\n"arm.mass" = true': "there is no key 'fre'; did you mean 'free'? (known: format, free)",
    'format = "x"\n[free]\n"arm.mass" = true': "format is 'x', expected 'equimus-ctrl/parameters/1'",
    "free = 3": "there is no [free] table of names",
    "[free]": "there is no [free] table of names",
    "[free]\narm.mass = true": "free: put a dotted name in quotes",
    '[free]\n"arm.mas" = true': "free: crane: there is no parameter 'arm.mas'; did you mean 'arm.mass'?",
    '[free]\n"*.mas" = true': "free: crane: there is no parameter '*.mas'",
    '[free]\n"arm.mass" = [1]': "free: arm.mass is [1], expected true, false or [low, high]",
    '[free]\n"arm.mass" = [1, 2, 3]': "free: arm.mass is [1, 2, 3], expected true, false or [low, high]",
    '[free]\n"arm.mass" = 3': "free: arm.mass is 3, expected true, false or [low, high]",
    '[free]\n"arm.mass" = "free"': "free: arm.mass is 'free', expected true, false or [low, high]",
    '[free]\n"arm.mass" = [true, 2]': "free: arm.mass is [True, 2], expected true, false or [low, high]",
    '[free]\n"arm.mass" = false': "free: everything is false, so nothing is free",
    "free = [": "is not valid TOML",
}


@pytest.mark.parametrize("text", WRONG_FREE, ids=lambda text: re.sub(r"\W+", " ", text)[:60])
def test_what_is_wrong_in_a_file_of_free_parameters_is_said_with_its_name(text: str, tmp_path: Path) -> None:
    told = refusal(lambda: free_of(tmp_path, text, Model(CRANE)))
    assert told.startswith(f"{tmp_path / 'free.toml'}: ") and WRONG_FREE[text] in told


@pytest.mark.parametrize(
    ("pair", "message"),
    [
        ("[3, 1]", "bounds of arm.mass are 3 to 1, expected the lower one first"),
        ("[nan, 3]", "bounds of arm.mass are nan to 3, expected finite numbers"),
        ("[3, 4]", "arm.mass is 2 kg in the model, outside its bounds 3 to 4"),
        ("[-1, 3]", "arm.mass"),
    ],
)
def test_bounds_that_cannot_be_are_refused_before_anything_is_fitted(pair: str, message: str, tmp_path: Path) -> None:
    model = Model(CRANE)

    def chosen() -> None:
        given = free_of(tmp_path, f'[free]\n"arm.mass" = {pair}', model)
        free_parameters(model, given.names, given.bounds)

    assert message in refusal(chosen)
