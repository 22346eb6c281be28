"""The site: python -m sphinx -W --keep-going docs docs/_build, after pip install -e ".[docs]". It needs no network."""

import sys
from importlib import import_module
from inspect import getsourcefile, unwrap
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))  # tools, and the packages of this tree before installed ones

import layerjax  # noqa: E402
from tools import site  # noqa: E402

project = "layerjax"
author = "The layerjax developers"
copyright = author
version = release = layerjax.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.linkcode",
    "sphinx.ext.mathjax",
    "sphinx-mathjax-offline",
    "sphinx_copybutton",
    "tools.site",
]
exclude_patterns = ["_build", "_cache", "jupyter_execute", "**.ipynb_checkpoints"]
default_role = "py:obj"  # docstrings name things in single quotes

# notebooks run at build, and again only where their content has changed; -D nb_execution_mode=off skips that
nb_execution_mode = "cache"
nb_execution_cache_path = str(Path(__file__).parent / "_cache")
nb_execution_timeout = 600
nb_execution_raise_on_error = True
nb_execution_excludepatterns: list[str] = []

myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence", "deflist"]
myst_heading_anchors = 3
myst_url_schemes = {"http": None, "https": None, "mailto": None, "source": site.SCHEME}

autodoc_member_order = "bysource"
autodoc_typehints = "none"  # shapes and units stand in the docstrings
autodoc_preserve_defaults = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_attr_annotations = False

html_theme = "furo"
html_title = f"layerjax {version}"
html_static_path = ["_static"]
html_css_files = ["wide.css"]
html_show_sourcelink = False
copybutton_exclude = ".linenos, .gp, .go"

linkcheck_ignore = [r".*source/.*\.html.*"]


def linkcode_resolve(domain: str, info: dict[str, str]) -> str | None:
    """The line of the source page that a name of the API stands on; all of its pages lie in docs/api."""
    if domain != "py" or not info["module"]:
        return None
    found = import_module(info["module"])
    for part in info["fullname"].split("."):
        found = getattr(found, part, None)
    if not callable(found):
        return None
    found = unwrap(found)
    try:
        path = Path(getsourcefile(found) or "").resolve()
    except TypeError:
        return None
    if not path.is_relative_to(ROOT):
        return None
    return site.source_of(path, "api/index", f"{path.stem}:{found.__qualname__}")
