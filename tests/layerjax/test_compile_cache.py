"""Programs that are kept for other processes: where, and that a process is left as it was."""

import os
import stat
from pathlib import Path

import jax
import pytest
from jax.experimental.compilation_cache.compilation_cache import reset_cache

import layerjax as lj
from layerjax.compiling import CACHE_DIRECTORY, CACHE_LEAST_TIME, LEAST_COMPILE, compile_cache, program_cache


@pytest.fixture
def without(monkeypatch, tmp_path):
    """A process that keeps nothing, of a user whose cache is empty."""
    before = {name: jax.config.values[name] for name in (CACHE_DIRECTORY, CACHE_LEAST_TIME)}
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    jax.config.update(CACHE_DIRECTORY, None)
    reset_cache()
    yield tmp_path
    for name, value in before.items():
        jax.config.update(name, value)
    reset_cache()


def test_programs_are_kept_within_the_block_alone(without, monkeypatch):
    monkeypatch.setattr("layerjax.compiling.LEAST_COMPILE", 0.0)
    least = jax.config.values[CACHE_LEAST_TIME]
    with program_cache():
        folder = Path(jax.config.values[CACHE_DIRECTORY])
        assert folder == Path(compile_cache())
        assert without in folder.parents
        jax.block_until_ready(jax.jit(lambda x: x * 3.5 + 1.25)(2.0))
        kept = list(folder.iterdir())
        assert kept
    assert jax.config.values[CACHE_DIRECTORY] is None
    assert jax.config.values[CACHE_LEAST_TIME] == least
    jax.block_until_ready(jax.jit(lambda x: x * 4.5 + 1.25)(2.0))
    assert list(folder.iterdir()) == kept


def test_a_user_who_keeps_programs_keeps_the_same_place(without, tmp_path):
    jax.config.update(CACHE_DIRECTORY, str(tmp_path / "own"))
    with program_cache():
        assert jax.config.values[CACHE_DIRECTORY] == str(tmp_path / "own")
    assert jax.config.values[CACHE_DIRECTORY] == str(tmp_path / "own")
    assert lj.keep_programs() == str(tmp_path / "own")


def test_a_notebook_keeps_its_programs(without):
    jax.block_until_ready(jax.jit(lambda x: x * 5.5 + 1.25)(2.0))  # what was compiled before does not matter
    folder = lj.keep_programs()
    assert without in Path(folder).parents
    assert jax.config.values[CACHE_DIRECTORY] == folder
    assert jax.config.values[CACHE_LEAST_TIME] == LEAST_COMPILE
    jax.config.update(CACHE_LEAST_TIME, 0.0)
    jax.block_until_ready(jax.jit(lambda x: x * 6.5 + 1.25)(2.0))
    assert list(Path(folder).iterdir())
    assert lj.keep_programs() == folder


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_home_that_may_not_be_written_to_keeps_nothing(without):
    without.chmod(stat.S_IRUSR | stat.S_IXUSR)
    with program_cache():
        assert jax.config.values[CACHE_DIRECTORY] is None


def test_a_home_that_is_a_file_keeps_nothing(without, monkeypatch):
    (without / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(without / "file"))
    with program_cache():
        assert jax.config.values[CACHE_DIRECTORY] is None
