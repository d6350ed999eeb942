"""Layouts for Foxglove and PlotJuggler: a tab a trial; in it a plot for each joint, its residuals, and the commands."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree

from equimus_ctrl.recordings.exported import Exported

COLOURS = ("#1f77b4", "#d62728", "#2ca02c", "#ff7f0e", "#9467bd", "#17becf", "#bcbd22", "#e377c2")
PLAIN = re.compile(r"[A-Za-z0-9_]+")


@dataclass(frozen=True)
class Plot:
    """A plot of some fields of topics.

    Attributes:
        title: over it.
        curves: (topic, field, what the legend says) of each.
    """

    title: str
    curves: tuple[tuple[str, str, str], ...]


def plots(trial: Exported) -> list[Plot]:
    """The plots of a trial: each joint as measured and predicted, its residuals, what is prescribed, and commands."""
    series = {topic.removeprefix(f"{trial.folder}/"): (topic, columns) for topic, columns, _ in trial.series()}
    found: list[Plot] = []
    for what, title in (("position", "{}"), ("residual", "{}: measured − predicted")):
        shown = [(group, *own) for group, own in series.items() if group.rpartition("/")[2] == what]
        for joint in trial.recording.joints:
            curves = tuple((topic, joint, group.partition("/")[0]) for group, topic, own in shown if joint in own)
            if curves:
                found.append(Plot(title.format(joint), curves))
    topic, columns = series["measured/position"]
    if given := [name for name in columns if name not in trial.recording.joints]:
        found.append(Plot("prescribed", tuple((topic, name, name) for name in given)))
    for group, title in (("command", "commands"), ("measured/actuator", "measured at actuators")):
        if group in series:
            topic, columns = series[group]
            found.append(Plot(title, tuple((topic, name, name) for name in columns)))
    return found


def foxglove(trials: Sequence[Exported]) -> dict[str, Any]:
    """A layout as Foxglove imports it (JSON)."""
    panels: dict[str, Any] = {}
    tabs = []
    numbers = itertools.count(1)
    for trial in trials:
        names = []
        for plot in plots(trial):
            names.append(f"Plot!{next(numbers)}")
            panels[names[-1]] = {
                "title": plot.title,
                "paths": [
                    {"value": _path(topic, field), "label": label, "enabled": True, "timestampMethod": "receiveTime"}
                    for topic, field, label in plot.curves
                ],
                "showLegend": True,
                "legendDisplay": "floating",
                "showXAxisLabels": True,
                "showYAxisLabels": True,
                "isSynced": True,
                "xAxisVal": "timestamp",
            }
        tabs.append({"title": trial.recording.name, "layout": _stacked(names)})
    panels["Tab!0"] = {"activeTabIdx": 0, "tabs": tabs}
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": "Tab!0",
    }


def _stacked(names: Sequence[str]) -> Any:
    """Panels under one another, equally high."""
    if len(names) == 1:
        return names[0]
    return {
        "direction": "column",
        "first": names[0],
        "second": _stacked(names[1:]),
        "splitPercentage": 100 / len(names),
    }


def _path(topic: str, field: str) -> str:
    """Foxglove's path to a field of messages; in quotes where it is no plain word."""
    where = topic if all(PLAIN.fullmatch(part) for part in topic.split("/")[1:]) else f'"{topic}"'
    return f"{where}.{field}" if PLAIN.fullmatch(field) else f'{where}."{field}"'


def plotjuggler(trials: Sequence[Exported]) -> str:
    """A layout as PlotJuggler loads it (XML), once the file is loaded."""
    root = ElementTree.Element("root")
    window = ElementTree.SubElement(root, "tabbed_widget", {"parent": "main_window", "name": "Main Window"})
    for trial in trials:
        shown = plots(trial)
        tab = ElementTree.SubElement(window, "Tab", containers="1", tab_name=trial.recording.name)
        sizes = ";".join([f"{1 / len(shown):.6f}"] * len(shown))
        splitter = ElementTree.SubElement(
            ElementTree.SubElement(tab, "Container"), "DockSplitter",
            orientation="-", count=str(len(shown)), sizes=sizes,
        )  # fmt: skip
        for plot in shown:
            area = ElementTree.SubElement(splitter, "DockArea", name=plot.title)
            drawn = ElementTree.SubElement(
                area, "plot", mode="TimeSeries", style="Lines", flip_x="false", flip_y="false"
            )
            ElementTree.SubElement(drawn, "limitY")
            for (topic, field, _), colour in zip(plot.curves, _colours(), strict=False):
                ElementTree.SubElement(drawn, "curve", name=f"{topic}/{field}", color=colour)
    ElementTree.SubElement(window, "currentTabIndex", index="0")
    ElementTree.SubElement(root, "use_relative_time_offset", enabled="1")
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def _colours() -> Iterator[str]:
    return itertools.cycle(COLOURS)
