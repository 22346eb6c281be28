"""What the README and the guides show works as printed."""

import re
import textwrap
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
GUIDES = ROOT / "docs" / "guides"
PAGES = [ROOT / "README.md", *sorted(GUIDES.glob("*.md"))]
LATER = {"which_stack", "renderers"}
"""Pages whose code begins with results of the commands above it, or needs an extra."""


LONG = {"evaluating-0", "own_data-0", "transports-0", "convergence-0"}
"""Blocks that compile for long: derivatives of media with an axis over a metal, a fit of 16 starts, and the solver
beside walks."""


NUMBER = re.compile(r"[-+]?\d+(?:\.\d*)?(?:e[-+]?\d+)?")


def blocks(language, pages=PAGES):
    """What stands in fences of that language, with the name of the page and which of its blocks it is."""
    found = [(page.stem, re.findall(rf"```{language}\n(.*?)```", page.read_text(), re.DOTALL)) for page in pages]
    named = [
        (f"{name}-{index}", block) for name, texts in found if name not in LATER for index, block in enumerate(texts)
    ]
    return [
        pytest.param(textwrap.dedent(block), id=of, marks=[pytest.mark.slow] * (language == "python" and of in LONG))
        for of, block in named
    ]


def printed(code):
    """What stands below a block as its output; "" where nothing does."""
    pages = (textwrap.dedent(page.read_text()) for page in PAGES)
    after = next(page.partition(f"```python\n{code}```\n\n```text\n")[2] for page in pages if code in page)
    return after.partition("```")[0]


@pytest.mark.parametrize("code", blocks("python"))
def test_python_blocks_run_and_print_what_the_page_says(code, monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    exec(compile(code, "page.md", "exec"), {"__name__": "page"})
    said, expected = capsys.readouterr().out, printed(code)
    if not expected:
        return
    words = ["".join(NUMBER.sub("#", one).split()) for one in (said, expected)]
    assert words[0] == words[1]
    for number, shown in zip(NUMBER.findall(said), NUMBER.findall(expected), strict=True):
        # in double precision walks and chains draw other numbers: of a hundredth, and a fourth of effective samples
        digits, rel = len(shown.partition("e")[0].partition(".")[2]), 0.02 if float(shown) < 100.0 else 0.25
        assert float(number) == pytest.approx(float(shown), rel=rel, abs=1.5 * 10.0**-digits), (said, expected)


@pytest.mark.parametrize("text", blocks("toml"))
def test_toml_blocks_are_stacks(text, tmp_path):
    from fits import read_problem

    assert tomllib.loads(text)
    path = tmp_path / "stack.toml"
    path.write_text(text)
    assert read_problem(path).stack.layers


def test_links_and_pictures_exist():
    for target in re.findall(r"\]\(([^)#]+)\)", README):
        assert (ROOT / target).exists(), target
