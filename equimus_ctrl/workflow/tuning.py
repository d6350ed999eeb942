"""Tuning of controllers by name: a study, a robot and a controller in; settings, a record and a journal out."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from equimus_ctrl import outputs, presets
from equimus_ctrl.controllers.registry import CONTROLLERS, make_controller, tunable
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.frames import dataframe
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.options import AutotuneOptions, with_changes
from equimus_ctrl.recordings import locate
from equimus_ctrl.shown import Short
from equimus_ctrl.tuning import journal
from equimus_ctrl.tuning.result import TuningResult
from equimus_ctrl.tuning.search import Trial
from equimus_ctrl.tuning.study import FORMAT, ON_PLANT, AnyStudy, Objective, PlantStudy, study_from_dict, suits
from equimus_ctrl.types import Controller
from equimus_ctrl.workflow.plugins import load_plugins, loaded
from equimus_ctrl.workflow.runs import load_scenario, own_settings
from equimus_ctrl.workflow.where import where_of

if TYPE_CHECKING:
    from pandas import DataFrame

FOR_ALL = ("leg.toml", "any.toml")
"""Studies of controllers that have none of their own: of a robot by its joints, and of any other."""

JOURNAL = "journal.jsonl"


@dataclass(frozen=True, eq=False, repr=False)
class Tuned(Short):
    """A finished tuning.

    Attributes:
        controller: what was tuned.
        result: what was found.
        reused: how many evaluations an earlier, interrupted run had already made.
    """

    controller: str
    result: TuningResult
    reused: int

    def told(self) -> str:
        """What it cost before and after."""
        result = self.result
        how = " (stopped)" if result.interrupted or result.timed_out else ""
        return (
            f" {self.controller} for {result.problem.model.name}: cost {result.start_evaluation.told} → "
            f"{result.best.evaluation.told} over {len(result.history)} {result.noun}{how}"
        )

    def made(self) -> Controller:
        """The controller with the settings found.

        Raises:
            ControllerError: where it plays commands of a scenario.
        """
        table = self.result.settings.to_dict()
        return make_controller(self.controller, table, None, self.controller, self.result.problem.model.robot, True)

    def save(self, path: Path | str, *, force: bool = False) -> Path:
        """Write the settings, for ``run_scenario(settings=…)`` and ``run --settings``.

        Args:
            path: of the file, ``.toml``.
            force: whether a file that is there is replaced.

        Raises:
            ConfigError: where the file is there already, or cannot be written.
        """
        path = Path(path)
        presets.check_toml(path)
        outputs.check_new(path, force)
        presets.write_text(path, presets.toml_text(self.result.settings.to_dict(), self.result.heading))
        return path

    def to_dict(self) -> dict[str, Any]:
        """What ``autotune --json`` prints, and every evaluation."""
        return {**self.result.record(), "reused": self.reused}

    def to_dataframe(self) -> DataFrame:
        """A row for each candidate, in the order they were tried: its stage, numbers and cost.

        Raises:
            NotAvailable: where pandas is not installed.
        """
        rows = [
            {"index": t.index, "stage": t.stage, "cost": t.evaluation.cost, "feasible": t.evaluation.feasible,
             **{f"value_{k}": value for k, value in enumerate(t.values)}}
            for t in self.result.history
        ]  # fmt: skip
        return dataframe(rows, "index")


@dataclass(frozen=True, eq=False, repr=False)
class TunedFiles(Tuned):
    """A finished tuning and where its results are.

    Attributes:
        settings: the settings file; where ``left`` is one, it is in ``folder``.
        record: the JSON record.
        folder: of the record, the journal and the figures.
        left: the settings file that was there already and stays as it is; None where the tuned ones took its place.
    """

    settings: Path
    record: Path
    folder: Path
    left: Path | None = None


@dataclass(frozen=True, eq=False)
class _Posed:
    """A study, made a problem of a controller and a robot.

    Attributes:
        path: of the study.
        study: what to look for.
        problem: what candidates are judged by.
        key: a fingerprint of what an evaluation depends on.
        search: looks for the best, given a journal, what is told of each candidate, where it is tried, and a budget.
        file: what settings of the controller are called.
        own: the same for one robot alone, where the study is for any.
    """

    path: Path
    study: AnyStudy
    problem: Any
    key: str
    search: Callable[..., TuningResult]
    file: str
    own: str | None


def tune(
    controller: str,
    study: Path | str | None = None,
    model: Model | None = None,
    options: AutotuneOptions | None = None,
    *,
    begin: Callable[[int], None] = lambda total: None,
    notify: Callable[[Trial], None] = lambda trial: None,
    stage: Callable[[str], None] = lambda name: None,
    **changes: Any,
) -> Tuned:
    """Settings of a controller that work on a whole ensemble of robots.

    Nothing is written unless a place is named: with ``folder`` it holds settings, record and journal, and the same call
    goes on where it was stopped; ``output`` alone is the settings file.

    Args:
        controller: by name, of those that declare what is searched (``controllers.search_space``).
        study: a study file; by default the controller's own in ``tuning/``, else ``leg.toml`` or ``any.toml`` there.
        model: the centre of the ensemble; the nominal leg by default.
        options: see ``AutotuneOptions``.
        begin: called with the number of candidates before the first.
        notify: called after each candidate.
        stage: told what is done after the last candidate.
        **changes: of the options, one by one.

    Raises:
        EquimusError: where an input is wrong, or nothing within the limits was found; nothing is written then.
    """
    options, model = with_changes(AutotuneOptions, options, changes), model or nominal_model()
    path = None if study is None else Path(study)
    if options.folder is not None:
        file = tunable(controller)[0].settings or f"{controller}.toml"
        within = replace(options, output=options.output or options.folder / file)
        return tune_into(controller, path, model, within, begin=begin, notify=notify, stage=stage)
    if options.output is not None:
        presets.check_toml(options.output)
        outputs.check_new(options.output, options.force)
    posed = _posed(controller, path, model, options)
    begin(posed.study.candidates)
    where = where_of(options.workers, options.scheduler, options.slurm)
    memory = journal.RowJournal(journal.Memory())
    result = posed.search(posed.study, posed.problem, memory, notify, where, options.budget, stage=stage)
    found = Tuned(controller, result, 0)
    if options.output is not None:
        found.save(options.output, force=options.force)
    return found


def tune_into(
    controller: str,
    study: Path | None = None,
    model: Model | None = None,
    options: AutotuneOptions | None = None,
    *,
    begin: Callable[[int], None] = lambda total: None,
    notify: Callable[[Trial], None] = lambda trial: None,
    stage: Callable[[str], None] = lambda name: None,
    **changes: Any,
) -> TunedFiles:
    """``tune``, with its results written: settings in ``controllers/``, record and journal in ``tuning/results``.

    Args:
        controller: see ``tune``.
        study: see ``tune``.
        model: see ``tune``.
        options: see ``AutotuneOptions``.
        begin: called with the number of candidates before the first.
        notify: called after each candidate.
        stage: see ``tune``.
        **changes: of the options, one by one.

    Raises:
        EquimusError: where an input is wrong, or nothing within the limits was found; nothing is written then.
    """
    options, model = with_changes(AutotuneOptions, options, changes), model or nominal_model()
    posed = _posed(controller, study, model, options)
    root, path = presets.workspace(), posed.path
    target = options.output or root / "controllers" / (posed.own or posed.file)
    on_plant = isinstance(posed.study, PlantStudy)
    stem = path.stem if path.stem.startswith(controller) or not on_plant else f"{controller}_{path.stem}"
    stem = f"{stem}_{presets.plain_name(model.name)}" if posed.own else stem
    results = options.folder or root / "tuning" / "results" / stem
    presets.check_toml(target)
    presets.check_folder(results)
    header = {"format": "equimus-ctrl/journal/1", "key": posed.key}
    results = _folder(options, results, header)
    record, copy = results / "record.json", results / posed.file
    if options.output is not None and not _is_own(target, record):
        outputs.check_new(target, options.force)
    where = where_of(options.workers, options.scheduler, options.slurm)
    store = presets.JsonLines(results / JOURNAL, header, options.fresh)
    reused = len(store.rows)
    begin(posed.study.candidates)
    try:
        rows = journal.RowJournal(store)
        result = posed.search(posed.study, posed.problem, rows, notify, where, options.budget, stage=stage)
    finally:
        store.close()
    text = presets.toml_text(result.settings.to_dict(), _comment(controller, result, path))
    # Looked at now: while it was searched somebody may have written there, or edited what an earlier run had.
    kept = not options.force and not _is_own(target, record)
    if not options.force and not _is_own(copy, record):
        copy = outputs.free_name(copy)
    written = list(dict.fromkeys([copy] if kept else [target, copy]))
    _write_all({**dict.fromkeys(written, text), record: presets.json_text(result.record())})
    return TunedFiles(controller, result, reused, written[0], record, results, target if kept else None)


def _posed(controller: str, study: Path | None, model: Model, options: AutotuneOptions) -> _Posed:
    """The problem of a controller's study and a robot.

    Raises:
        EquimusError: where an input is wrong.
    """
    entry, _ = tunable(controller)
    path = study or study_for(controller, model)
    table = presets.read_toml(path)
    settings = study_from_dict(table, presets.shown(path))
    own: dict[str, Any] = {"candidates": options.candidates, "seed": options.seed}
    if options.scenarios:
        own["objectives"] = tuple(Objective(name) for name in options.scenarios)
    settings = replace(settings, **{key: value for key, value in own.items() if value is not None})
    recordings = options.recordings
    if recordings is not None:
        locate.find_recordings(recordings)
    search = recordings is not None
    built = [
        load_scenario(o.scenario, model.robot, phase=model.phase, recordings=recordings, search=search)
        for o in settings.objectives
    ]
    # A study that names joints is for one robot, whose settings need no name of its own.
    on_plant = isinstance(settings, PlantStudy)
    make, key_of, look = _ways(controller, path, on_plant)
    problem, file = make(settings, model, built), entry.settings or f"{controller}.toml"
    for_any = table.get("joints") is None and on_plant
    own_file = own_settings(file, model.robot) if for_any else None
    return _Posed(path, settings, problem, key_of(settings, problem), look, file, own_file)


def _folder(options: AutotuneOptions, default: Path, header: Mapping[str, Any]) -> Path:
    """The folder of a tuning: of the one that is taken up again, or that nobody has.

    Raises:
        ConfigError: where another tuning has the one that is given, and it is not to be replaced.
    """
    for folder in outputs.numbered(options.folder or default):
        presets.check_folder(folder)
        held = presets.JsonLines.header_of(folder / JOURNAL)
        if (held is None and not (folder / "record.json").exists()) or held == header or options.force:
            return folder
        if options.folder is not None:
            raise ConfigError(
                f"{folder}: holds another tuning, of other settings or another model ({JOURNAL}); expected another "
                "folder, or --force to replace its results"
            )
    raise AssertionError


def _is_own(settings: Path, record: Path) -> bool:
    """Whether a tuning may write its settings there: there are none, or those that its record says it found before."""
    if not os.path.lexists(settings):
        return True
    try:
        return bool(presets.read_toml(settings) == json.loads(presets.read_bytes(record)).get("settings"))
    except (ConfigError, ValueError, AttributeError):
        return False


def _write_all(texts: Mapping[Path, str]) -> None:
    """Write files; where one cannot be, the others are.

    Raises:
        ConfigError: that one, and where the first is.
    """
    failed, written = list[ConfigError](), list[Path]()
    for path, text in texts.items():
        try:
            presets.write_text(path, text)
            written.append(path)
        except ConfigError as error:
            failed.append(error)
    if failed:
        kept = f"; the settings are in {written[0]}" if written and written[0].suffix == ".toml" else ""
        raise ConfigError(f"{failed[0]}{kept}") from None


def _ways(controller: str, path: Path, on_plant: bool) -> tuple[Callable[..., Any], ...]:
    """What makes the problem of a study, what its journal is known by, and what tunes.

    Raises:
        ConfigError: for a controller that the compiled loop does not hold.
    """
    prepare = partial(load_plugins, loaded()) if loaded() else None
    if on_plant:
        from equimus_ctrl.tuning import plant_tuning

        return (
            partial(plant_tuning.make_plant_problem, controller=controller, where=presets.shown(path)),
            plant_tuning.study_key,
            partial(plant_tuning.tune_on_plant, prepare=prepare),
        )
    from equimus_ctrl.tuning import autotune as compiled

    if not CONTROLLERS.entry(controller).compiled:
        able = ", ".join(name for name, entry in CONTROLLERS.items() if entry.compiled)
        raise ConfigError(
            f"{presets.shown(path)}: format is {FORMAT!r}, which is of {able} alone; expected {ON_PLANT!r}"
        )
    return compiled.make_problem, compiled.study_key, partial(compiled.autotune, prepare=prepare)


def study_for(controller: str, model: Model) -> Path:
    """The study of a controller and a robot: the first that suits it.

    Raises:
        ConfigError: where there is none.
    """
    names = (f"{controller}.toml", f"{controller}_any.toml", *FOR_ALL)
    found = [path for name in names if (path := presets.find("tuning", name)) is not None]
    for path in found:
        if suits(presets.read_toml(path), model.robot.joint_names, presets.shown(path)):
            return path
    raise ConfigError(f"there is no tuning/{FOR_ALL[-1]}; name a study with --study")


def _comment(controller: str, result: Any, study: Path) -> str:
    best = result.best.evaluation
    return (
        f"{result.heading}; written by `equimus-ctrl autotune {controller}`, free to edit.\n"
        f"Study {study.name}, seed {result.study.seed}, {len(result.history)} {result.noun} tried, "
        f"cost {best.told} (before: {result.start_evaluation.told})."
    )
