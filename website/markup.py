"""Pages as they are easier to read: code within a line, and figures."""

from __future__ import annotations

import re
from html import unescape

SPAN = re.compile(r"(?<!<pre>)(?<!<span></span>)<code>([^<]+)</code>")
JOINT = re.compile(
    r"(?<=[/_,:=(|+])(?=[^\s/_.,:=(|+])"  # behind what joins words,
    r"|(?<=[^\d\s]\.)(?=[^\s/_.,:=(])(?!\w{1,7}(?![\w.]))"  # and a dot, but before a file's ending and in a number
)
"""Where a line of code may end."""
LONGEST = 28
"""Characters that fit in a line of a list on a phone."""
COMMANDS = re.compile(r'<div class="language-sh highlight">.*?</div>', re.DOTALL)
FLAG = re.compile(r"(?<![\w.\"/-])--?[a-z][a-z-]*(?![\w.\"]*[\">])")
ENTRY = re.compile(
    r'<h3 id="(?P<module>equimus_ctrl[\w.]*)\.\w+" class="doc doc-heading">(?P<name>.*?)(?=<a [^>]*class="headerlink")',
    re.DOTALL,
)
BLOCK = re.compile(r'<div class="highlight"><pre><span></span>(?P<lines>equimus-ctrl\b.*?)</pre>', re.DOTALL)
"""Commands in the prose of a notebook."""
PRINTED = re.compile(r'(?P<head><div class="jp-RenderedText[^>]*>\s*<pre)(?P<text>>.*?</pre>)', re.DOTALL)
WIDEST = 120
"""Characters of a printed table's line; longer ones are prose, and wrap."""
FIGURE = re.compile(r'<p>(<img [^>]*?src="([^":]+)"[^>]*>)')


def unbroken(html: str) -> str:
    """The same page; browsers would else break ``--free`` after its first hyphen.

    Code of at most ``LONGEST`` characters gets the class ``short``, which the style sheet keeps in one line. In longer
    code a line may end behind a slash, an underscore and the like.
    """

    def span(found: re.Match[str]) -> str:
        if len(unescape(found[1])) <= LONGEST:
            return f'<code class="short">{found[1]}</code>'
        return f"<code>{JOINT.sub('<wbr>', found[1])}</code>"

    return SPAN.sub(span, html)


def commands(html: str) -> str:
    """The same page; in commands, which wrap, an option stays in one piece, too."""
    return COMMANDS.sub(lambda block: FLAG.sub(r'<span class="short">\g<0></span>', block[0]), html)


def opened(html: str) -> str:
    """The same page; a figure is a link to itself, which a browser shows in its full size."""
    return FIGURE.sub(r'<p><a href="\2">\1</a>', html)


def located(html: str) -> str:
    """The same page; of what a program imports its module stands beside, and its name may break at its joints."""

    def entry(found: re.Match[str]) -> str:
        name = found["name"].strip()
        called = re.match(r"[\w.]+", name)
        name = breakable(called[0]) + name[called.end() :] if called else name
        head = found[0][: found.start("name") - found.start()]
        return f'{head}{name} <small class="module">{breakable(found["module"])}</small>'

    return ENTRY.sub(entry, html)


def breakable(name: str) -> str:
    """A name of Python that may go on in the next line behind its parts."""
    return re.sub(r"(?<=[._])(?=\w)|(?<=[a-z])(?=[A-Z])", "<wbr>", name)


def notebook(html: str) -> str:
    """The same page of a notebook: commands as on other pages, and printed tables in lines of their own."""

    def block(found: re.Match[str]) -> str:
        lines = [
            f'<span id="__line-{found.start()}-{k}">{line}\n</span>' for k, line in enumerate(_lines(found["lines"]))
        ]
        return f'<div class="language-sh highlight"><pre><span></span><code>{"".join(lines)}</code></pre>'

    def printed(found: re.Match[str]) -> str:
        lines = unescape(re.sub(r"<[^>]+>", "", found["text"][1:])).splitlines()
        table = any(re.search(r"\S {2,}\S", line) for line in lines) and max(map(len, lines)) <= WIDEST
        return found["head"] + (' class="table"' if table else "") + found["text"]

    return PRINTED.sub(printed, BLOCK.sub(block, html))


def _lines(html: str) -> list[str]:
    return html.rstrip("\n").split("\n")
