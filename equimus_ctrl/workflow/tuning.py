"""Tuning of controllers by name: a study, a robot and a controller in; settings, a record and a journal out."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from equimus_ctrl import outputs, presets
from equimus_ctrl.controllers.registry import CONTROLLERS, tunable
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.models.model import Model, nominal_model
from equimus_ctrl.options import AutotuneOptions, with_changes
from equimus_ctrl.recordings import locate
from equimus_ctrl.workflow.plugins import load_plugins, loaded
from equimus_ctrl.workflow.runs import load_scenario, own_settings
from equimus_ctrl.workflow.where import where_of

FOR_ALL = ("leg.toml", "any.toml")
"""Studies of controllers that have none of their own: of a robot by its joints, and of any other."""

JOURNAL = "journal.jsonl"


@dataclass(frozen=True, eq=False)
class Tuned:
    """A finished tuning and where its results are.

    Attributes:
        controller: what was tuned.
        result: what was found.
        settings: the settings file; where ``left`` is one, it is in ``folder``.
        record: the JSON record.
        folder: of the record, the journal and the figures.
        reused: how many evaluations an earlier, interrupted run had already made.
        left: the settings file that was there already and stays as it is; None where the tuned ones took its place.
    """

    controller: str
    result: Any
    settings: Path
    record: Path
    folder: Path
    reused: int
    left: Path | None = None


def autotune(
    controller: str,
    study: Path | None = None,
    model: Model | None = None,
    options: AutotuneOptions | None = None,
    *,
    begin: Callable[[int], None] = lambda total: None,
    notify: Callable[[Any], None] = lambda trial: None,
    **changes: Any,
) -> Tuned:
    """Tune a controller by a study and write its settings and record; started again, it goes on where it was stopped.

    Args:
        controller: by name, of those that declare what is searched (``controllers.search_space``).
        study: a study file; by default the controller's own in ``tuning/``, else ``leg.toml`` or ``any.toml`` there.
        model: the centre of the ensemble; the nominal leg by default.
        options: see ``AutotuneOptions``.
        begin: called with the number of candidates before the first.
        notify: called after each candidate.
        **changes: of the options, one by one.

    Raises:
        EquimusError: where an input is wrong, or nothing within the limits was found; nothing is written then.
    """
    from equimus_ctrl.tuning import journal
    from equimus_ctrl.tuning.study import Objective, PlantStudy, study_from_dict

    options, model = with_changes(AutotuneOptions, options, changes), model or nominal_model()
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
    make, key_of, tune = _ways(controller, path, isinstance(settings, PlantStudy))
    root, file = presets.workspace(), entry.settings or f"{controller}.toml"
    # A study that names joints is for one robot, whose settings need no name of its own.
    on_plant = isinstance(settings, PlantStudy)
    for_any = table.get("joints") is None and on_plant
    target = options.output or root / "controllers" / (own_settings(file, model.robot) if for_any else file)
    stem = path.stem if path.stem.startswith(controller) or not on_plant else f"{controller}_{path.stem}"
    stem = f"{stem}_{presets.plain_name(model.name)}" if for_any else stem
    results = options.folder or root / "tuning" / "results" / stem
    presets.check_toml(target)
    presets.check_folder(results)
    problem = make(settings, model, built)
    header = {"format": "equimus-ctrl/journal/1", "key": key_of(settings, problem)}
    results = _folder(options, results, header)
    record, copy = results / "record.json", results / file
    if options.output is not None and not _is_own(target, record):
        outputs.check_new(target, options.force)
    where = where_of(options.workers, options.scheduler, options.slurm)
    store = presets.JsonLines(results / JOURNAL, header, options.fresh)
    reused = len(store.rows)
    begin(settings.candidates)
    try:
        result = tune(settings, problem, journal.RowJournal(store), notify, where, options.budget)
    finally:
        store.close()
    text = presets.toml_text(result.settings.to_dict(), _comment(controller, result, path))
    # Looked at now: while it was searched somebody may have written there, or edited what an earlier run had.
    kept = not options.force and not _is_own(target, record)
    if not options.force and not _is_own(copy, record):
        copy = outputs.free_name(copy)
    written = list(dict.fromkeys([copy] if kept else [target, copy]))
    _write_all({**dict.fromkeys(written, text), record: presets.json_text(result.record())})
    return Tuned(controller, result, written[0], record, results, reused, target if kept else None)


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


def tune_pid(
    study: Path | None = None,
    model: Model | None = None,
    options: AutotuneOptions | None = None,
    **more: Any,
) -> Tuned:
    """``autotune`` of the PID."""
    return autotune("pid", study, model, options, **more)


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
    from equimus_ctrl.tuning.study import FORMAT, ON_PLANT

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
    from equimus_ctrl.tuning.study import suits

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
