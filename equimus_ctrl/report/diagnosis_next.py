"""What a person can do after a diagnosis, and the commands that do it."""

from __future__ import annotations

import shlex

from equimus_ctrl.diagnosis.results import Diagnosis
from equimus_ctrl.report.diagnosis_words import listed

RECORDINGS, NEW = "RECORDINGS", "NEW_RECORDINGS"
"""What stands for names that are not known."""
SPLITS = 8
REPORT = "report"
"""Folder of a report where there is none yet."""
OF_MODELS = ("--model", "--lock", "--ignore", "--prescribe", "--unmeasured", "--plugin", "--effects")
"""Options of the command line that say what the model is, each with a value."""


def next_steps(diagnosis: Diagnosis, command_line: str = "") -> list[tuple[str, str]]:
    """Sentences, each with the command that does it, or "".

    Args:
        diagnosis: what was found.
        command_line: with which it was made, "" where there was none.
    """
    given = shlex.split(command_line)
    again = command_line or f"equimus-ctrl diagnose {RECORDINGS}"
    model, written = _value(given, "--model"), _value(given, "--write-model")
    of_model = f" --model {shlex.quote(model)}" if model else ""
    what = "augmented" if diagnosis.findings else "refitted"
    name = written or ("corrected.toml" if diagnosis.findings else "refitted.toml")
    corrected = shlex.quote(name)
    steps = []
    if diagnosis.verdict == "unfinished":
        steps.append(("Have the diagnosis carried to its end, without a limit of time: it was ended before.", ""))
    if not written:
        steps.append((f"Write the {what} model, which every other command takes.", f"{again} --write-model {name}"))
    steps.append(
        (
            f"See whether the {what} model predicts recordings that took no part in this diagnosis.",
            f"equimus-ctrl score {NEW} --model {corrected}",
        )
    )
    if diagnosis.findings:
        steps.append(
            ("Tune the controller again, on the augmented model.", f"equimus-ctrl autotune pid --model {corrected}")
        )
        steps.append(
            (
                "See what controllers gain that know the augmented model.",
                f"equimus-ctrl compare hold{of_model} --corrected {corrected}",
            )
        )
    if experiment := deciding(diagnosis, command_line):
        steps.append(experiment)
    if diagnosis.unexplained:
        places = listed(list(dict.fromkeys(own.location for own in diagnosis.unexplained)))
        steps.append(
            (
                f"Look at the robot for what could act at {places} as the curves above show. If no effect of the "
                "catalogue does, one of your own takes part in the diagnosis.",
                f"{again} --plugin my_effect.py",
            )
        )
    if diagnosis.splits is None and diagnosis.findings:
        steps.append(
            (
                "See whether the answer depends on which trials were fitted.",
                f"{again} --splits {SPLITS}",
            )
        )
    if not diagnosis.findings:
        steps.append(
            (
                "See which effects these recordings could show at which size; other motions show smaller ones.",
                f"equimus-ctrl check {RECORDINGS}{of_model}",
            )
        )
    free = diagnosis.base.fit.parameters.free
    held = [own.label for k, own in enumerate(free) if diagnosis.best.fit.at_bound[k]]
    if held:
        steps.append((f"See whether the bounds are right by which {listed(held)} {_are(held)} held.", ""))
    steps.append(
        (
            "See how often such an answer is right for this robot and these commands, on synthetic ground truths.",
            f"equimus-ctrl prove {RECORDINGS}{of_model}",
        )
    )
    return steps


def deciding(diagnosis: Diagnosis, command_line: str = "") -> tuple[str, str] | None:
    """What an experiment would decide, and the command that designs it; None where one explanation is left.

    Args:
        diagnosis: what was found.
        command_line: with which it was made, "" where there was none.
    """
    if diagnosis.verdict == "unfinished":
        return None
    what = [
        (bool(diagnosis.explanations), "explanations that these recordings do not distinguish"),
        (bool(diagnosis.nearest), "explanations that come near to what has no name"),
    ]
    does = [f"decides between {text}" for text in [listed([text for there, text in what if there])] if text]
    does += ["shows effects that are too small for these recordings"] if diagnosis.below else []
    if not does:
        return None
    given = shlex.split(command_line)
    again = command_line or f"equimus-ctrl diagnose {RECORDINGS}"
    report = _value(given, "--report")
    design = shlex.join(["equimus-ctrl", "experiment", "design", report or REPORT, *_of_model(given)])
    return (
        f"Design a trial that {listed(does)}.",
        design if report else f"{again} --report {REPORT} && {design}",
    )


def _of_model(given: list[str]) -> list[str]:
    """The options of a command line that say what the model is."""
    found = ["--motors"] if "--motors" in given else []
    for k, word in enumerate(given):
        name, equals, _ = word.partition("=")
        if name in OF_MODELS:
            found += [word] if equals else given[k : k + 2]
    return found


def _are(names: list[str]) -> str:
    return "is" if len(names) == 1 else "are"


def _value(given: list[str], option: str) -> str:
    """Of an option of a command line; "" where it is not there."""
    for k, word in enumerate(given):
        if word == option and k + 1 < len(given):
            return given[k + 1]
        if word.startswith(f"{option}="):
            return word.partition("=")[2]
    return ""
