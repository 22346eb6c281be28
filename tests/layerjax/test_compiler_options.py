"""Compiler options: which programs get them."""

import jax.numpy as jnp
import pytest

import layerjax as lj
from layerjax import compiling
from layerjax._devices import compile_for_devices

STACK = lj.Stack([lj.Medium(1.0, 0.9)])


@pytest.mark.parametrize(
    ("transport", "omitted"),
    [(lj.SingleScattering(), set()), (lj.RandomWalk(paths=16), compiling.SLOW_IN_LOOPS)],
)
def test_walks_are_compiled_without_what_slows_their_loops(monkeypatch, transport, omitted):
    taken, filter_jit = [], compiling.eqx.filter_jit

    def record(function, *, compiler_options=None):
        def program(*arguments):
            taken.append(set(compiler_options or ()))
            return function(*arguments)

        return program if compiler_options else filter_jit(function)

    monkeypatch.setattr(compiling, "OPTIONS", {"xla_cpu_use_fusion_emitters": False, "xla_cpu_enable_fast_math": False})
    monkeypatch.setattr(compiling, "compiler_options", lambda: dict(compiling.OPTIONS))
    monkeypatch.setattr(compiling.eqx, "filter_jit", record)
    compile_for_devices(lambda prepared: jnp.zeros(()))(lj.prepare(STACK, transport))
    assert taken[-1] == set(compiling.OPTIONS) - omitted
