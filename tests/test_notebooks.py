"""Notebooks use public names alone, and run to their end without a warning."""

import ast
import re
from pathlib import Path
from types import ModuleType

import pytest

import fits
import layerjax

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "docs" / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.md"))
OTHERS = {"jax", "jax.numpy", "matplotlib.pyplot", "numpy", "pathlib", "tempfile", "time"}
PUBLIC = {
    "fits": set(fits.__all__),
    "layerjax": {name for name, what in vars(layerjax).items() if name[0] != "_" and not isinstance(what, ModuleType)},
}
CELL = re.compile(r"^```\{code-cell\} python3\n(.*?)^```$", re.MULTILINE | re.DOTALL)
SECONDS = 600  # of a cell, on a machine that is busy with other tests


def names(path):
    return path.stem


def test_there_are_notebooks():
    assert len(NOTEBOOKS) >= 6


@pytest.mark.parametrize("path", NOTEBOOKS, ids=names)
def test_notebooks_use_public_names_alone(path):
    """Modules by their usual names, and of the packages what their `__init__` offers."""
    text = path.read_text()
    assert text.startswith("---\njupytext:")
    cells = CELL.findall(text)
    assert len(cells) == text.count("```{code-cell}")
    tree = ast.parse("\n".join(cells))
    called = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            called |= {alias.asname or alias.name: alias.name for alias in node.names}
        assert not isinstance(node, ast.ImportFrom) or node.module in OTHERS
    assert set(called.values()) <= OTHERS | set(PUBLIC)
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            package = called.get(node.value.id)
            assert package not in PUBLIC or node.attr in PUBLIC[package], node.attr


@pytest.mark.parametrize("path", NOTEBOOKS, ids=names)
def test_links_of_notebooks_exist(path):
    for target in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", CELL.sub("", path.read_text())):
        assert (path.parent / target).exists(), target


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=names)
# of the client's own connection to the kernel, which stays on this machine
@pytest.mark.filterwarnings("default")
def test_notebooks_run_without_warnings(path):
    """In their folder, as a reader runs them; words on stderr are warnings, and every cell ends."""
    client, jupytext = pytest.importorskip("nbclient"), pytest.importorskip("jupytext")
    notebook = jupytext.read(path)
    where = {"metadata": {"path": str(FOLDER)}}
    client.NotebookClient(notebook, timeout=SECONDS, kernel_name="python3", resources=where).execute()
    for cell in notebook.cells:
        for output in cell.get("outputs", []):
            assert output.get("name") != "stderr", f"{cell.source}\n{output.text}"
    assert any("image/png" in output.get("data", {}) for cell in notebook.cells for output in cell.get("outputs", []))
