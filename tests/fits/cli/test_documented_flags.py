"""Flags that messages name and commands that pages show are those of the parser."""

import ast
import re
import shlex

import pytest

from fits.cli.arguments import COMMANDS, build_parser
from tests.helpers.places import ROOT

EVERY = [name for one in COMMANDS.values() for name in (*one.particular, *one.shared.split())]
OTHERS = {"--help", "--version", "--traceback", "--nthreads"}  # those of the parser itself, and of `dask worker`
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), *sorted((ROOT / "docs" / "guides").glob("*.md"))]
SHOWN = [
    (page, line)
    for page in PAGES
    for block in re.findall(r"```(?:\{code-block\} )?sh\n(.*?)```", page.read_text().replace("\\\n", " "), re.DOTALL)
    for line in re.split(r"\n|&&", block)
    if line.split()[:1] == ["layerjax"]
]


def test_messages_name_flags_that_exist_and_these_are_few():
    assert sum(name.startswith("--") for name in EVERY) < 91
    unknown = [
        (flag, path.name)
        for path in sorted((ROOT / "fits").rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
        for flag in re.findall(r"(?<![\w-])--[a-z][a-z-]+", node.value)
        if flag not in OTHERS.union(EVERY)
    ]
    assert not unknown


@pytest.mark.parametrize(("page", "line"), [pytest.param(*one, id=f"{one[0].stem}-{k}") for k, one in enumerate(SHOWN)])
def test_commands_of_pages_are_understood(page, line):
    words = shlex.split(line, comments=True)[1:]
    build_parser().parse_args(["rgl" if word == "FORMAT" else word for word in words])
