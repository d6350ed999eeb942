"""Parts of a proof that are done apart, on other machines, and become one again.

Of each case there are files of its own, so shards that share a folder need nothing: once all are done, the same command
without a shard finds every case there. Shards with folders of their own are copied into one first.

    <root>/shards/2_of_5.json     that this shard is done, of how many cases, and by what
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from equimus_ctrl import presets
from equimus_ctrl.errors import ConfigError
from equimus_ctrl.executors.versions import mismatch, processor, versions, warn_of_mix
from equimus_ctrl.options import ProveOptions, Shard
from equimus_ctrl.proof import blind
from equimus_ctrl.proof.further import trial_name
from equimus_ctrl.proof.store import Request
from equimus_ctrl.recordings.folders import copy, copy_folder, holds, read_text, texts

SCHEMA = "equimus-ctrl/proof-shard/1"
SAID = 5
"""Cases that a message names."""


def shard_name(name: str, shard: Shard | None) -> str:
    """The name of what a shard makes beside its cases, for several may share a folder."""
    return name if shard is None else f"{name}_{shard.index}_of_{shard.of}"


def note_shard(request: Request, options: ProveOptions, baselines: bool, seal: str) -> None:
    """Write that a shard is done."""
    shard = options.shard
    assert shard is not None
    record = {
        "schema": SCHEMA,
        "shard": shard.index,
        "of": shard.of,
        "cases": options.cases,
        "baselines": baselines,
        "experiments": options.experiments,
        "seal": seal,
        "fingerprint": blind.report_fingerprint(options.experiments > 0),
        "versions": versions(),
        "processor": processor(),
    }
    presets.write_text(request.root / "shards" / f"{shard.index}_of_{shard.of}.json", presets.json_text(record))


def merge_shards(request: Request, options: ProveOptions, baselines: bool) -> None:
    """Copy the cases of shards that are done into one folder.

    Args:
        request: of the whole; ``request.root`` is where the cases are copied to.
        options: with the folders and the number of cases.
        baselines: whether their answers are wanted.

    Raises:
        ConfigError: where a shard is missing, is of another number of cases, or was made by another version.
    """
    owner: dict[int, Path] = {}
    made_by: tuple[Path, Mapping[str, str]] | None = None
    processor_of_first: Mapping[str, str] = {}
    for folder in options.merge:
        for record in _done(folder):
            shard = Shard(record["shard"], record["of"])
            if record["cases"] != options.cases:
                raise ConfigError(
                    f"{folder}: holds shard {shard} of {record['cases']} cases, not of {options.cases}; expected "
                    f"--cases {record['cases']}"
                )
            if baselines and not record["baselines"]:
                raise ConfigError(f"{folder}: shard {shard} has no answers of the baselines; expected --no-baselines")
            if (made := record.get("experiments", 0)) < options.experiments:
                raise ConfigError(
                    f"{folder}: shard {shard} has {made} designed trials of each case; expected --experiments {made}"
                )
            if record["fingerprint"] != blind.report_fingerprint(made > 0):
                raise ConfigError(
                    f"{folder}: shard {shard} was diagnosed by another version of the program; expected shards of the "
                    "version that merges them"
                )
            if made_by is not None and (other := mismatch(record["versions"], made_by[1])) is not None:
                raise ConfigError(f"{folder}: shard {shard} was made with {other} as the shards in {made_by[0]}")
            if made_by is not None:
                warn_of_mix({f"{folder}: shard {shard}": record["processor"]}, processor_of_first)
            else:
                made_by, processor_of_first = (folder, record["versions"]), record["processor"]
            owner.update(dict.fromkeys(shard.cases(options.cases), folder))
    missing = [case for case in range(options.cases) if case not in owner]
    if missing:
        more = f" and {len(missing) - SAID} more" if len(missing) > SAID else ""
        raise ConfigError(
            f"no shard that is done has case{'s' * (len(missing) > 1)} {_listed(missing[:SAID])}{more} of "
            f"{options.cases}; expected all shards"
        )
    for case, folder in sorted(owner.items()):
        if folder.resolve() != request.root.resolve():
            _copy_case(Request(folder, request.seed), request, case, baselines, options.experiments)


def _copy_case(source: Request, target: Request, case: int, baselines: bool, experiments: int) -> None:
    copy_folder(source.recordings(case), target.recordings(case))
    copy(source.truth(case), target.truth(case))
    copy(source.report(case), target.report(case))
    if baselines:
        copy(source.baselines(case), target.baselines(case))
    for number in range(1, experiments + 1):  # what ended sooner has fewer
        if holds(source.made(case, number), [trial_name(number)]):
            copy_folder(source.made(case, number), target.made(case, number))
        own = (source.design(case, number), source.driven(case, number), source.report(case, number))
        theirs = (target.design(case, number), target.driven(case, number), target.report(case, number))
        for path, copied in zip(own, theirs, strict=True):
            if read_text(path) is not None:
                copy(path, copied)
    copy(source.seal(case), target.seal(case))  # last: with it the case is complete


def _listed(numbers: Sequence[int]) -> str:
    return ", ".join(map(str, numbers))


def _done(folder: Path) -> list[dict[str, Any]]:
    """Records of the shards in a folder that are done.

    Raises:
        ConfigError: where there is none, or one cannot be read.
    """
    found = []
    for path, text in texts(folder / "shards", "*_of_*.json").items():
        try:
            record = json.loads(text)
            if record["schema"] != SCHEMA:
                raise ValueError
            Shard(record["shard"], record["of"])
            mismatch(record["versions"])
            mismatch(record["processor"])
            _ = record["cases"], record["baselines"], record["fingerprint"]
        except (ValueError, KeyError, TypeError, AttributeError):
            raise ConfigError(f"{path}: is no record of a shard ({SCHEMA})") from None
        found.append(record)
    if not found:
        raise ConfigError(f"{folder}: holds no shard that is done; run prove --shard with it as --output to its end")
    return found
