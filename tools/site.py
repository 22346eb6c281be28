"""Sphinx extension of the site (docs/conf.py): pages that stand elsewhere in the repository, results, source code.

Links between files are kept as they are in the repository, so that they hold there too. For the site, one to a file
that is a page goes to that page, one to a module to its source page, one to a folder is plain text, and any other
file can be downloaded.
"""

import ast
import json
import os
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx
from sphinx.highlighting import PygmentsBridge

ROOT = Path(__file__).parents[1]
DOCS, RESULTS = ROOT / "docs", ROOT / "benchmarks" / "results"
PACKAGES = ("layerjax", "fits")

TAKEN = {
    ROOT / "CHANGELOG.md": "project/changelog",
    ROOT / "CONTRIBUTING.md": "project/contributing",
    ROOT / "examples" / "README.md": "project/examples",
    ROOT / "examples" / "arizona_black_coatings" / "README.md": "project/arizona_black_coatings",
    **{path: f"benchmarks/{path.stem}" for path in sorted(RESULTS.glob("*.md")) if path.stem != "README"},
    RESULTS / "README.md": "benchmarks/index",
}
"""Files of the repository that are pages, and the pages' names. They are written at build, and not kept in git."""

LINK = re.compile(r"(?<!!)\[(?P<text>(?:[^\[\]]|\[[^\]]*\])*)\]\((?P<target>[^)#:]+)(?P<anchor>#[^)]*)?\)")
PICTURE = re.compile(r"(?P<head>!\[[^\]]*\]\()(?P<target>[^)#:]+)\)")
IMAGE = re.compile(r'<img [^>]*?src="(?P<src>[^"]*_images/[^"]*)"[^>]*>')
BARS = re.compile(r"\|(\S(?:[^|]*\S)?)\|")
FENCE = re.compile(r"(^ *```.*?^ *```)", re.DOTALL | re.MULTILINE)

SCHEME = {"url": "{{path}}#{{fragment}}"}
"""URL scheme of links to source pages, which are no documents of Sphinx."""


def setup(app: Sphinx) -> dict[str, bool]:
    """Called by Sphinx."""
    app.connect("builder-inited", lambda app: write_pages(Path(app.srcdir)))
    app.connect("source-read", _read)
    app.connect("html-page-context", _link_pictures)
    app.connect("autodoc-process-docstring", _bars)
    app.connect("html-collect-pages", _source_pages)
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def write_pages(docs: Path) -> None:
    """Write the pages that are taken from elsewhere into `docs`; those that are as they were stay untouched."""
    for path, page in TAKEN.items():
        text = linked(path.read_text(), path, page)
        if page == "benchmarks/index":
            text += _overview()
        elif page.startswith("benchmarks/"):
            text += _figures(path)
        place = docs / f"{page}.md"
        if not place.exists() or place.read_text() != text:
            place.parent.mkdir(exist_ok=True)
            place.write_text(text)


def linked(text: str, origin: Path, page: str) -> str:
    """Markdown of the file `origin` with its links as they must be on `page`; what stands in fences is left alone."""

    def link(match: re.Match[str]) -> str:
        words, anchor = match["text"], match["anchor"] or ""
        target = (origin.parent / match["target"]).resolve()
        if target.is_dir():
            return words
        if target in TAKEN:
            return f"[{words}]({_relative(DOCS / f'{TAKEN[target]}.md', page)}{anchor})"
        if target.suffix == ".py" and target.relative_to(ROOT).parts[0] in PACKAGES:
            return f"[{words}](source:{source_of(target, page, words)})"
        return f"[{words}]({_relative(target, page)}{anchor})" if target.exists() else match[0]

    def picture(match: re.Match[str]) -> str:
        return f"{match['head']}{_relative((origin.parent / match['target']).resolve(), page)})"

    parts = FENCE.split(text)
    parts[::2] = (PICTURE.sub(picture, LINK.sub(link, part)) for part in parts[::2])
    return "".join(parts)


def source_of(path: Path, page: str, words: str = "") -> str:
    """Address of a module's source page from `page`; with `module:name` in the words, of the line of that name."""
    name = words.strip("`").partition(":")[2]
    line = lines_of(path).get(name)
    place = os.path.relpath(DOCS / "source" / path.relative_to(ROOT).with_suffix(".html"), (DOCS / page).parent)
    return f"{place}#{f'line-{line}' if line else 'source'}"


@cache
def lines_of(path: Path) -> dict[str, int]:
    """Line of every function, class and assigned name of a module, methods as `Class.method`."""
    return dict(_lines_in(ast.parse(path.read_text()), ""))


def _lines_in(node: ast.Module | ast.ClassDef, owner: str) -> Iterator[tuple[str, int]]:
    for child in node.body:
        if isinstance(child, ast.ClassDef | ast.FunctionDef):
            yield owner + child.name, child.lineno
        if isinstance(child, ast.ClassDef):
            yield from _lines_in(child, f"{owner}{child.name}.")
        for target in child.targets if isinstance(child, ast.Assign) else [getattr(child, "target", None)]:
            if isinstance(target, ast.Name):
                yield owner + target.id, child.lineno


def _relative(path: Path, page: str) -> str:
    return Path(os.path.relpath(path, (DOCS / page).parent)).as_posix()


def _read(app: Sphinx, page: str, source: list[str]) -> None:
    if page not in TAKEN.values() and app.env.doc2path(page).suffix == ".md":
        source[0] = linked(source[0], Path(app.env.doc2path(page)), page)


def _link_pictures(app: Sphinx, page: str, template: str, context: dict[str, Any], doctree: Any) -> None:
    """A picture is a link to its file, where labels can be read that are small on a narrow screen."""
    context["body"] = IMAGE.sub(r'<a href="\g<src>">\g<0></a>', context.get("body", ""))


def _bars(app: Sphinx, what: str, name: str, documented: Any, options: Any, lines: list[str]) -> None:
    """|cos| in a docstring is an absolute value, which reStructuredText takes for a substitution."""
    lines[:] = [line if "``" in line else BARS.sub(r"\\|\1\\|", line) for line in lines]


def _figures(path: Path) -> str:
    """What stands below a page of results: where its numbers come from."""
    numbers = _relative(path.with_suffix(".json"), TAKEN[path])
    return f"\n## Data\n\nAll figures of this page: [{path.stem}.json]({numbers}).\n"


def _overview() -> str:
    """A table of all results, from their JSON files, and the list of pages."""
    lines = ["", "## What was measured where", "", "| results | processor | cores | device | Python | jax | records |"]
    lines.append("|---|---|--:|---|---|---|--:|")
    pages = []
    for path in sorted(RESULTS.glob("*.json")):
        content: dict[str, Any] = json.loads(path.read_text())
        where = content["environment"]
        records = sum(len(part) for part in content.values() if isinstance(part, list))
        cells = (where[key] for key in ("processor", "cores", "device", "python", "jax"))
        lines.append(f"| [{path.stem}]({path.stem}.md) | {' | '.join(map(str, cells))} | {records:,} |")
        pages.append(path.stem)
    return "\n".join([*lines, "", "```{toctree}", ":hidden:", "", *pages, "```", ""])


def _source_pages(app: Sphinx) -> Iterator[tuple[str, dict[str, Any], str]]:
    """The modules of both packages as pages, a line an anchor."""
    if app.builder.format != "html":
        return
    bridge: PygmentsBridge = app.builder.highlighter  # type: ignore[attr-defined]
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            name = path.relative_to(ROOT).as_posix()
            code = bridge.highlight_block(path.read_text(), "python", lineanchors="line")
            title = f"Source of {name}"
            body = f'<h1 id="source">{title}</h1>\n{code}'
            yield f"source/{name.removesuffix('.py')}", {"title": title, "body": body}, "page.html"
