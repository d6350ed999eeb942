"""The site: its links in the sources, its navigation, the pages made from the code, and the checker of built links."""

from __future__ import annotations

import importlib
import inspect
import re
import sys
from html import unescape
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import yaml
from markdown_it import MarkdownIt

from equimus_ctrl.cli.main import app
from equimus_ctrl.effects import REGISTRY

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
HANDWRITTEN = [
    path
    for path in sorted([*ROOT.glob("*.md"), *DOCS.rglob("*.md")])
    if not path.is_relative_to(DOCS / "proof") and path.name != "CHANGELOG.md"
]
"""Pages that people write; CHANGELOG.md, one long list, and the records of proofs are not looked at."""


@pytest.fixture(scope="module", autouse=True)
def website() -> None:
    pytest.importorskip("mkdocs", reason="the site's tools come with the extra [docs]")
    sys.path.insert(0, str(ROOT / "website"))


def tool(name: str) -> ModuleType:
    return importlib.import_module(name)


def navigation(entries: object) -> list[str]:
    if isinstance(entries, str):
        return [entries]
    values = entries.values() if isinstance(entries, dict) else entries
    return [page for entry in values for page in navigation(entry)]  # type: ignore[union-attr]


def test_the_navigation_has_every_page_once_and_no_other() -> None:
    settings = re.sub(r"!!python/\S+", "", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"))
    listed = navigation(yaml.safe_load(settings)["nav"])
    assert len(listed) == len(set(listed))
    assert list(yaml.safe_load(settings)["nav"][0]) == ["Start here"]
    pages = {path.relative_to(DOCS).as_posix() for path in [*DOCS.rglob("*.md"), *DOCS.glob("tutorials/*.py")]}
    written = {page for page in pages if not page.startswith("proof/")}
    generated = {"reference/commands.md", "reference/effects.md", "reference/python.md", "reference/thresholds.md"}
    python = tool("reference_python")
    generated |= {f"{python.FOLDER}/{section.name}.md" for section in (*python.SECTIONS, python.MORE)}
    own = {f"project/{name}" for name in tool("hooks").PAGES}
    assert set(listed) == written | generated | own


@pytest.mark.parametrize("path", HANDWRITTEN, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_links_and_anchors_lead_somewhere_in_a_checkout(path: Path) -> None:
    """On a forge as on the site; pages made when the site is built are the only ones that a checkout lacks."""
    made = {"commands.md", "effects.md", "python.md", "thresholds.md"}
    for target, anchor in re.findall(r"\]\(([^)\s#:]*)#?([^)\s]*)\)", path.read_text(encoding="utf-8")):
        leads = (path.parent / target).resolve() if target else path
        if leads.parent == DOCS / "reference" and leads.name in made:
            continue
        assert leads.exists(), target
        if anchor and leads.suffix == ".md":
            assert anchor in anchors(leads), f"{target}#{anchor}"


def anchors(path: Path) -> set[str]:
    """Names of a page's headings, as forges and the site make them."""
    slugs = importlib.import_module("pymdownx.slugs").slugify(case="lower")
    return {slugs(heading, "-") for heading in headings(path)}


def headings(path: Path) -> list[str]:
    tokens = MarkdownIt("commonmark").enable("table").parse(path.read_text(encoding="utf-8"))
    inline = [tokens[k + 1] for k, token in enumerate(tokens) if token.type == "heading_open"]
    return ["".join(part.content for part in token.children or ()) for token in inline]


@pytest.mark.parametrize("path", HANDWRITTEN, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_prose_is_at_most_120_columns_wide(path: Path) -> None:
    reflow = tool("reflow")
    text = path.read_text(encoding="utf-8")
    wrapped = reflow.wrapped(text)
    assert wrapped == text or reflow.rendered(wrapped) != reflow.rendered(text), "python website/reflow.py wraps it"


@pytest.mark.parametrize("path", HANDWRITTEN, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_a_page_has_the_same_lists_and_tables_on_the_site_as_on_a_forge(path: Path) -> None:
    """Python-Markdown wants an empty line before a list and four columns of indent in it; forges do not."""
    from markdown import Markdown

    text = tool("lists").aligned(path.read_text(encoding="utf-8"))
    site = Markdown(extensions=["tables", "sane_lists", "pymdownx.superfences", "md_in_html", "attr_list"]).convert(
        text
    )
    forge = MarkdownIt("commonmark").enable("table").render(path.read_text(encoding="utf-8"))
    counts = [
        [len(re.findall(rf"<{tag}\b", page)) for tag in ("li", "tr", "h2", "h3", "table")] for page in (site, forge)
    ]
    assert counts[0] == counts[1]


def test_reflow_wraps_items_and_leaves_code_and_tables() -> None:
    wrapped = tool("reflow").wrapped
    long = "word " * 40
    assert max(map(len, wrapped(f"- {long}\n").splitlines())) <= 120
    assert wrapped(f"- {long}\n").splitlines()[1].startswith("  word")
    for kept in (f"```sh\n{long}\n```\n", f"| {long} |\n| --- |\n", f"# {long}\n"):
        assert wrapped(kept) == kept
    sentence = "x" * 117 + " - no item"
    assert "\n- " not in wrapped(sentence + "\n")
    assert wrapped(wrapped(long)) == wrapped(long)


def test_links_are_translated_both_ways() -> None:
    hooks = tool("hooks")
    assert hooks.translated("a/b.md", "[x](../../README.md#y)") == "[x](../project/README.md#y)"
    assert hooks.translated("project/README.md", "[x](docs/logs.md)") == "[x](../logs.md)"
    assert hooks.translated("project/README.md", "[x](CHANGELOG.md)") == "[x](CHANGELOG.md)"
    assert hooks.translated("a.md", "[x](logs.md#y) [z](mailto:a)") == "[x](logs.md#y) [z](mailto:a)"


def test_the_checker_finds_dead_links_and_anchors(tmp_path: Path) -> None:
    (tmp_path / "a.html").write_text(
        '<h1 id="top">a</h1><a href="b.html">b</a><a href="b.html#there">b</a><a href="#top">up</a>'
        '<a href="c.html">c</a><a href="b.html#not">b</a><a href="https://elsewhere.org/">e</a><img src="../d.png">'
    )
    (tmp_path / "b.html").write_text('<p id="there">')
    checker = tool("check_links")
    found = checker.check(tmp_path)
    assert [(link, reason) for _, link, reason in found.dead] == [
        ("c.html", "no such file"),
        ("b.html#not", "no such anchor"),
        ("../d.png", "no such file"),
    ]
    assert (found.pages, found.internal, found.external) == (2, 6, ("https://elsewhere.org/",))


def test_the_page_of_commands_has_every_verb_and_option() -> None:
    text = tool("reference_commands").page()
    for command in app.registered_commands:
        assert f"\n## {command.name}\n" in text
    assert "\n## recordings export\n" in text and "\n## hardware check\n" in text
    assert "| `--write-model` `FILE` |" in text and "| `-o`, `--output` `DIR` |" in text
    assert "`--window` `FROM TO`" in text and "`--figures` / `--no-figures`" in text
    assert "[bold]" not in text and "\b" not in text


def test_code_and_options_on_the_page_of_commands_are_as_they_are_typed() -> None:
    """A bar within code is no end of a cell, values are words, and options in prose are code, which is not broken."""
    from markdown import Markdown

    text = tool("reference_commands").page()
    html = Markdown(extensions=["tables", "pymdownx.superfences"]).convert(text)
    assert "<code>fitted|measured</code>" in html and "<code>recordings...</code> <code>PATH</code>" in html
    codes = [unescape(code) for code in re.findall(r"<code>(.*?)</code>", html)]
    assert not [code for code in codes if "\\" in code or code.startswith("<") or "list[" in code]
    rows = [row.count("<td") for row in re.findall(r"(?s)<tr>(.*?)</tr>", html)]
    assert set(rows) == {0, 3}
    prose = re.sub(r"(?s)<pre>.*?</pre>|<code>.*?</code>|<[^>]+>", "", html)
    assert not re.search(r"(?<!\S)--[a-z]", prose)


@pytest.mark.slow
def test_the_page_of_effects_has_every_effect_with_its_sentence_and_confusions() -> None:
    text = tool("reference_effects").page(DOCS / "proof")
    entries = dict(re.findall(r"(?ms)^### (\w+)\n(.*?)(?=^##|\Z)", text))
    assert set(entries) == set(REGISTRY)
    for name, cls in REGISTRY.items():
        assert "**Law**" in entries[name] and "**A report says**" in entries[name], name
        assert re.search(rf"!\[[^\]]+\]\(effects/{name}\.svg\)", entries[name]), name
        for key in cls.parameter_info():
            assert f"| `{key}` |" in entries[name], (name, key)
    assert re.search(r"named in \d+ of \d+; .*`supply_coupling` 1", entries["dead_zone"])


@pytest.mark.slow
def test_each_effect_has_a_figure_of_its_law_that_is_not_flat() -> None:
    figures = tool("effect_figures").figures()
    assert set(figures) == {f"effects/{name}.svg" for name in REGISTRY}
    assert all(drawn.startswith("<?xml") for drawn in figures.values())
    curves = set()
    for name, law in tool("effect_figures").laws().items():
        both = np.concatenate([law.values, law.without])
        assert np.isfinite(both).all() and len(law.x) == len(law.values) == len(law.without), name
        assert np.ptp(both) > 0.1 * np.abs(both).max(), name
        assert law.strength > 0.01 * np.abs(both).max(), name  # with the effect it is another curve
        curves.add((law.x_axis, law.y_axis, law.values.tobytes()))
    assert len(curves) == len(REGISTRY)  # two effects whose figures are the same are not shown


@pytest.mark.slow
def test_the_page_of_python_names_all_that_is_offered() -> None:
    import equimus_ctrl as eq

    names = [path.rpartition(".")[2] for _, path in tool("reference_python").names(ROOT / "equimus_ctrl/__init__.pyi")]
    assert set(names) == set(eq.__all__) - {"__version__"}
    reference = tool("reference_python")
    pages = reference.pages(ROOT / "equimus_ctrl" / "__init__.pyi")
    described = [path for text in pages.values() for path in re.findall(r"(?m)^::: equimus_ctrl\.(\S+)", text)]
    assert sorted(described) == sorted(path for _, path in reference.names(ROOT / "equimus_ctrl/__init__.pyi"))
    for path in described:
        assert f'id="equimus_ctrl.{path}"' in pages[reference.INDEX]  # where links of before lead
    more = pages[f"{reference.FOLDER}/more.md"]
    for name in ("Some", "Progress", "Measured", "Asked", "Holdout", "Rivals", "Designed", "Notify", "Diagnosis"):
        assert re.search(rf"\.{name}\}}<code>{name}</code> \|", more), name


@pytest.mark.slow
def test_signatures_show_defaults_and_not_what_makes_a_field() -> None:
    """With the extension of the site griffe makes signatures as ``inspect`` reads them from the classes."""
    griffe = pytest.importorskip("griffe")
    import equimus_ctrl as eq

    extensions = griffe.load_extensions(tool("real_defaults").RealDefaults)
    package = griffe.load("equimus_ctrl", search_paths=[str(ROOT)], extensions=extensions)
    for path in ("options.DiagnoseOptions", "effects.FillingFlow", "controllers.sampling_settings.SamplingSettings"):
        shown = {p.name: p.default for p in package[path].parameters if p.name != "self"}
        real = inspect.signature(getattr(eq, path.rpartition(".")[2])).parameters
        assert list(shown) == list(real)
        for name, own in real.items():
            if own.default is own.empty:
                assert shown[name] is None, (path, name)
            elif isinstance(own.default, int | float | str | tuple | None):
                assert eval(str(shown[name])) == own.default, (path, name)


def test_records_have_titles_of_their_own_and_words_stand_to_the_left() -> None:
    records = tool("records")
    uris = [path.relative_to(DOCS).as_posix() for path in sorted(DOCS.glob("proof/**/score.md"))]
    pages = {uri: records.record(uri, (DOCS / uri).read_text(encoding="utf-8")) for uri in uris}
    titles = [page.partition("\n")[0] for page in pages.values()]
    assert len(set(titles)) == len(titles) > 10
    for uri, page in pages.items():
        for target, _ in re.findall(r"\]\((\S+\.md)(#\S*)?\)", page.partition("- ")[0]):
            assert (DOCS / uri).parent.joinpath(target).resolve().is_file(), (uri, target)
    wrong = pages["proof/robots/arm3/score.md"].partition("## Answers that were not right")[2]
    assert "\n| case | kind | excess | truth | said |\n| --- | --- | ---: | --- | --- |\n" in wrong
    assert "m_yaw+<wbr>m_shoulder" in wrong


def test_prose_has_room_in_tables_that_scroll_on_a_phone() -> None:
    roomy = tool("tables").roomy
    long = "word " * 12
    row = "<tr><td>a</td><td>0.1</td><td>name_of_a_thing</td>" + f"<td>{long}</td></tr>"
    found = roomy(f"<table>{row}</table>")
    assert '<td class="prose">word' in found and '<td class="few">0.1' in found and "<td>name_of" in found
    for kept in ("<table><tr><td>a</td><td>b</td><td>c</td></tr></table>", f"<table><tr><td>{long}</td></tr></table>"):
        assert roomy(kept) == kept


def test_commands_and_printed_tables_of_notebooks_are_marked() -> None:
    notebook = tool("markup").notebook
    block = '<div class="highlight"><pre><span></span>equimus-ctrl<span> </span>run\nequimus-ctrl<span> </span>list\n</pre></div>'
    found = notebook(block)
    assert 'class="language-sh highlight"' in found and found.count('<span id="__line') == 2
    printed = '<div class="jp-RenderedText" tabindex="0">\n<pre>{}</pre></div>'
    assert '<pre class="table">' in notebook(printed.format("a   1\nbcd 2"))
    prose = printed.format("one sentence")
    assert notebook(prose) == prose


def test_version_of_the_citation_is_the_packages() -> None:
    import equimus_ctrl

    said = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert said["version"] == equimus_ctrl.__version__.removesuffix(".dev0")
    assert {"cff-version", "message", "title", "authors", "license"} <= set(said)


def test_code_within_a_line_stays_in_one_piece_or_breaks_at_its_joints() -> None:
    unbroken = tool("markup").unbroken
    assert unbroken("<p>(<code>--free</code>)</p>") == '<p>(<code class="short">--free</code>)</p>'
    long = "controllers/&lt;controller&gt;_&lt;robot&gt;.toml"
    found = unbroken(f"<td><code>{long}</code></td>")
    assert "<wbr>" in found and found.replace("<wbr>", "") == f"<td><code>{long}</code></td>"
    for whole in ("0.95", "*.whl", "searched.py"):
        many = f"a_long_name_before/that_goes_on {whole}"
        assert whole in unbroken(f"<td><code>{many}</code></td>")
    block = '<div class="highlight"><pre><span></span><code>u = w + c\n</code></pre></div>'
    assert unbroken(block) == block


def test_a_figure_of_a_page_opens_in_its_full_size() -> None:
    opened = tool("markup").opened
    assert opened('<p><img alt="a" src="images/a.png" /></p>').startswith('<p><a href="images/a.png"><img alt="a"')
    inline = '<p><img src="data:image/png;base64,AA"></p>'
    assert opened(inline) == inline
