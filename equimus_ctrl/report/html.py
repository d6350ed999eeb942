"""Parts of a page of HTML that needs nothing else: its look, figures within it, tables."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from html import escape

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

CSS = """
:root { color-scheme: light dark; --ink: #222; --paper: #fff; --faint: #666; --line: #e3e3e3; --rule: #999;
  --link: #0060a0; --mark: #f4f8fb; --good: #0072b2; --warn: #d55e00; --warm: #fdf6f1; --code: #f5f5f5; }
body { font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; color: var(--ink);
  background: var(--paper); max-width: 1040px; margin: 0 auto; padding: 24px 20px 60px; }
h1 { font-size: 26px; margin: 0 0 4px; overflow-wrap: anywhere; }
h2 { font-size: 20px; margin: 40px 0 10px; padding-top: 10px; border-top: 1px solid var(--line); }
h3 { font-size: 16px; margin: 24px 0 6px; }
p, ul, ol { margin: 8px 0; max-width: 80ch; overflow-wrap: anywhere; }
.verdict { font-size: 18px; font-weight: 600; border-left: 5px solid var(--good); padding: 6px 14px;
  background: var(--mark); max-width: none; }
.verdict.unexplained, .verdict.partly_explained, .verdict.unfinished { border-color: var(--warn);
  background: var(--warm); }
.faint { color: var(--faint); font-size: 14px; }
nav { font-size: 14px; margin: 14px 0; display: flex; flex-wrap: wrap; gap: 4px 14px; }
nav a, summary { color: var(--link); }
summary { cursor: pointer; margin: 8px 0; }
figure { margin: 14px 0; overflow-x: auto; }
img { max-width: 100%; height: auto; display: block; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: 14px; margin: 10px 0; }
th, td { padding: 4px 10px 4px 0; text-align: right; border-bottom: 1px solid var(--line); vertical-align: top; }
th { border-bottom: 1px solid var(--rule); font-weight: 600; }
td { white-space: nowrap; }
th.text, td.text { text-align: left; white-space: normal; overflow-wrap: break-word; max-width: 46ch; }
th.group { text-align: center; border-bottom: 1px solid var(--line); }
td.first, th.first { padding-left: 10px; border-left: 1px solid var(--line); }
tr.strong td { font-weight: 600; background: var(--mark); }
pre, code { font: 14px/1.45 ui-monospace, Menlo, Consolas, monospace; background: var(--code); }
pre { padding: 8px 12px; white-space: pre-wrap; overflow-wrap: anywhere; }
@media (max-width: 640px) { body { padding: 16px 12px 40px; } h1 { font-size: 22px; }
  td.long { min-width: 10em; }
  img { max-width: none; width: 100%; } img.broad { min-width: 640px; } }
@media screen and (prefers-color-scheme: dark) { :root { --ink: #ddd; --paper: #141414; --faint: #a0a0a0;
  --line: #333; --rule: #777; --link: #6cb6ef; --mark: #16222c; --good: #4aa3df; --warn: #e8843c; --warm: #2a1d14;
  --code: #222; } img { filter: invert(0.92) hue-rotate(180deg); } }
@media print { body { max-width: none; padding: 0; font-size: 12px; } nav { display: none; }
  figure, tr, .verdict { break-inside: avoid; } h2, h3 { break-after: avoid; } }
"""
"""Readable at the width of a phone, in light and dark: figures keep their hues and turn their lightness."""
LONG = 20
"""Characters of a cell that is to be wrapped, but not at every word."""
BROAD = 7.5
"""A figure that is broader scrolls sideways on a phone rather than shrink until nobody can read it [inch]."""


def figure_html(figure: Figure, alt: str, narrow: Figure | None = None) -> str:
    """A figure as part of the page.

    Args:
        figure: drawn as it is.
        alt: what it shows, in words.
        narrow: the same for a phone; without, a broad one scrolls there.
    """
    broad = ' class="broad"' if narrow is None and figure.get_figwidth() > BROAD else ""
    image = f'<img alt="{escape(alt)}"{broad} src="{_data(figure)}">'
    if narrow is not None:
        phone = f'<source media="(max-width: 640px)" srcset="{_data(narrow)}">'
        image = f"<picture>{phone}{image}</picture>"
    return f"<figure>{image}</figure>"


def _data(figure: Figure) -> str:
    buffer = io.BytesIO()
    FigureCanvasAgg(figure).print_png(buffer, metadata={"Software": None})  # type: ignore[no-untyped-call]
    return f"data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode('ascii')}"


def list_html(lines: Sequence[str]) -> str:
    """A list of sentences; "" of none."""
    return f"<ul>{''.join(f'<li>{escape(line)}</li>' for line in lines)}</ul>" if lines else ""


def table_html(head: Sequence[str], rows: Sequence[Sequence[str]], text: int = 1, strong: Sequence[int] = ()) -> str:
    """A table whose first ``text`` columns are words."""

    def line(cells: Sequence[str], tag: str) -> str:
        longs = (" long" if len(cell) > LONG else "" for cell in cells)
        kinds = (f' class="text{long}"' if k < text else "" for k, long in enumerate(longs))
        return "".join(f"<{tag}{kind}>{escape(cell)}</{tag}>" for cell, kind in zip(cells, kinds, strict=True))

    kinds = {True: '<tr class="strong">', False: "<tr>"}
    body = "".join(f"{kinds[k in strong]}{line(row, 'td')}</tr>" for k, row in enumerate(rows))
    return f'<div class="wide"><table><thead><tr>{line(head, "th")}</tr></thead><tbody>{body}</tbody></table></div>'


def grouped_html(first: str, groups: Sequence[tuple[str, Sequence[str]]], rows: Sequence[Sequence[str]]) -> str:
    """A table whose columns after the first stand in groups with a head of their own."""
    starts = {0} | set(np.cumsum([len(heads) for _, heads in groups[:-1]]).tolist())

    def cells(values: Sequence[str], tag: str) -> str:
        kinds = (' class="first"' if k in starts else "" for k in range(len(values)))
        return "".join(f"<{tag}{kind}>{escape(value)}</{tag}>" for value, kind in zip(values, kinds, strict=True))

    above = "".join(f'<th class="group first" colspan="{len(heads)}">{escape(name)}</th>' for name, heads in groups)
    below = cells([head for _, heads in groups for head in heads], "th")
    body = "".join(f'<tr><td class="text">{escape(name)}</td>{cells(values, "td")}</tr>' for name, *values in rows)
    return (
        f'<div class="wide"><table><thead><tr><th class="text">{escape(first)}</th>{above}</tr>'
        f'<tr><th class="text"></th>{below}</tr></thead><tbody>{body}</tbody></table></div>'
    )
