"""Tests run in float64 unless they say otherwise, and share compiled programs across workers and runs."""

import os
from pathlib import Path

# compiles in a third of the time to programs that run up to three times as long; XLA_FLAGS= tests what users run
os.environ.setdefault("XLA_FLAGS", "--xla_cpu_use_fusion_emitters=false --xla_backend_optimization_level=0")

import jax

pytest_plugins = ["tests.helpers.compilations"]

jax.config.update("jax_enable_x64", True)
if not jax.config.jax_compilation_cache_dir:  # JAX_COMPILATION_CACHE_DIR names another
    jax.config.update("jax_compilation_cache_dir", str(Path(__file__).parents[1] / ".cache" / "jax"))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
