"""Numbers and names that nobody can have meant, and places where nothing can be written: told before any work."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from wrong_input import RUN, SCORE, Ran, sentence, study

import equimus_ctrl as eq
from equimus_ctrl import outputs, presets
from equimus_ctrl.cli.main import main
from equimus_ctrl.errors import ConfigError, RecordingError, unknown_name
from equimus_ctrl.loop import MOST_INSTANTS, checked_command, run
from equimus_ctrl.models.model import nominal_model
from equimus_ctrl.plants.mujoco_plant import MujocoPlant, whole_ratio
from equimus_ctrl.scenarios.references import HoldReference

TRIAL = "time,cmd.maa,cmd.baa,pos.hip,pos.knee\n" + "".join(f"{k / 60},12000,6000,1.5,0.6\n" for k in range(30))


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((*RUN, "--set", "duration=1e308"), "duration is 1e+308 s, expected more than 0, up to 86400"),
        ((*RUN, "--set", "hip=1e308"), "outside the joint's range of 30.0° to 150.0°"),
        ((*RUN, "--noise", "1e6"), "noise is 1e+06 rad or m, expected 0 to 1"),
        (("autotune-pid", "--seed", "-1"), "seed is -1, expected at least 0"),
        (("autotune-pid", "--candidates", "1" + "0" * 400), "study: candidates is 1000"),
        (("compare", "hold", "--draws", "2000000"), "draws is 2000000, expected at most 1,000,000"),
        (("prove", "--cases", "18446744073709551616"), "cases is 18446744073709551616, expected at most 1,000,000"),
        (("prove", "--workers", "99999999"), "workers is 99999999, expected at most 1,000,000"),
        (("emulate", "--rate", "1e-320"), "is not a whole multiple of 9.99989e-321 Hz"),
        (("check", "good.csv", "--figure", "plain_file/x.png"), "plain_file/x.png: cannot be written"),
        (("check", "good.csv", "--figure", "x.pdf"), "what is written there is PNG; expected a name that ends in .png"),
        (("check", "good.csv", "--figure", "/dev/full"), "/dev/full: is a pipe or a device; a file to write belongs"),
        (("emulate", "--log", "/dev/null"), "/dev/null: is a pipe or a device; a file to write belongs there"),
        (("recordings", "import", "good.csv", "-o", "plain_file"), "plain_file: is no folder and cannot become one"),
        (("recordings", "import-bag", "nowhere", "-o", "plain_file"), "plain_file: is no folder and cannot become one"),
        (("recordings", "export", "nowhere", "-o", "plain_file/x.mcap"), "plain_file: is no folder and cannot become"),
        (("recordings", "fetch", "-o", "plain_file"), "plain_file: is no folder and cannot become one"),
        (("autotune-pid", "--results", "plain_file"), "plain_file: is no folder and cannot become one"),
        (("hardware", "delay", "--arm", "--record", "plain_file"), "plain_file: is no folder and cannot become one"),
        (("score", "\udcff.csv"), "\\udcff.csv: there is no such file"),
    ],
)  # fmt: skip
def test_options_that_cannot_be(arguments: tuple[str, ...], said: str, run_there: Callable[..., Ran]) -> None:
    assert said in sentence(run_there(arguments), 2)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('name = ""', "leg.toml: name is '', expected one that can be read, or none"),
        ('name = "  "', "leg.toml: name is '  ', expected one that can be read, or none"),
        ('[parameters]\n"thigh.mass" = 0', "link 'thigh': mass is 0, expected more than 0"),
        (f'[parameters]\n"thigh.mass" = 1{"0" * 400}', "leg.toml: parameters.thigh.mass is 1000"),
        (f'[parameters]\n"thigh.mass" = {"7" * 5000}', "leg.toml: is not valid TOML: Exceeds the limit"),
        (f"a = [{2**63}]", f"leg.toml: a is {2**63}, expected an integer of at most 64 bits"),
    ],
)  # fmt: skip
def test_models_that_cannot_be(text: str, said: str, run_there: Callable[..., Ran]) -> None:
    assert said in sentence(run_there((*SCORE, "--model", "leg.toml"), {"leg.toml": text}), 2)


@pytest.mark.parametrize(
    ("duration", "said"),
    [(0, "duration is 0, expected 0.1 to 3600"), (1e9, "duration is 1e+09, expected 0.1 to 3600")],
)
def test_a_study_is_driven_for_some_time(duration: float, said: str, run_there: Callable[..., Ran]) -> None:
    text = study(objectives=[{"scenario": "hold", "duration": duration}])
    assert said in sentence(run_there(("autotune-pid", "--study", "s.toml"), {"s.toml": text}), 2)


def test_a_huge_seed_is_a_seed() -> None:
    from equimus_ctrl.tuning.study import study_from_dict

    data = {**presets.tomllib.loads(study()), "seed": 10**400}
    assert study_from_dict(data).seed == 10**400


@pytest.mark.parametrize(
    ("note", "said"),
    [
        ("set.nonsense = 1", "note set.nonsense: there is no parameter 'nonsense'"),
        ("times.maa.area = much", "note times.maa.area is 'much', expected a factor"),
        ("payload.elbow = 1", "note payload.elbow"),
        ("payload.foot = light", "note payload.foot is 'light', expected a mass in kg"),
        ("zero.hip = free", "note 'zero.hip' is for MJCF robots alone"),
    ],
)
def test_notes_of_numbers_are_not_taken_in_silence_for_a_leg(
    note: str, said: str, run_there: Callable[..., Ran]
) -> None:
    text = f"# {note}\n{TRIAL}"
    assert said in sentence(run_there(("score", "noted.csv"), {"noted.csv": text}), 2)


def test_a_number_that_nothing_is_as_large_as_is_no_measurement(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text(
        "time,cmd.motor,pos.hinge\n" + "".join(f"{k / 60},{'-1e308' if k == 7 else 0},0\n" for k in range(30))
    )
    xml = Path(__file__).resolve().parents[1] / "docs" / "examples" / "pendulum.xml"
    with pytest.raises(RecordingError, match=r"row 9, column cmd.motor: -1e\+308 is beyond ±1e\+10"):
        eq.read_recording(path, eq.load_model(xml))


@pytest.mark.parametrize("command", [np.array([1e4 + 1e3j, 0]), ["1", "2"], np.array(["a", "b"]), [None, 1.0], [{}, 1]])
def test_a_command_is_numbers(command: object) -> None:
    spec = MujocoPlant(nominal_model()).spec
    with pytest.raises(eq.ControllerError, match="expected"):
        checked_command(command, spec, 0.0, "Mine")
    np.testing.assert_array_equal(checked_command([1, 2.5], spec, 0.0, "Mine"), [1.0, 2.5])


def test_a_run_has_a_bounded_size() -> None:
    plant = MujocoPlant(nominal_model())
    with pytest.raises(ConfigError, match=f"expected at most {MOST_INSTANTS:,} of them"):
        run(plant, eq.PidController.__new__(eq.PidController), HoldReference(np.zeros(2)), 1e9)


def test_rates_of_which_one_is_nothing_are_no_multiples() -> None:
    assert whole_ratio(480, 120, "physics") == 4
    with pytest.raises(ConfigError, match="is not a whole multiple"):
        whole_ratio(480, 1e-320, "physics")


def test_what_is_no_file_is_never_replaced(tmp_path: Path) -> None:
    """Renaming a temporary file would take the place of a device."""
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "link").symlink_to("nowhere")
    for name, said in (("pipe", "is a pipe or a device"), ("loop", "cannot be written"), (".", "is a folder")):
        with pytest.raises(ConfigError, match=said):
            outputs.check_new(tmp_path / name, force=True)
        with pytest.raises(ConfigError, match=said):
            presets.write_text(tmp_path / name, "x")
    outputs.check_new(tmp_path / "link", force=True)
    presets.write_text(tmp_path / "link", "x")
    assert (tmp_path / "link").read_text() == "x" and not (tmp_path / "link").is_symlink()


def test_a_list_of_names_is_short() -> None:
    names = [f"joint_{k:03d}" for k in range(500)]
    said = unknown_name("joint", "joint_7", names)
    assert len(said) < 500 and "did you mean" in said and said.endswith(" more)")
    assert unknown_name("joint", "a", names[:3]) == "there is no joint 'a' (known: joint_000, joint_001, joint_002)"


def test_nothing_at_all_is_answered_with_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 2
    assert "Usage" in capsys.readouterr().out
