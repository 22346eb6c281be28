"""Seconds that a fresh process waits: each compiles all that it runs, unless it has a folder of cached programs."""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

import fits
import layerjax as lj
from benchmarks.suite import coated_haze

What = Literal["value", "jacobian", "gradient", "evaluate", "grad", "fit"]
Orders = Literal["all", "first"]
Program = Callable[[Array], Any]

ROOT = Path(__file__).parents[3]
NOISE = 0.05
WARM_CALLS = 20


@dataclass(frozen=True)
class Work:
    """What is run. nodes, modes, orders: of `AddingDoubling`. starts: of the fit. ess: effective samples after it."""

    nodes: int
    modes: int
    orders: Orders = "all"
    starts: int = 16
    ess: float = 1000.0

    @property
    def transport(self) -> lj.AddingDoubling:
        return lj.AddingDoubling(nodes=self.nodes, modes=self.modes, orders=self.orders)


def fresh(what: What, work: Work, cache: str = "") -> dict[str, float]:
    """Measure it in a process of its own. cache: folder in which it keeps programs; none if empty."""
    environment = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    program = f"import sys; from {__name__} import main; main(sys.argv[1:])"
    command = [sys.executable, "-c", program, what, json.dumps(asdict(work)), str(time.time()), cache]
    ended = subprocess.run(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    results: dict[str, float] = json.loads(ended.stdout)
    return results


def second(what: What, work: Work) -> float:
    """Seconds of the first call in a second process, which finds the programs of the one before."""
    with tempfile.TemporaryDirectory() as cache:
        return [fresh(what, work, cache)["seconds"] for _ in range(2)][1]


def programs(transport: lj.Transport) -> dict[str, Program]:
    """Compiled functions of the six parameters: all values; these and their Jacobian; a loss and its gradient."""
    geometry = coated_haze.goniometer_slices()

    def value(p: Array) -> Array:
        stack = coated_haze.stack_of(dict(zip(coated_haze.PARAMETERS, p, strict=True)))
        return lj.evaluate(stack, geometry.wi, geometry.wo, transport, side="reflection")[:, 0]

    def twice(p: Array) -> tuple[Array, Array]:
        values = value(p)
        return values, values

    jit = partial(jax.jit, compiler_options=lj.compiler_options() or None)
    return {
        "value": jit(value),
        "jacobian": jit(jax.jacfwd(twice, has_aux=True)),
        "gradient": jit(jax.value_and_grad(lambda p: (value(p) ** 2).sum())),
    }


def compiling(what: str, transport: lj.Transport) -> dict[str, float]:
    """Seconds to trace and compile one of the programs: of its first call less those of its second."""
    program = programs(transport)[what]
    p = jnp.array(list(coated_haze.PARAMETERS.values()))
    first, second = (_seconds(lambda: program(p)) for _ in range(2))
    return {"seconds": first - second}


def first_call(what: str) -> dict[str, float]:
    """Seconds of the first `evaluate`, or the first gradient of it, of the coat in the README, as it stands there; and
    of later calls, un-jitted. Of values also those of the next stack, which has one medium more, and by `Statistical`.
    """
    top, haze = lj.Interface(ior=1.5, alpha=0.1), lj.Medium(thickness=1.0, albedo=0.9, phase=lj.HenyeyGreenstein(0.6))
    coat = lj.Stack([top, haze], lj.Lambertian(albedo=[0.8, 0.4, 0.2]))
    dyed = lj.Stack([top, haze, lj.Medium(thickness=0.5, albedo=0.0)], coat.base)
    wi, wo = lj.direction(0.5, 0.0), lj.direction(np.array([0.3, 0.6]), 3.1)
    if what == "grad":
        gradient = jax.grad(lambda stack: lj.evaluate(stack, wi, wo).sum())
        return _first_and_later(lambda: gradient(coat))
    found = _first_and_later(lambda: lj.evaluate(coat, wi, wo))
    found["next"] = _seconds(lambda: lj.evaluate(dyed, wi, wo))
    return found | {"statistical": _first_and_later(lambda: lj.evaluate(coat, wi, wo, lj.Statistical()))["later"]}


def _first_and_later(work: Callable[[], Any]) -> dict[str, float]:
    """Seconds of the first call, and the median of later ones."""
    first, *later = [_seconds(work) for _ in range(1 + WARM_CALLS)]
    return {"seconds": first, "later": float(np.median(later))}


def fitting(work: Work, began: float) -> dict[str, float]:
    """Seconds of a fit since the process began, of another one after it, and of a posterior after that."""
    stack = coated_haze.stack_of(coated_haze.FREE)
    noise = fits.Noise(relative=NOISE, use_sigma=False)

    def fit(seed: int) -> fits.Fit:
        data = fits.simulate(
            coated_haze.stack_of(), coated_haze.goniometer_slices(), transport=work.transport, noise=NOISE, seed=seed
        )
        return fits.fit(stack, data, transport=work.transport, noise=noise, starts=work.starts, seed=seed)

    fit(0)
    cold = time.time() - began
    start = time.perf_counter()
    found = fit(1)
    warm = time.perf_counter() - start
    start = time.perf_counter()
    posterior = fits.sample(found, ess=work.ess)
    return {
        "cold": cold,
        "warm": warm,
        "sample": time.perf_counter() - start,
        "effective": float(np.min(posterior.effective_samples)),
        "evaluations": float(posterior.log_probability.size),
        "acceptance": posterior.acceptance,
    }


def _seconds(work: Callable[[], Any]) -> float:
    began = time.perf_counter()
    jax.block_until_ready(work())
    return time.perf_counter() - began


def main(arguments: list[str]) -> None:
    """Measure one thing, and print it: WHAT, the work as JSON, when the process was started, of the epoch, and the
    folder in which programs are cached, or nothing."""
    what, settings, began, cache = arguments
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_enable_compilation_cache", bool(cache))
    if cache:
        os.environ["XDG_CACHE_HOME"] = cache
        lj.keep_programs()
    work = Work(**json.loads(settings))
    if what == "fit":
        found = fitting(work, float(began))
    elif what in ("evaluate", "grad"):
        found = first_call(what)
    else:
        found = compiling(what, work.transport)
    print(json.dumps(found))
