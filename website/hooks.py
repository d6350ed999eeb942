"""What MkDocs asks of this project: pages made from the code, and links that hold here as they do in a checkout.

A page links to what it means by the path in the checkout. On the site ``docs/`` is the root and what else is linked to
stands under ``project/``; ``Links`` translates. Reference pages are made from the command, the registry of effects and
the list that ``import equimus_ctrl`` offers, when the site is built, so they cannot be older than the code.
"""

from __future__ import annotations

import logging
import posixpath
import re
from pathlib import Path

import reference
from lists import aligned
from markup import commands, located, notebook, opened, unbroken
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from records import is_record, record
from tables import roomy

ROOT = Path(__file__).resolve().parent.parent
PAGES = ("CHANGELOG.md", "CONTRIBUTING.md", "README.md", "RELEASING.md", "SECURITY.md")
"""Pages of the checkout's root that are pages of the site."""
log = logging.getLogger("mkdocs.hooks")
LINK = re.compile(r"(\]\()([^)\s#]+)((?:#[^)\s]*)?\))")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages and what of the checkout is linked to."""
    for name in PAGES:
        files.append(File.generated(config, f"project/{name}", content=(ROOT / name).read_text(encoding="utf-8")))
    for uri, text in reference.pages(ROOT).items():
        files.append(File.generated(config, uri, content=text))
    for page in [file for file in files if file.src_uri.endswith(".md")]:
        for _, target, _ in LINK.findall(page.content_string):
            if (uri := site_uri(page.src_uri, target)) is None or files.get_file_from_path(uri):
                continue
            if (source := ROOT / uri.removeprefix("project/")).is_file() and uri.startswith("project/"):
                files.append(File.generated(config, uri, abs_src_path=str(source)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Let links lead to where things stand on the site, and lists be lists; say what a record is of."""
    markdown = translated(page.file.src_uri, markdown)
    return aligned(record(page.file.src_uri, markdown) if is_record(page.file.src_uri) else markdown)


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Keep code in one piece, open figures, let links of notebooks lead to pages, as MkDocs does of Markdown."""
    if page.file.src_uri.endswith(".py"):
        html = notebook(html)
    html = roomy(located(opened(commands(unbroken(html)))))
    if not page.file.src_uri.endswith(".py"):
        return html

    def link(found: re.Match[str]) -> str:
        uri = site_uri(page.file.src_uri, found[1])
        target = None if uri is None else files.get_file_from_path(uri)
        if target is None:
            log.warning("%s links to %s, which is not there", page.file.src_uri, found[1])
            return found[0]
        anchor = found[2] or ""
        return f'href="{target.url_relative_to(page.file)}{anchor}"'

    return re.sub(r'href="([^":#]+\.(?:md|py))(#[^"]*)?"', link, html)


def translated(page_uri: str, markdown: str) -> str:
    """A page's text with its links into the checkout as links of the site."""

    def link(found: re.Match[str]) -> str:
        uri = site_uri(page_uri, found[2])
        if uri is None:
            return found[0]
        return f"{found[1]}{posixpath.relpath(uri, posixpath.dirname(page_uri) or '.')}{found[3]}"

    return LINK.sub(link, markdown)


def site_uri(page_uri: str, target: str) -> str | None:
    """What stands on the site for a link of a page: a path from the site's root; None for what is no path."""
    if re.match(r"[a-z]+:", target) or target.startswith("/"):
        return None
    in_checkout = page_uri.removeprefix("project/") if page_uri.startswith("project/") else f"docs/{page_uri}"
    path = posixpath.normpath(posixpath.join(posixpath.dirname(in_checkout), target))
    return path.removeprefix("docs/") if path.startswith("docs/") else f"project/{path}"
