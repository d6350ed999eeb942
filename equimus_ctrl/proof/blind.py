"""One case diagnosed by a process that knows its recordings and the nominal leg, and nothing else of it."""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from threadpoolctl import threadpool_limits

from equimus_ctrl.computer import keep_freed_memory
from equimus_ctrl.diagnosis.diagnose import DiagnosisSettings, diagnose
from equimus_ctrl.diagnosis.fitting import Data
from equimus_ctrl.diagnosis.holdout import Split, split
from equimus_ctrl.diagnosis.hypothesis import default_free_parameters
from equimus_ctrl.diagnosis.known import Known
from equimus_ctrl.diagnosis.results import Diagnosis
from equimus_ctrl.diagnosis.rivals import Rivals
from equimus_ctrl.errors import EquimusError
from equimus_ctrl.experiments.loop import Predicted, held_out, known_from, no_longer_left, realised, with_better
from equimus_ctrl.identification.parameters import FreeParameters
from equimus_ctrl.identification.simulators import reduced_simulator
from equimus_ctrl.models.model import Model
from equimus_ctrl.proof.baselines import baselines
from equimus_ctrl.proof.fingerprint import BASELINES, PARTS, fingerprint
from equimus_ctrl.types import Recording

SETTINGS = DiagnosisSettings(threads=1)


def report_fingerprint(further: bool = False) -> str:
    """Of a report.

    Args:
        further: whether designed trials may follow, see ``answer``.
    """
    return fingerprint(repr(SETTINGS), _parts(further))


def further_fingerprint() -> str:
    """Of a report with designed trials, which says what became of their predictions."""
    return fingerprint(repr(SETTINGS), (*PARTS, "experiments"))


def baselines_fingerprint(further: bool = False) -> str:
    """Of the baselines' answers.

    Args:
        further: the same.
    """
    return fingerprint(repr(SETTINGS), (*_parts(further), *BASELINES))


def _parts(further: bool) -> Sequence[str]:
    """With what says what is held out beside designed trials."""
    return (*PARTS, "experiments.loop") if further else PARTS


def answer(
    recordings: Sequence[Recording], model: Model, report: bool, others: bool, further: bool, label: str
) -> tuple[str | None, str | None]:
    """What is found in recordings, as two files hold it.

    Args:
        recordings: of one robot.
        model: what the robot is taken to be.
        report: whether the diagnosis is wanted.
        others: whether the baselines' answers are.
        further: whether designed trials may follow: then is held out what is beside these, see ``loop.held_out``.
        label: written into both.

    Returns:
        The diagnosis and the baselines' answers, None of what is not wanted.
    """
    begun = time.perf_counter()
    keep_freed_memory()
    free = default_free_parameters(model)
    heldout = held_out(recordings, 0) if further else None
    data = split(free.model, recordings, heldout=heldout)
    found: Diagnosis | None = None
    texts: list[str | None] = [None, None]
    if report:
        made = {"fingerprint": report_fingerprint(further), "seal": label}
        said, found = _diagnosed(free, data)
        texts[0] = as_text({**said, "proof": {**said["proof"], **made}})
    if others:
        made = {"fingerprint": baselines_fingerprint(further), "seal": label}
        with threadpool_limits(limits=1, user_api="blas"):
            simulator = reduced_simulator(threads=1)
            own = Data(free, data.train, simulator)
            same = found is not None and found.train == data.train
            answers = baselines(own, data.validation, found.base if found is not None and same else None)
        texts[1] = as_text({"answers": answers, **made, "seconds": time.perf_counter() - begun})
    return texts[0], texts[1]


def answer_with(
    recordings: Sequence[Recording],
    model: Model,
    first: int,
    before: Mapping[str, Any],
    predicted: Sequence[Mapping[str, Any]],
    made: Mapping[str, Any],
) -> str:
    """What is found with a designed trial more, and what became of its predictions, as a file holds it.

    Args:
        recordings: of one robot, the designed trials last.
        model: what the robot is taken to be.
        first: how many nobody designed, see ``loop.held_out``.
        before: the rivals for which the last trial was designed, see ``Rivals.to_dict``.
        predicted: of it, see ``experiments.loop.Predicted``.
        made: written down too: what the answer is of.
    """
    keep_freed_memory()
    free = default_free_parameters(model)
    heldout = held_out(recordings[:first], len(recordings) - first)
    was = Rivals.from_dict(before, model)
    known = known_from(was)
    said, found = _diagnosed(free, split(free.model, recordings, heldout=heldout, known=known[0].model), known)
    became: list[Any] = []
    if found is not None:
        with threadpool_limits(limits=1, user_api="blas"):
            now, gone = with_better(found.rivals, no_longer_left(was, found, found.rivals))
        said["rivals"] = now.to_dict()
        became = [own.to_dict() for own in realised(was, [Predicted.from_dict(own) for own in predicted], now, gone)]
    proof = {**said["proof"], **made, "fingerprint": further_fingerprint()}
    return as_text({**said, "realised": became, "proof": proof})


def _diagnosed(
    free: FreeParameters, data: Split, known: Sequence[Known] = ()
) -> tuple[dict[str, Any], Diagnosis | None]:
    """The report, with what it took; one of a diagnosis that failed says so."""
    clock, processor = time.perf_counter(), time.process_time()
    said: dict[str, Any] = {}
    found, failed = None, ""
    try:
        found = diagnose(free, data, settings=replace(SETTINGS, known=tuple(known)))
        said = found.to_dict()
    except Exception as error:  # a proof counts failures; it does not end with one
        failed = str(error) if isinstance(error, EquimusError) else f"{type(error).__name__}: {error}"
    spent = {
        "failed": failed,
        "seconds": time.perf_counter() - clock,
        "cpu_seconds": time.process_time() - processor,
        "peak_memory_byte": peak_memory(),
    }
    return {**said, "proof": spent}, found


def peak_memory() -> int | None:
    """The most that this process held so far [byte]; None where the system does not say."""
    try:
        import resource
    except ImportError:
        return None
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return int(most if sys.platform == "darwin" else most * 1024)


def as_text(value: Mapping[str, Any]) -> str:
    """As a file holds it; what is not finite is null."""
    return json.dumps(_plain(value), indent=1, allow_nan=False) + "\n"


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
