"""Tests run in float64 unless they say otherwise, and share compiled programs across workers and runs."""

import gc
import os
from importlib import metadata
from pathlib import Path

# Compiles in a third of the time, to programs that run up to three times as long; XLA_FLAGS= tests what users run.
# Since 0.11 there is one way to fuse alone, and XLA stops at a flag that it does not know.
# Programs are compiled by one thread each: to split them costs a tenth more work, and every core has a worker.
FLAGS = ["--xla_backend_optimization_level=0", "--xla_cpu_parallel_codegen_split_count=1"]
if tuple(map(int, metadata.version("jaxlib").split(".")[:2])) < (0, 11):
    FLAGS.append("--xla_cpu_use_fusion_emitters=false")
os.environ.setdefault("XLA_FLAGS", " ".join(FLAGS))
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # threads of two workers wait for each other busily

import jax  # noqa: E402 (the flags must be set before)

pytest_plugins = ["tests.helpers.budget", "tests.helpers.compilations", "tests.helpers.memory"]

jax.config.update("jax_enable_x64", True)
if not jax.config.jax_compilation_cache_dir:  # JAX_COMPILATION_CACHE_DIR names another
    jax.config.update("jax_compilation_cache_dir", str(Path(__file__).parents[1] / ".cache" / "jax"))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


def pytest_collection_finish():
    """What all modules hold stays to the end: the garbage collector need not walk it for every program traced. Nor need
    it look often at programs, which stay as well: that takes a tenth of the time."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 20)
