"""The report of a robot of many joints with long names: nothing is cut, nothing lies upon another, a law is told once."""

from __future__ import annotations

import io
import re
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from diagnosed_arm import FRICTION, JOINTS, diagnosed_arm
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.transforms import Bbox
from rich.console import Console
from test_diagnosis_report import checked

from equimus_ctrl.diagnosis.hypothesis import Candidate, Part
from equimus_ctrl.diagnosis.results import Diagnosis, Estimate, Named
from equimus_ctrl.effects import REGISTRY
from equimus_ctrl.report import diagnosis_text
from equimus_ctrl.report.diagnosis_curves import panels
from equimus_ctrl.report.diagnosis_figures import diagnosis_figures
from equimus_ctrl.report.diagnosis_page import _findings, _size, page
from equimus_ctrl.report.diagnosis_panels import Scene
from equimus_ctrl.report.diagnosis_words import short


@pytest.fixture(scope="module")
def arm() -> Diagnosis:
    return diagnosed_arm(spring=True)


@pytest.fixture(scope="module")
def figures(arm: Diagnosis) -> dict[str, Figure]:
    return diagnosis_figures(arm)


def told(diagnosis: Diagnosis) -> str:
    console = Console(width=100, record=True, file=io.StringIO(), highlight=False)
    diagnosis_text.print_diagnosis(console, diagnosis)
    return re.sub(r"\s+", " ", console.export_text())


def boxes(figure: Figure) -> list[tuple[str, Bbox]]:
    """All texts that can be seen, and where they are [px]."""
    figure.canvas.draw()
    hidden: set[int] = set()
    for axes in figure.findobj(Axes):
        assert isinstance(axes, Axes)
        hidden |= {id(text) for text in axes.findobj(Text) if not axes.axison}
        for axis in (axes.xaxis, axes.yaxis):
            low, high = sorted(axis.get_view_interval())
            for tick in (*axis.get_major_ticks(), *axis.get_minor_ticks()):
                beyond = not low <= tick.get_loc() <= high
                hidden |= {id(label) for label in (tick.label1, tick.label2) if beyond}
    texts = [text for text in figure.findobj(Text) if isinstance(text, Text) and id(text) not in hidden]
    return [(t.get_text(), t.get_window_extent()) for t in texts if t.get_visible() and t.get_text().strip()]


@pytest.mark.slow
def test_no_text_of_a_figure_is_cut_or_lies_upon_another(figures: dict[str, Figure]) -> None:
    assert set(figures) == {"summary", "before_after", "residuals", "ranking", "finding_1", "finding_7"}
    for name, figure in figures.items():
        seen = boxes(figure)
        width, height = figure.canvas.get_width_height()
        for text, box in seen:
            inside = box.x0 >= -1 and box.y0 >= -1 and box.x1 <= width + 1 and box.y1 <= height + 1
            assert inside, f"{name}: {text!r} is cut at {box}"
        for (first, a), (second, b) in combinations(seen, 2):
            over = min(a.x1, b.x1) - max(a.x0, b.x0), min(a.y1, b.y1) - max(a.y0, b.y0)
            assert min(over) < 2, f"{name}: {first!r} lies upon {second!r}"


@pytest.mark.slow
def test_the_page_tells_a_law_once_with_its_size_at_each_joint(arm: Diagnosis) -> None:
    found = checked(page(arm, "Arm"))
    said = " ".join(found.text)
    assert diagnosis_text.held_out(arm) in said and diagnosis_text.together(arm) in said
    assert said.count("coulomb friction at each of the 6 joints") >= 2
    assert "each with its own size" not in said
    pictures = [attrs for tag, attrs in found.seen if tag == "img"]
    assert len(pictures) == 6


def rows(html: str) -> list[list[str]]:
    """The cells of all rows of a text."""
    cells = [re.findall(r"<t[dh][^>]*>(.*?)</t[dh]>", row) for row in re.findall(r"<tr.*?</tr>", html)]
    return [[re.sub("<.*?>", "", cell) for cell in row] for row in cells]


def test_the_error_is_a_table_by_joint(arm: Diagnosis) -> None:
    above, below, *body = rows(_size(arm))
    assert above == ["RMSE in mrad", "fitted", "validation", "noise"]
    assert below == ["", *["nominal", "refitted", "augmented"] * 2, ""]
    assert [row[0] for row in body] == [*JOINTS, "all joints"]
    shown = np.array([[float(cell) for cell in row[1:]] for row in body])
    parts = [
        arm.rmse(state, part) for part in ("train", "validation") for state in ("nominal", "refitted", "corrected")
    ]
    np.testing.assert_allclose(shown[:-1, :-1].T, 1e3 * np.array(parts), rtol=6e-3)
    np.testing.assert_allclose(shown[-1], np.sqrt((shown[:-1] ** 2).mean(axis=0)), rtol=1e-2)


def test_findings_are_a_table_of_laws_and_one_of_places(arm: Diagnosis) -> None:
    html = _findings(arm, {f"finding_{k}": Figure() for k in (1, 7)})
    table = rows(html)
    assert table[0] == ["effect", "−2 log likelihood", "explained alone", "explained beside the others"]
    assert table[2][0] == "coulomb friction at each of the 6 joints" and table[2][5:] == [
        "61 %",
        "58 %",
        "97 %",
        "95 %",
    ]
    assert table[3][0] == f"parallel spring at {JOINTS[2]}"
    assert table[4][0] == "all together" and table[4][-2:] == ["100 %", "100 %"]
    places = {row[0]: row[1] for row in table[5:] if row[0] in JOINTS}
    assert list(places) == list(JOINTS)
    for joint, size in FRICTION.items():
        assert float(places[joint].split()[0]) == pytest.approx(size, rel=1e-2) and "N·m (" in places[joint]


def test_the_terminal_says_the_same(arm: Diagnosis) -> None:
    text = told(arm)
    assert "two effects missing from the model: coulomb friction at each of the 6 joints and parallel spring" in text
    law = "1. Coulomb friction at each of the 6 joints (dry friction): friction 0.0500 N·m at wrist_third_joint to 0.500 N·m"
    assert law in text and "2. A spring of" in text and "3." not in text.split("Missing physics")[1]
    for joint in JOINTS:
        assert f"{joint}: friction" in text
    assert [diagnosis_text.share_alone(s) for s in (0.12, -0.099, np.nan)] == ["12 %", "none", "–"]
    assert text.count("explains 97 %") == 1 and "beside the others, 61 % alone" in text
    assert "All together explain 100 % of the excess residual variance (100 % in validation)." in text


def test_what_was_held_out_is_one_sentence(arm: Diagnosis) -> None:
    assert diagnosis_text.held_out(arm) == (
        "Held out: t2 for validation, nothing for the test; trials were cut into shooting intervals of 490 ms, 4 fitted "
        "and 2 held out, each simulated from an initial state of its own."
    )
    whole = replace(arm, train=arm.train[::2], validation=())
    assert diagnosis_text.held_out(whole) == (
        "Nothing was held out; each trial was simulated as a whole, from an initial state of its own."
    )
    one_of_each = diagnosis_text.held_out(replace(arm, train=arm.train[::2]))
    assert "cut into shooting intervals of 490 ms, 2 fitted and 2 held out" in one_of_each
    ends = replace(arm, train=arm.train[::2], validation=arm.train[1:2], test=arm.validation[:1])
    assert "Held out: t0 from 500 ms on for validation, t2 for the test; each trial" in diagnosis_text.held_out(ends)


def test_what_all_explain_together_is_of_the_excess_variance(arm: Diagnosis) -> None:
    """That of the refitted model less what the augmented one leaves, joint by joint above the noise."""
    sigma = np.array([own.sigma for own in arm.best.noise])
    for part in ("train", "validation"):
        before, after = (
            np.maximum(np.concatenate(getattr(arm.residuals[s], part)).var(axis=0, ddof=0) / sigma**2, 0)
            for s in ("refitted", "corrected")
        )
        assert arm.explained(part) == pytest.approx(1 - (after - 1).clip(0).mean() / before.mean(), abs=0.02)
    assert np.isnan(arm.explained("test"))
    record = arm.to_dict()
    assert record["explained_share"]["train"] == arm.explained("train") and record["explained_share"]["test"] is None
    assert record["findings"][0]["evidence"]["share_alone"] == 0.61
    assert record["shooting_interval_s"] == pytest.approx(0.49, abs=0.01)


@pytest.mark.parametrize(
    ("named", "said"),
    [
        (Named("coulomb_friction", JOINTS, each=True), "coulomb friction at each of the 6 joints"),
        (Named("backlash", JOINTS[::-1]), "backlash at all 6 joints"),
        (Named("torque_saturation", tuple(f"motor_of_{j}" for j in JOINTS)), "torque saturation at all 6 actuators"),
        (Named("backlash", JOINTS[:2]), f"backlash at {JOINTS[0]} and {JOINTS[1]}"),
        (
            Named("coulomb_friction", JOINTS[:2], each=True),
            f"coulomb friction at {JOINTS[0]} and {JOINTS[1]}, each with its own size",
        ),
    ],
)
def test_all_joints_are_counted_and_some_are_named(arm: Diagnosis, named: Named, said: str) -> None:
    assert short(named, arm.model) == said


@pytest.mark.parametrize("name", sorted(n for n, e in REGISTRY.items() if "mjcf" in e.robots and "joint" in e.sits_at))
def test_every_effect_of_a_joint_is_shown(arm: Diagnosis, name: str) -> None:
    """A force that is always the same has no curve, and is shown by its numbers."""
    scene, joint = Scene.of(arm), JOINTS[2]
    values = REGISTRY[name].guesses(scene.seen[joint])[0]
    part = Part(Candidate(REGISTRY[name], (joint,), (values,)), values)
    estimates = {key: Estimate(v, v - 0.1 * abs(v), v + 0.1 * abs(v), "1") for key, v in values.items()}
    shown = panels(scene, replace(arm.findings[-1], part=part, parameters=estimates))
    assert shown and all(panel.rows or panel.lines for panel in shown)
