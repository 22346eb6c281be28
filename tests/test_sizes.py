"""A file is a chapter and a function a story: neither grows without end."""

import ast
from pathlib import Path

ROOT = Path(__file__).parents[1]
FILE, FUNCTION = 600, 80
"""Lines, at most."""


def test_files_and_functions_are_short():
    long = []
    for package in ("layerjax", "fits", "benchmarks", "tests", "tools", "examples"):
        for path in sorted((ROOT / package).rglob("*.py")):
            text, name = path.read_text(), path.relative_to(ROOT)
            if text.count("\n") > FILE:
                long.append(f"{name}: {text.count(chr(10))} lines")
            for node in ast.walk(ast.parse(text)):
                if isinstance(node, ast.FunctionDef) and (node.end_lineno or 0) - node.lineno >= FUNCTION:
                    long.append(f"{name}: {node.name} has {(node.end_lineno or 0) - node.lineno + 1} lines")
    assert not long, "\n".join(long)
