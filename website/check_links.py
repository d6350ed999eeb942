"""Whether every link and anchor inside a built site leads somewhere: ``python website/check_links.py FOLDER``.

Links to other sites are listed with ``--external`` and not fetched. Exit code 1 says that something is dead.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

LINKS = {"a": "href", "link": "href", "img": "src", "script": "src", "iframe": "src", "source": "src"}
"""Element → the attribute that leads somewhere."""
EVERYWHERE = ("404.html",)
"""Pages that are shown under any address, so their links begin at the root."""


@dataclass
class _Page(HTMLParser):
    """Links and anchors of a page."""

    links: list[str] = field(default_factory=list)
    anchors: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        super().__init__(convert_charrefs=True)

    def handle_starttag(self, tag: str, attrs: Sequence[tuple[str, str | None]]) -> None:
        """Keep what it has."""
        given = dict(attrs)
        self.anchors.update(value for key in ("id", "name") if (value := given.get(key)))
        if target := given.get(LINKS.get(tag, "")):
            self.links.append(target)


@dataclass(frozen=True)
class Found:
    """What a site's links are.

    Attributes:
        pages: how many there are.
        internal: how many links lead to the site itself.
        dead: (page, link, reason) of those that lead nowhere.
        external: addresses of other sites.
    """

    pages: int
    internal: int
    dead: tuple[tuple[str, str, str], ...]
    external: tuple[str, ...]


def check(folder: Path) -> Found:
    """All links of all pages below a folder."""
    pages = {path.resolve(): _parsed(path) for path in sorted(folder.rglob("*.html"))}
    dead, external, internal = [], set(), 0
    for path, page in pages.items():
        for link in page.links:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                external.update({link} if parts.scheme in ("http", "https") else ())
                continue
            internal += 1
            if reason := _problem(folder.resolve(), path, unquote(parts.path), unquote(parts.fragment), pages):
                dead.append((str(path.relative_to(folder.resolve())), link, reason))
    return Found(len(pages), internal, tuple(dead), tuple(sorted(external)))


def _parsed(path: Path) -> _Page:
    page = _Page()
    page.feed(path.read_text(encoding="utf-8"))
    return page


def _problem(root: Path, page: Path, path: str, fragment: str, pages: dict[Path, _Page]) -> str:
    """Why a link leads nowhere; empty where it does lead somewhere."""
    if path.startswith("/"):
        target = root / path.lstrip("/")
    else:
        target = (page.parent if page.name not in EVERYWHERE else root) / path if path else page
    target = (target / "index.html" if target.is_dir() else target).resolve()
    if not target.is_file():
        return "no such file"
    if not target.is_relative_to(root):
        return "outside the site"
    known = pages.get(target)
    return "no such anchor" if fragment and known is not None and fragment not in known.anchors else ""


def report(found: Found, external: bool) -> Iterator[str]:
    """Lines for people."""
    yield from (f"dead: {page}: {link}: {reason}" for page, link, reason in found.dead)
    if external:
        yield from (f"external: {link}" for link in found.external)
    yield (
        f"{found.pages} pages, {found.internal} internal links, {len(found.dead)} dead, "
        f"{len(found.external)} addresses of other sites (not fetched)"
    )


if __name__ == "__main__":
    result = check(Path(sys.argv[1]))
    print("\n".join(report(result, "--external" in sys.argv)))
    sys.exit(bool(result.dead))
