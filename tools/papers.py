"""python -m tools.papers: write docs/papers.md, which says where every cited equation stands in the source.

A citation is "Eq. (3)", "Eqs. 12 and 16", "Eqs. (32-35)", "Sec. 4.6", "Section 5", "Algorithm 1" or "Appendix A" in a
docstring or comment of `layerjax`. It belongs to the paper whose author and year stand right before it ("Wang 2022,
Eq. 3") or right after it ("Eq. (8) of Guo et al. 2015"), else to the paper of the file that it stands in.
"""

import ast
import io
import re
import tokenize
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "papers.md"


class Paper(NamedTuple):
    """last: what stands before the year in a citation. homes: files and folders (globs) whose citations are of it."""

    last: str
    year: int
    reference: str
    homes: tuple[str, ...]
    note: str = ""


PAPERS = (
    Paper(
        "Wang",
        2022,
        "Wang, Jin, Hašan & Yan 2022, *SpongeCake: A Layered Microflake Surface Appearance Model*",
        (
            "normals/sggx.py",
            "phase*",
            "gallery.py",
            "transport/single_scattering*",
            "transport/spongecake/*",
            "transport/adding_doubling/media.py",
            "precompute/spongecake/*",
        ),
        "`SingleScattering` is its Section 4, `SpongeCake` adds Section 5, which has no numbered equations.",
    ),
    Paper(
        "Belcour",
        2018,
        "Belcour 2018, *Efficient Rendering of Layered Materials using an Atomic Decomposition with Statistical "
        "Operators*",
        ("transport/lobes/*", "transport/statistical/[!d]*"),
        "`Statistical`.",
    ),
    Paper(
        "Belcour",
        2022,
        "de Dinechin & Belcour 2022, *Rendering Layered Materials with Diffuse Interfaces*",
        ("transport/statistical/diffuse*", "precompute/diffuse_interface*"),
        '`Statistical` over a diffuse base; its lobe is `Statistical(diffuse="lobe")`.',
    ),
    Paper(
        "Guo",
        2015,
        "Guo, Qian & Pan 2015, *Practical Rendering of Thin Layered Materials with Extended Microfacet Normal "
        "Distributions*",
        ("normals/vmf.py", "transport/endf/*"),
        "`ENDF`.",
    ),
    Paper(
        "Weidlich",
        2024,
        "d'Eon & Weidlich 2024, *VMF Diffuse: A unified rough diffuse BRDF*",
        ("surfaces/vmf_diffuse/*", "precompute/vmf_diffuse/*"),
        "`VMFDiffuse`.",
    ),
    Paper(
        "Wilkie",
        2007,
        "Weidlich & Wilkie 2007, *Arbitrarily Layered Micro-Facet Surfaces*",
        ("transport/weidlich_wilkie*",),
        "`WeidlichWilkie`.",
    ),
    Paper(
        "Walter",
        2007,
        "Walter, Marschner, Li & Torrance 2007, *Microfacet Models for Refraction through Rough Surfaces*",
        ("surfaces/microfacet*", "normals/facets*"),
        "`Interface` and `Conductor`.",
    ),
    Paper(
        "Heitz",
        2016,
        "Heitz, Hanika, d'Eon & Dachsbacher 2016, *Multiple-Scattering Microfacet BSDFs with the Smith Model*",
        ("microsurface/*", "transport/random_walk/*", "precompute/microsurface*"),
        "Interfaces and conductors with `facet_multiple_scattering=True`.",
    ),
)
"""In the order of the page."""

NUMBER = r"\(?\d+(?:\.\d+)*\)?"
JOINT = r"-|,\s|,?\sand\s|\sto\s"
CITATION = re.compile(
    rf"\b(?:(?P<kind>Eqs|Secs|Sections|Algorithms)\.?\s(?P<first>{NUMBER})(?P<more>(?:(?:{JOINT}){NUMBER}(?![\w/]))*)"
    rf"|(?P<one>Eq\.|Sec\.|Section|Algorithm)\s(?P<number>{NUMBER})|(?P<appendix>Appendix|App\.)\s(?P<letter>[A-Z])\b)"
)
BEFORE = re.compile(r"(\w+)(?: et al\.)? (\d{4}),? \(?$")
AFTER = re.compile(r",? of (\w+)(?: et al\.)? (\d{4})")
KINDS = {"E": "Eq.", "S": "Sec.", "Al": "Algorithm", "Ap": "Appendix"}


class Citation(NamedTuple):
    """place: "module:function", or "module" where all of it is meant. label: as "Eq. 3"."""

    paper: Paper
    label: str
    place: str
    path: Path


def page() -> str:
    """The text of docs/papers.md."""
    citations_of: dict[Paper, dict[str, dict[str, Path]]] = defaultdict(lambda: defaultdict(dict))
    for citation in citations():
        citations_of[citation.paper][citation.label].setdefault(citation.place, citation.path)
    lines = [
        "# Papers to functions",
        "",
        "This page lists the functions that implement each equation or section of a paper. `python -m tools.papers`",
        "generates it from docstrings and comments. [Errata](errata.md) lists corrections.",
    ]
    for paper in PAPERS:
        if paper not in citations_of:
            continue
        lines += ["", f"## {paper.reference}", "", paper.note, "", "| in the paper | in the source |", "|---|---|"]
        for label in sorted(citations_of[paper], key=_order):
            links = (f"[`{name}`](../{path.as_posix()})" for name, path in sorted(citations_of[paper][label].items()))
            lines.append(f"| {label} | {'<br>'.join(links)} |")
    return "\n".join(lines) + "\n"


def citations() -> Iterator[Citation]:
    """All citations in the source; a ValueError names the first that belongs to no paper."""
    for path in sorted((ROOT / "layerjax").rglob("*.py")):
        yield from citations_in(path.relative_to(ROOT), path.read_text())


def citations_in(path: Path, source: str) -> Iterator[Citation]:
    """The citations of one file; path: from the root."""
    module = ".".join(path.with_suffix("").parts).removesuffix(".__init__")
    tree = ast.parse(source)
    texts = [*_docstrings(tree), *_comments(source, tree)]
    for name, text in texts:
        text = " ".join(text.split())
        for match in CITATION.finditer(text):
            named = BEFORE.search(text[: match.start()]) or AFTER.match(text[match.end() :])
            paper = _named(named) if named else _home(path)
            if paper is None:
                raise ValueError(f"{path}: {match[0]!r} in {name or 'the module'} is of no paper in tools/papers.py")
            for label in _labels(match):
                yield Citation(paper, label, f"{module}:{name}" if name else module, path)


def _named(match: re.Match[str]) -> Paper | None:
    return next((paper for paper in PAPERS if (paper.last, paper.year) == (match[1], int(match[2]))), None)


def _home(path: Path) -> Paper | None:
    inside = path.relative_to("layerjax")
    tests = ((paper, home) for paper in PAPERS for home in paper.homes)
    # a folder's home holds for what lies deeper in it, too
    return next((paper for paper, home in tests if any(p.match(home) for p in (inside, *inside.parents))), None)


def _labels(match: re.Match[str]) -> Iterator[str]:
    written = match["kind"] or match["one"] or match["appendix"]
    kind = next(label for start, label in KINDS.items() if written.startswith(start))
    numbers = [(match["first"] or match["number"] or match["letter"]).strip("()")]
    for joint, number in re.findall(rf"({JOINT})({NUMBER})", match["more"] or ""):
        number = number.strip("()")
        if joint in ("-", " to "):
            numbers += map(str, range(int(numbers[-1]) + 1, int(number)))
        numbers.append(number)
    return (f"{kind} {number}" for number in numbers)


def _docstrings(tree: ast.Module) -> Iterator[tuple[str, str]]:
    """(name, text) of every string that stands alone: docstrings, and what is said below a name."""
    yield from _strings_in(tree, "")


def _strings_in(node: ast.Module | ast.ClassDef | ast.FunctionDef, owner: str) -> Iterator[tuple[str, str]]:
    above = owner
    for child in node.body:
        if isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant) and isinstance(child.value.value, str):
            yield above, child.value.value
        elif isinstance(child, ast.ClassDef | ast.FunctionDef):
            yield from _strings_in(child, _join(owner, child.name))
        targets = child.targets if isinstance(child, ast.Assign) else [getattr(child, "target", None)]
        name = targets[0].id if isinstance(targets[0], ast.Name) else ""
        above = _join(owner, name) if name and not isinstance(node, ast.FunctionDef) else owner


def _comments(source: str, tree: ast.Module) -> Iterator[tuple[str, str]]:
    """(name of what it stands in, text) of every comment."""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield _owner(tree, token.start[0]), token.string


def _owner(node: ast.AST, line: int, owner: str = "") -> str:
    for child in ast.iter_child_nodes(node):
        if getattr(child, "lineno", line + 1) <= line <= (getattr(child, "end_lineno", None) or 0):
            if isinstance(child, ast.FunctionDef):
                return _join(owner, child.name)
            if isinstance(child, ast.ClassDef):
                return _owner(child, line, _join(owner, child.name))
            if isinstance(child, ast.Assign) and isinstance(child.targets[0], ast.Name):
                return _join(owner, child.targets[0].id)
    return owner


def _join(owner: str, name: str) -> str:
    return f"{owner}.{name}" if owner else name


def _order(label: str) -> tuple[int, list[int], str]:
    kind, number = label.split()
    parts = [int(part) for part in number.split(".")] if number[0].isdigit() else []
    return list(KINDS.values()).index(kind), parts, number


if __name__ == "__main__":
    PAGE.write_text(page())
    print(PAGE.relative_to(ROOT))
