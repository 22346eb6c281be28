"""Mitsuba 3 (`llvm_ad_rgb`) and Dr.Jit, on the same directions and parameters; needs the `peers` extra and an LLVM."""

import ctypes.util
import importlib.util
import os
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.peers.plain_numpy import Functions, model_of
from benchmarks.suite.scenes import CONDUCTOR, Scene

VARIANT = "llvm_ad_rgb"
LIBRARIES = ("LLVM-19", "LLVM-18", "LLVM-17", "LLVM-16", "LLVM")
PROBE = f"import mitsuba as mi; mi.set_variant('{VARIANT}'); import drjit as dr; dr.eval(dr.minimum(mi.Float(1, 2), 1))"


def why_not() -> str | None:
    """Why the peers cannot run here; None if they can. Tried in another process: an unfit LLVM aborts its own."""
    if importlib.util.find_spec("mitsuba") is None:
        return "mitsuba is not installed (pip install '.[peers]')"
    if "DRJIT_LIBLLVM_PATH" not in os.environ:
        found = next(filter(None, map(ctypes.util.find_library, LIBRARIES)), None)
        if found is not None:
            os.environ["DRJIT_LIBLLVM_PATH"] = found
    outcome = subprocess.run([sys.executable, "-c", PROBE], capture_output=True, text=True, timeout=120, check=False)
    if outcome.returncode == 0:
        return None
    last = (outcome.stderr or outcome.stdout).strip().splitlines()[-1:] or ["no message"]
    return f"{VARIANT} does not start (exit code {outcome.returncode}: {last[0]}); set DRJIT_LIBLLVM_PATH to LLVM >= 16"


def of(scene: Scene, wi: NDArray[Any], wo: NDArray[Any], target: NDArray[Any], double: bool = False) -> "DrJit":
    """The peer for this scene: Mitsuba where it has the model in that precision, else the formulas in Dr.Jit."""
    kind = Mitsuba if scene is CONDUCTOR and not double else DrJit
    return kind(scene, wi, wo, target, double)


class DrJit:
    """The formulas of `plain_numpy` in Dr.Jit, the directions (N, 3) already in its memory.

    `value()` computes the BSDF; `gradient()` the mean squared difference from `target` (N, 3) and its derivatives in
    all parameters, as one would write it down. Dr.Jit then runs one kernel a parameter, each through the whole model;
    `tuned_gradient()` spreads every parameter over the lanes first, whose derivatives Dr.Jit adds up in one kernel.
    """

    name = "Dr.Jit"

    def __init__(
        self, scene: Scene, wi: NDArray[Any], wo: NDArray[Any], target: NDArray[Any], double: bool = False
    ) -> None:
        import drjit as dr
        import drjit.llvm.ad as library

        self.dr, self.scene, self.count = dr, scene, len(wi)
        self.float: Any = library.Float64 if double else library.Float
        self.terms = 13 if double else 7
        self.lanes = dr.zeros(library.UInt32, self.count)
        columns = [[self.float(np.ascontiguousarray(a[:, c])) for c in range(3)] for a in (wi, wo, target)]
        self.wi, self.wo, self.target = columns
        dr.eval(columns, self.lanes)
        self.parameters = [
            self.float(float(number)) for value in scene.parameters.values() for number in np.ravel(value)
        ]
        dr.make_opaque(self.parameters)
        self.model = model_of(scene.parameters)
        self.functions = Functions(dr.exp, dr.sqrt, dr.abs, dr.minimum, dr.select, self._one_minus_exp)

    def value(self) -> list[Any]:
        """The BSDF, one array a channel."""
        values = self._evaluate(self.parameters)
        self.dr.eval(values)
        self.dr.sync_thread()
        return values

    def gradient(self) -> tuple[Any, list[Any]]:
        """Loss and derivatives, in the order of the scene's parameters."""

        def loss(parameters: list[Any]) -> Any:
            values = self._evaluate(parameters)
            return sum(self.dr.mean((v - t) ** 2) for v, t in zip(values, self.target, strict=True))

        return self._differentiate(loss, self.parameters)

    def tuned_gradient(self) -> tuple[Any, list[Any]]:
        """Loss and derivatives, in the order of the scene's parameters, in a single kernel."""

        def loss(parameters: list[Any]) -> Any:
            spread = [self.dr.gather(self.float, parameter, self.lanes) for parameter in parameters]
            values = DrJit._evaluate(self, spread)
            squares = sum((v - t) ** 2 for v, t in zip(values, self.target, strict=True))
            return self.dr.sum(squares, mode="symbolic") / self.count

        return self._differentiate(loss, self.scalars())

    def scalars(self) -> list[Any]:
        """The parameters, each a number on its own."""
        return self.parameters

    def _evaluate(self, parameters: list[Any]) -> list[Any]:
        left = iter(parameters)
        named = {
            name: [next(left) for _ in value] if np.ndim(value) else next(left)
            for name, value in self.scene.parameters.items()
        }
        return self.model(named, self.wi, self.wo, self.scene.side, self.functions)

    def _differentiate(self, loss: Callable[[list[Any]], Any], parameters: list[Any]) -> tuple[Any, list[Any]]:
        dr = self.dr
        for parameter in parameters:
            dr.clear_grad(parameter)
            dr.enable_grad(parameter)
        value = loss(parameters)
        dr.backward(value)
        slopes = [dr.grad(parameter) for parameter in parameters]
        dr.eval(value, slopes)
        dr.sync_thread()
        for parameter in parameters:
            dr.disable_grad(parameter)
        return value, slopes

    def _one_minus_exp(self, x: Any) -> Any:
        # Dr.Jit has no expm1; the Taylor series leaves an error below rounding for x < 0.3
        series = self.float(1.0)
        for n in range(self.terms, 1, -1):
            series = 1.0 - (x * (1.0 / n)) * series
        return self.dr.select(x < 0.3, x * series, 1.0 - self.dr.exp(-x))


class Mitsuba(DrJit):
    """Mitsuba's `roughconductor`; its tuned gradient is that of the formulas in Dr.Jit."""

    name = "Mitsuba"

    def __init__(
        self, scene: Scene, wi: NDArray[Any], wo: NDArray[Any], target: NDArray[Any], double: bool = False
    ) -> None:
        import mitsuba as mi

        mi.set_variant(VARIANT)
        super().__init__(scene, wi, wo, target, double)
        self._scalars = self.parameters
        rgb = {name: {"type": "rgb", "value": list(scene.parameters[name])} for name in ("ior", "k")}
        alpha = scene.parameters["alpha"]
        plugin = {"type": "roughconductor", "distribution": "ggx", "eta": rgb["ior"], "k": rgb["k"], "alpha": alpha}
        self.bsdf = mi.load_dict(plugin)
        self.held = mi.traverse(self.bsdf)
        self.keys = ("eta.value", "k.value", "alpha.value")
        self.parameters = [self.held[key] for key in self.keys]
        self.interaction = self.dr.zeros(mi.SurfaceInteraction3f, self.count)
        self.interaction.wi, self.outgoing = mi.Vector3f(*self.wi), mi.Vector3f(*self.wo)
        self.dr.eval(self.interaction, self.outgoing)
        self.context = mi.BSDFContext()

    def scalars(self) -> list[Any]:
        return self._scalars

    def _evaluate(self, parameters: list[Any]) -> list[Any]:
        for key, parameter in zip(self.keys, parameters, strict=True):
            self.held[key] = parameter
        self.held.update()
        value = self.bsdf.eval(self.context, self.interaction, self.outgoing) / self.outgoing.z  # it holds the cosine
        return [value.x, value.y, value.z]
