"""Where the files that tests read lie."""

from pathlib import Path

ROOT = Path(__file__).parents[2]
STORED = ROOT / "tests" / "data"
EXAMPLES = ROOT / "examples"
COATINGS = EXAMPLES / "arizona_black_coatings"
