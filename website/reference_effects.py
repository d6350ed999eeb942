"""The page of effects, from their registry: place, law, figure, sentence, parameters, what each was confused with."""

from __future__ import annotations

import json
import re
from collections import Counter, defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import effect_figures
import effect_laws

from equimus_ctrl.effects import REGISTRY, Effect
from equimus_ctrl.report.diagnosis_words import quantity

FORMULAS = (
    (r"(?<![\w'])([A-Za-z](?:_[a-z])?)'(?=\s)", r"\1′"),
    (r"(?<!\w)([A-Za-zΑ-ω])_([a-z0-9])(?!\w)", r"\1<sub>\2</sub>"),
    (r"\^(\w+)", r"<sup>\1</sup>"),
)
"""What stands for a prime, an index and a power in a docstring, and what does on a page."""

SIDES = {
    "command": "Commands and valves",
    "force": "Forces at joints, actuators and bodies",
    "measurement": "Sensors",
}


def page(proofs: Path) -> str:
    """One entry an effect, grouped by side.

    Args:
        proofs: folder with scores of proofs.
    """
    confused, sets = answers(proofs)
    parts = [
        "# Effects",
        "The laws that `diagnose` looks for and `--effect` attaches, made from the classes when this site was built. "
        "The sentence is what a report says, with parameters in the place of their estimates; what it computes "
        "from them is computed from those that the figure is drawn with. "
        "`x` is the joint's position or the actuator's length, `rate` its derivative. The physics behind "
        "them: [the two models](../physics.md#effects), [MJCF robots](../machines_effects.md). Your own: "
        "[adding an effect](../project/CONTRIBUTING.md#an-effect).",
        "Each figure is computed from the effect's class, with parameters from which a search for it may begin: a law "
        "without memory over its argument, one with a memory over time or along a motion. Forces count positive where "
        "they would increase the coordinate.",
        "*Taken for* adds up what diagnoses answered where this effect was all that was missing and had an excess "
        f"residual variance of 0.3 or more, in {sets} sets of [blinded robots](../proof.md). "
        "A fraction is an effect named beside others. No line means that none of these sets had it so.",
    ]
    for side, title in SIDES.items():
        classes = [cls for _, cls in sorted(REGISTRY.items()) if cls.side == side]
        parts += [f"## {title}", _overview(classes)]
        for cls in classes:
            parts += _entry(cls, confused.get(cls.name, Counter()))
    return "\n\n".join(parts) + "\n"


def answers(proofs: Path) -> tuple[Mapping[str, Counter[str]], int]:
    """What was missing → how often each answer was given, over all scored sets below a folder; and how many sets."""
    added: dict[str, Counter[str]] = defaultdict(Counter)
    seals = set()
    for path in sorted(proofs.rglob("score.json")):
        score = json.loads(path.read_text(encoding="utf-8"))
        if not score.get("confusion") or score["seal"] in seals:
            continue
        seals.add(score["seal"])
        for truth, row in score["confusion"].items():
            added[truth].update(row)
    return added, len(seals)


def _overview(classes: list[type[Effect]]) -> str:
    rows = [
        f"| [`{cls.name}`](#{cls.name}) | {cls.summary} | {', '.join(cls.sits_at)} | {_robots(cls)} |"
        for cls in classes
    ]
    return "\n".join(["| effect | what it is | at | robots |", "| --- | --- | --- | --- |", *rows])


def _robots(cls: type[Effect]) -> str:
    kinds = {"elastic": "elastic actuators", "mjcf": "MJCF"}
    return ", ".join(kinds[kind] for kind in cls.robots)


def _entry(cls: type[Effect], answered: Counter[str]) -> list[str]:
    law = " ".join((cls.__doc__ or "").partition("\n\n")[0].split()).replace("``", "`")
    parts = [f"### {cls.name}", f"{cls.summary[:1].upper()}{cls.summary[1:]}.", f"**Law**: {_plain(law)}"]
    parts.append(effect_figures.markdown(cls.name))
    parts.append(f"**A report says**: {_plain(_sentence(cls))}")
    rows = [
        f"| `{key}` | {_plain(info['doc'])} | {_unit(info['unit'])} | {_bounds(info['low'], info['high'])} |"
        for key, info in cls.parameter_info().items()
    ]
    parts.append("\n".join(["| parameter | meaning | unit | bounds |", "| --- | --- | --- | --- |", *rows]))
    native = f"as {cls.mjcf_form}" if cls.mjcf_form else f"refused: {cls.mjcf_lacks}"
    parts.append(f"**In plain MuJoCo** ([export](../export.md)): {native}.")
    if answered:
        total = sum(answered.values())
        others = [f"`{name}` {_half(n)}" for name, n in answered.most_common() if name != cls.name]
        right = f"named in {_half(answered.get(cls.name, 0))} of {_half(total)}"
        parts.append(f"**Taken for**: {'; '.join([right, *others])}.")
    return parts


def _half(count: float) -> str:
    whole, rest = divmod(count, 1)
    return f"{whole:g}" if not rest else f"{count:.3g}"


def _unit(unit: str) -> str:
    return "–" if unit == "1" else unit.replace("|", "or")


def _bounds(low: float, high: float) -> str:
    return f"{_number(low)} to {_number(high)}"


def _number(value: float) -> str:
    """A bound; a large or small one as a power of ten."""
    digits, _, power = f"{value:g}".partition("e")
    if power:
        digits = {"1": "", "-1": "-"}.get(digits, f"{digits}·") + f"10<sup>{int(power)}</sup>"
    return digits.replace("-", "−")


def _plain(text: str) -> str:
    """A docstring's text where ``*`` and ``_`` mean themselves, with indices and powers as such."""
    parts = re.split(r"(`[^`]*`)", text)
    parts[::2] = [_formula(part) for part in parts[::2]]
    return "".join(parts)


def _formula(text: str) -> str:
    for pattern, instead in FORMULAS:
        text = re.sub(pattern, instead, text)
    return text.replace("*", "\\*").replace("_", "\\_").replace("‹", "*").replace("›", "*")


def _sentence(cls: type[Effect]) -> str:
    drawn = effect_figures.laws()[cls.name].effect
    return cls.sentence(_Template(cls, effect_laws.robot_of(cls), effect_laws.place_of(cls), drawn.parameters()))


@dataclass(frozen=True)
class _Template:
    """A description whose estimates are the parameters' names, see ``effects.description.Description``."""

    cls: type[Effect]
    robot: Any
    place: str
    drawn: Mapping[str, float]

    @property
    def places(self) -> tuple[str, ...]:
        return (self.place,)

    @property
    def at(self) -> str:
        return self.place

    @property
    def the(self) -> str:
        return f"the {self.place}"

    @property
    def noun(self) -> str:
        return "angle"

    @property
    def actuation(self) -> str:
        return f"The {'pressure' if self.robot.traits.commands_are_pressures else 'force'} of {self.at}"

    @property
    def numbers(self) -> str:
        return ", ".join(f"{key} ({info['doc']}) {self[key]}" for key, info in self.cls.parameter_info().items())

    def one_or(self, one: str, several: str) -> str:
        return one

    def __getitem__(self, key: str) -> str:
        return f"‹{key.replace('_', ' ')}›"

    def scaled(self, key: str, unit: str, factor: float, away: float = 0.0) -> str:
        return self[key]

    def unit(self, key: str) -> str:
        return effect_figures.unit_there(str(self.cls.parameter_info()[key]["unit"]))

    def value(self, key: str) -> float:
        """As it is drawn, for sentences that say which side, and for what follows from several."""
        return self.drawn[key]

    def quantity(self, value: float, unit: str) -> str:
        return quantity(value, unit)
