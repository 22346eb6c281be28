"""How the commands use JAX."""

import os
import subprocess
import sys
from pathlib import Path

SLOW = """
import sys
import numpy as np
from fits.cli import commands
from fits.cli.setting import use_jax

assert "jax" not in sys.modules, "XLA reads what it may print as it is loaded"
use_jax()
import jax

image, kernel = np.random.rand(1, 1, 170, 170), np.random.rand(4, 1, 21, 21)
folded = lambda x: x + jax.lax.conv_general_dilated(image, kernel, (1, 1), "SAME").sum()
jax.jit(folded).lower(1.0).compile()
"""
"""A constant that XLA folds for more than a second, of which it raises the alarm that it raises of slow programs."""


def test_alarms_of_the_compiler_are_not_shown(tmp_path: Path) -> None:
    environment = {
        name: value for name, value in os.environ.items() if name not in ("TF_CPP_MIN_LOG_LEVEL", "XLA_FLAGS")
    }
    environment["JAX_COMPILATION_CACHE_DIR"] = str(tmp_path)  # nothing is compiled yet
    run = subprocess.run([sys.executable, "-c", SLOW], capture_output=True, text=True, env=environment, check=False)
    assert run.returncode == 0, run.stderr
    assert run.stderr == ""
