"""A diagnosis told: all its figures, the page and the terminal."""

from __future__ import annotations

import io
import re
import shlex
from dataclasses import replace
from html.parser import HTMLParser

import pytest
from diagnosed_leg import VERDICTS, consistent
from rich.console import Console
from rival_legs import with_other
from typer.main import get_command

from equimus_ctrl.cli.main import app
from equimus_ctrl.diagnosis.results import Diagnosis
from equimus_ctrl.report import diagnosis_text
from equimus_ctrl.report.diagnosis_figures import diagnosis_figures
from equimus_ctrl.report.diagnosis_next import deciding, next_steps
from equimus_ctrl.report.diagnosis_page import _method, page
from equimus_ctrl.report.diagnosis_text import print_diagnosis, sentence
from equimus_ctrl.report.diagnosis_words import estimate_text

# Figures and page


@pytest.mark.usefixtures("undrawn")
def test_what_was_rejected_is_told_with_its_reason_and_stage(diagnosis: Diagnosis) -> None:
    (own,) = diagnosis.rejected
    (line,) = diagnosis_text.rejected(diagnosis)
    assert own.reason in line and f"({own.stage})" in line and "reep" in line
    assert not any(own.reason in said for said in diagnosis_text.remains(diagnosis))
    text = page(diagnosis, "leg")
    section = text[text.index('<section id="rejected">') :].split("</section>")[0]
    assert own.reason in section and f">{own.stage}<" in section
    assert 'id="rejected"' not in page(replace(diagnosis, rejected=()), "leg")
    (written,) = diagnosis.to_dict()["rejected"]
    assert written == {**own.named.to_dict(), "stage": own.stage, "reason": own.reason}


@pytest.mark.parametrize(
    ("not_done", "held_out", "said"),
    [
        (("unexplained", "units"), True, "validation trials confirm it"),
        (("groups", "confirmation", "units"), True, "validation trials confirm it as fitted by then"),
        (("groups", "confirmation", "units"), False, "nothing was held out to confirm it"),
    ],
)
def test_an_ended_diagnosis_says_what_held_out_trials_say(
    diagnosis: Diagnosis, not_done: tuple[str, ...], held_out: bool, said: str
) -> None:
    d = replace(diagnosis, verdict="unfinished", not_done=not_done)
    d = d if held_out else replace(d, validation=())
    text = diagnosis_text.verdict(d)
    assert text.startswith(f"Unfinished, ended in the stage {not_done[0]}: so far one effect missing")
    assert diagnosis.unexplained and f"{said}; some residuals are unexplained." in text
    assert f"{said}. The notes" in diagnosis_text.verdict(replace(d, unexplained=()))
    nothing = diagnosis_text.verdict(replace(d, findings=()))
    assert "so far no missing effect was found" in nothing and "confirm" not in nothing


@pytest.mark.slow
@pytest.mark.parametrize("verdict", VERDICTS)
def test_all_figures_of_every_verdict_can_be_drawn(diagnosis: Diagnosis, verdict: str) -> None:
    d = VERDICTS[verdict](diagnosis)
    figures = diagnosis_figures(d)
    expected = {"summary", "before_after", "residuals", "ranking"}
    expected |= {"finding_1"} if d.findings else set()
    expected |= {"unexplained_1"} if d.unexplained else set()
    assert set(figures) == expected
    for figure in figures.values():
        figure.canvas.draw()


@pytest.mark.slow
@pytest.mark.parametrize("joint", ["hip", "knee"])
def test_what_is_unexplained_is_shown_where_it_is(diagnosis: Diagnosis, joint: str) -> None:
    d = VERDICTS["unexplained"](diagnosis)
    d = replace(d, unexplained=(replace(d.unexplained[0], location=joint),))
    assert d.findings == ()
    assert diagnosis_figures(d)["summary"].axes[0].get_title(loc="left").startswith(f"{joint}, ")


@pytest.mark.slow
def test_figures_without_held_out_trials_show_those_fitted(diagnosis: Diagnosis) -> None:
    residuals = {state: replace(r, validation=()) for state, r in diagnosis.residuals.items()}
    d = replace(diagnosis, validation=(), residuals=residuals)
    figures = diagnosis_figures(d)
    texts = [t.get_text() for axes in figures["before_after"].axes for t in (axes.title, axes._left_title)]
    assert any("first (fitted)" in text for text in texts)
    assert diagnosis_text.headline(d) == ""
    assert "The fitted trials with the largest residuals" in page(d, "no judges")


class Checker(HTMLParser):
    """Whether tags match; what is linked, shown and named."""

    VOID = ("meta", "img", "br", "source")

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.seen: list[tuple[str, dict[str, str | None]]] = []
        self.text: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.seen.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] != "style":
            self.text.append(data)


def checked(text: str) -> Checker:
    checker = Checker()
    checker.feed(text)
    checker.close()
    assert checker.open == []
    return checker


def test_the_page_is_whole_and_needs_nothing_else(diagnosis: Diagnosis) -> None:
    text = page(diagnosis, "Leg & <i>co</i>", 'equimus-ctrl diagnose "<my> recordings"')
    found = checked(text)
    assert text.startswith("<!DOCTYPE html>")
    assert "http" not in re.sub(r"base64,[^\"]*", "", text)
    tags = {tag for tag, _ in found.seen}
    assert not tags & {"script", "link", "iframe", "object", "b", "i"}
    pictures = [attrs for tag, attrs in found.seen if tag == "img"]
    assert len(pictures) == 6
    for attrs in pictures:
        assert str(attrs["src"]).startswith("data:image/png;base64,") and attrs["alt"]
    ids = [attrs["id"] for _, attrs in found.seen if "id" in attrs]
    links = [str(attrs["href"]) for tag, attrs in found.seen if tag == "a"]
    assert [f"#{name}" for name in ids] == links and len(ids) == len(set(ids)) == 12
    said = " ".join(found.text)
    assert "<b>x" in said and "Leg & <i>co</i>" in said and '"<my> recordings"' in said
    for one in diagnosis.findings:
        assert sentence(one, diagnosis.model) in said
        assert estimate_text(one.parameters["threshold"]) in said
    for word in ("supply coupling at baa", "creep at maa", "21.3 s"):
        assert word in said
    assert "up to 0.020 N·m·s/rad (0.016 to 0.024)" in said
    assert "maa.damping ended at a bound & more." in said


@pytest.mark.usefixtures("undrawn")
def test_a_consistent_page_tells_what_would_have_shown(diagnosis: Diagnosis) -> None:
    said = " ".join(checked(page(consistent(diagnosis), "Leg")).text)
    assert "Consistent" in said
    assert "0.061 kPa at baa" in said and "1 ± 0.0020 at hip" in said and "no size that was tried at baa" in said
    assert "corrected" not in said and "Missing physics" not in said


def test_the_method_says_how_the_trials_were_fitted(diagnosis: Diagnosis) -> None:
    assert "by simulating each trial fitted as a whole" in _method(diagnosis)
    in_two = _method(replace(diagnosis, train=(*diagnosis.train, *diagnosis.train)))
    assert "by multiple shooting over intervals of" in in_two and "as a whole" not in in_two


# Terminal


def told(diagnosis: Diagnosis, width: int = 100) -> str:
    console = Console(width=width, record=True, file=io.StringIO(), highlight=False)
    print_diagnosis(console, diagnosis)
    return console.export_text()


@pytest.mark.parametrize("verdict", VERDICTS)
@pytest.mark.parametrize("width", [60, 100])
def test_the_terminal_is_told_every_verdict(diagnosis: Diagnosis, verdict: str, width: int) -> None:
    d = VERDICTS[verdict](diagnosis)
    lines = told(d, width).splitlines()
    text = " ".join(line.strip() for line in lines)
    assert len(lines) <= (60 if width == 100 else 90)
    assert max(map(len, lines)) <= width
    assert diagnosis_text.verdict(d) in text
    for one in d.findings:
        assert sentence(one, d.model) in text
    assert ("the error changes by" in text) == bool(d.findings) and ("the error is" in text) != bool(d.findings)
    assert ("Where the residuals of the refitted model are" in text) == (verdict != "consistent")
    assert ("Unexplained residuals" in text) == bool(d.unexplained)
    assert "experiment design" not in text
    assert ("0.061 kPa at baa" in text) == (verdict == "consistent")


def test_names_are_not_taken_for_markup(diagnosis: Diagnosis) -> None:
    d = replace(diagnosis, notes=("[red]as it is[/red]", "[/nothing]"))
    assert "[red]as it is[/red]" in told(d)


def test_the_fall_on_held_out_trials_is_that_of_the_rmse(diagnosis: Diagnosis) -> None:
    before, after = (diagnosis.rmse(s, "validation")[1] for s in ("refitted", "corrected"))
    change = round(100 * (1 - after / before))
    assert f"−{change} % at the knee" in diagnosis_text.headline(diagnosis)


@pytest.mark.usefixtures("undrawn")
def test_candidates_without_a_gain_are_folded_away(diagnosis: Diagnosis) -> None:
    """None is lost: each stands in the table or under the fold, and what was found is never folded."""
    text = page(diagnosis, "leg")
    section = text[text.index('<section id="candidates">') :].split("</section>")[0]
    above, _, folded = section.partition("<details>")
    below = [r for r in diagnosis.ranking if max(r.screened, r.fitted or 0.0) < r.threshold]
    marked = {*diagnosis_text.laws(diagnosis.findings), *(own.named for own in diagnosis.rejected)}
    marked |= {other for finding in diagnosis.findings for other in finding.equivalent}
    expected = [r for r in below if r.named not in marked]
    assert above.count("<tr") - 1 == len(diagnosis.ranking) - len(expected)
    if expected:
        assert f"<summary>{len(expected)} others" in folded and folded.count("<tr") - 1 == len(expected)
    nothing = [replace(r, screened=0.1, fitted=None) for r in diagnosis.ranking]
    all_folded = page(replace(diagnosis, findings=(), rejected=(), ranking=tuple(nothing)), "leg")
    assert f"<summary>{len(nothing)} candidates, the gain of all of them below" in all_folded


@pytest.mark.usefixtures("undrawn")
def test_what_to_do_next_names_commands_with_the_files_at_hand(diagnosis: Diagnosis) -> None:
    given = "equimus-ctrl diagnose runs --model 'my robot.toml' --write-model=found.toml"
    steps = dict(next_steps(diagnosis, given))
    commands = list(steps.values())
    assert "equimus-ctrl score NEW_RECORDINGS --model found.toml" in commands
    assert "equimus-ctrl autotune pid --model found.toml" in commands
    assert "equimus-ctrl compare hold --model 'my robot.toml' --corrected found.toml" in commands
    assert f"{given} --splits 8" in commands and f"{given} --plugin my_effect.py" in commands
    assert not any("--write-model corrected.toml" in command for command in commands)
    assert "equimus-ctrl diagnose RECORDINGS --write-model corrected.toml" in dict(next_steps(diagnosis)).values()
    nothing = next_steps(consistent(diagnosis), given)
    assert "equimus-ctrl check RECORDINGS --model 'my robot.toml'" in [command for _, command in nothing]
    assert not any("autotune" in command for _, command in nothing)
    ended = next_steps(replace(diagnosis, verdict="unfinished"), given)
    assert ended[0][0].startswith("Have the diagnosis carried to its end")
    said = page(diagnosis, "leg", given)
    assert said.rindex("<section") == said.index('<section id="next">')


def test_every_command_of_what_to_do_next_is_one(diagnosis: Diagnosis) -> None:
    """Verbs and options are those of the command."""
    root = get_command(app)
    for verdict in VERDICTS.values():
        left = verdict(with_other(diagnosis))
        lines = [line for own in (verdict(diagnosis), left) for _, line in next_steps(own, "")]
        for words in map(shlex.split, [part for line in lines for part in line.split(" && ") if part]):
            assert words[0] == "equimus-ctrl"
            verb = root.commands[words[1]]  # type: ignore[attr-defined]
            verb = verb.commands[words[2]] if hasattr(verb, "commands") else verb
            known = {name for parameter in verb.params for name in parameter.opts}
            assert {word for word in words[2:] if word.startswith("--")} <= known, words


@pytest.mark.slow
def test_an_experiment_is_named_where_something_is_left_to_decide(diagnosis: Diagnosis) -> None:
    left = with_other(diagnosis)
    given = "equimus-ctrl diagnose runs --report 'my report' --model=robot.xml --lock wrist=0.5 --plugin own.py"
    line = "equimus-ctrl experiment design 'my report' --model=robot.xml --lock wrist=0.5 --plugin own.py"
    found = deciding(left, given)
    assert found is not None and found[1] == line and "do not distinguish" in found[0]
    assert line in dict(next_steps(left, given)).values() and line in page(left, "leg", given).replace("&#x27;", "'")
    console = Console(width=400, record=True, file=io.StringIO())
    print_diagnosis(console, left, given)
    assert line in console.export_text()
    without = deciding(left)
    assert without is not None
    assert without[1] == "equimus-ctrl diagnose RECORDINGS --report report && equimus-ctrl experiment design report"
    assert deciding(diagnosis, given) is None
    assert deciding(replace(left, verdict="unfinished"), given) is None
    alone, both = (deciding(replace(own, below=(own.best.hypothesis,)), given) for own in (diagnosis, left))
    assert alone is not None and alone[0].startswith("Design a trial that shows effects") and alone[1] == line
    assert both is not None and "do not distinguish and shows effects" in both[0]
