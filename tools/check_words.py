"""List words in names, messages, docstrings and comments, and on pages, that the field has better ones for.

`python -m tools.check_words [FOLDER_OR_FILE ...]` prints file:line: word -> the field's word, and the count by room.

A word is in the tables if it can hardly be right, alone or with its neighbours. Words that also have a plain or a
technical sense are not: `read`, a gerund as in "reading a file", `share` of energy, `alone` and `again` as adverbs,
`shape` and `behind` in space, `size`, `nodes`, `table`, `score`. Local names are checked by `NAMES` only, and `of` as a
parameter only, as it is a constructor in `Totals.of`. This file, which has all of these words, is skipped.
"""

import ast
import io
import re
import sys
import tokenize
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

SENTENCES = {
    r"readings|(?:a|the|each|one|new|every|per|no|of|single|another) reading": "measurement, data point",
    r"fore(?:tell\w*|told|see\w*|saw|sight)|unseen": "predict, held-out",
    r"le(?:ft|av(?:e|es|ing)) (?:\w+ )?out": "hold out (data), omit, skip",
    r"bands?(?! of (?:wavelength|light))": "interval",
    r"(?:falls?|stands?|how far) (?:\w+ )?behind|behind the best": "elpd difference",
    r"worth": "effective sample size",
    r"pareto shape": "Pareto k",
    r"share[sd]? (?:\w+ )?errors?|errors? (?:that )?\w+ share": "model discrepancy",
    r"model lacks?|lack of (?:it|the (?:model|stack))": "model discrepancy",
    r"growth": "grazing exponent",
    r"noise alone": "independent noise",
    r"leaves? (?:\w+ ){0,4}open|loose(?:ly)?|unresolved|(?:hardly|barely) seen": "unidentified, weakly identified",
    r"without influence": "insensitive",
    r"trad(?:es?|ing) (?:with|against)": "correlated with",
    r"(?:distinct|different|other|lower|better|best|several) ends|others as good": "local minimum",
    r"ends? of (?:a |the |all )?starts?": "outcome of a start",
    r"out of steps|this minimum": "maximum steps reached, converged",
    r"rac(?:e|es|ed|ing)|promis(?:e|es|ed|ing)": "multi-start, predicted decrease",
    r"alike|do(?:es)? not tell|cannot tell": "statistically indistinguishable, equal, similar",
    r"told|telling|tells? (?:\w+ )*apart": "say, distinguish, decide",
    r"asked": "requested",
    r"lean(?:s|ed|ing)?": "tilt",
    r"straight(?! lines?)": "ballistic, collimated",
    r"(?:given|turned|kept|keep) back|own side": "in-scattering, reflected",
    r"seen share|retained|reflects in all": "visible, directional albedo",
    r"goes on|had in hand": "resume, checkpoint",
}
"""Words in messages, docstrings and comments, and the field's word."""

NAMES = {
    r"readings?|foretell|foretold|foresee|foreseen|foresight|unseen": "measurements, predict, held_out",
    r"bands?|banded": "interval",
    r"worth|heights|leaps|alike|lacks?|leaning|leans|loose|unresolved": "see the glossary",
    r"told|telling|tell|asked|ask|posed|promise|race|pull|hear|heard|fly|straight": "a verb or a noun of the field",
}
"""Parts of names, between underscores or capitals."""

WHOLE_NAMES = {
    r"found|seen|kept|given|there|beside|beyond|apart|within|behind|between|alone|every|own|here|again|look": (
        "a verb or a noun of the field"
    ),
}
"""Whole names of functions, classes, attributes and parameters; local ones of a few lines may be short."""

FRAGMENT = r"\s*(?:Of|By|From|With|In units of|To)\b(?!.*: )"
"""The beginning of a docstring that is no sentence or noun of its own."""

Finding = tuple[int, str, str]


def findings(path: Path) -> Iterator[Finding]:
    """Line, word and the field's word."""
    text = path.read_text()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value:
            yield from _in_sentence(node.lineno, node.value)
        elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            if re.match(FRAGMENT, node.value.value):
                yield node.lineno, node.value.value.split("\n")[0][:40], "a sentence that stands alone"
        else:
            yield from _in_names(node)
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            yield from _in_sentence(token.start[0], token.string)


def on_page(path: Path) -> Iterator[Finding]:
    """The same of a page in Markdown; what stands in backticks is code."""
    yield from _in_sentence(1, re.sub(r"```.*?```|`[^`]*`", _blank, path.read_text(), flags=re.DOTALL))


def _blank(code: re.Match[str]) -> str:
    return re.sub(r"[^\n]", "_", code.group())


def _in_sentence(line: int, sentence: str) -> Iterator[Finding]:
    for expression, better in SENTENCES.items():
        for match in re.finditer(rf"\b(?:{expression})\b", re.sub(r"\s", " ", sentence), re.IGNORECASE):
            yield line + sentence[: match.start()].count("\n"), match.group(), better


def _in_names(node: ast.AST) -> Iterator[Finding]:
    match node:
        case ast.arg(arg="of"):
            yield node.lineno, "of", "a noun of the field"
            return
        case ast.FunctionDef(name=name) | ast.ClassDef(name=name) | ast.arg(arg=name):
            tables = {**NAMES, **WHOLE_NAMES}
        case ast.AnnAssign(target=ast.Name(id=name)) | ast.Attribute(attr=name, ctx=ast.Store()):
            tables = {**NAMES, **WHOLE_NAMES}
        case ast.Name(id=name, ctx=ast.Store()):
            tables = NAMES
        case _:
            return
    parts = [part.lower() for part in re.findall(r"[A-Z]?[a-z]+|[A-Z]+", name)]
    for expression, better in tables.items():
        words = [name.strip("_").lower()] if expression in WHOLE_NAMES else parts
        if any(re.fullmatch(expression, word) for word in words):
            yield getattr(node, "lineno", 0), name, better


def main(folders: list[str]) -> None:
    """Print what is listed in these folders and files."""
    count: Counter[str] = Counter()
    for folder in map(Path, folders):
        files = [path for kind in ("*.py", "*.md") for path in folder.rglob(kind)] if folder.is_dir() else [folder]
        for path in sorted(path for path in files if path.resolve() != Path(__file__).resolve()):
            for line, word, better in sorted(set(on_page(path) if path.suffix == ".md" else findings(path))):
                print(f"{path}:{line}: {word} -> {better}")
                count["/".join(path.parts[:2])] += 1
    for room, number in count.most_common():
        print(f"{number:6d}  {room}")
    print(f"{count.total():6d}  in all")


if __name__ == "__main__":
    main(sys.argv[1:] or ["fits"])
