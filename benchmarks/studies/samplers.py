"""Do samplers agree, and which is fast? emcee, also without independent proposals, and NUTS, on hard posteriors."""

import json
import time
from collections.abc import Callable, Container, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import arviz
import numpy as np

import fits
import layerjax as lj
from benchmarks.measuring import environment
from benchmarks.measuring.writing import DIRECTORY, environment_lines, figure, rounded, table, write
from benchmarks.studies.calibration.run import fitted_case
from benchmarks.suite import coated_haze

NAME = "samplers"
TRANSPORT = lj.AddingDoubling(nodes=6, modes=6)
NOISE, FLOOR = 0.05, 1e-6
ESS, QUICK, STEPS = 2000.0, 500.0, 100_000
MOST_ERRORS = 4.0
"""Standard errors by which quantiles may differ: of 15 differences that are due to chance, one in a thousand does."""
QUANTILES = (0.158655, 0.5, 0.841345)

PLAIN = "emcee"
SAMPLERS: dict[str, dict[str, Any]] = {
    PLAIN: {},
    "emcee, none independent": {"options": fits.SamplerOptions(independent=0.0)},
    "NUTS": {"sampler": "nuts"},
}

HEADER = ("posterior", "sampler", "ESS", "steps", "walkers", "accepted", "divergences", "seconds", "ESS/s",
          "difference", "in errors", "verdict")  # fmt: skip

TEXT = """\
# Do samplers agree, and which is fast?

{environment}
The first three posteriors are of a rough interface over haze over a diffuse base, all orders of scattering, by
`{transport}`: 140 measurements in the plane of incidence, simulated with noise of {noise:.0%}; the others are those
of [calibration](calibration.md). Each is sampled until every parameter has an effective sample size (ESS)
of {ess:,.0f}. *accepted* is the share of accepted proposals, *divergences* are those of NUTS after its warm-up;
*difference* is the largest of a quantile (16, 50 and 84 %) of any parameter from that of emcee, in standard deviations
of the parameter, and *in errors* the largest in Monte Carlo standard errors of both chains. Samplers agree where that
is below {most:g}: then a difference of {seen:.1g} standard deviations would have been seen.

{posteriors}
{rows}"""


@dataclass(frozen=True)
class Sampled:
    """One posterior by one sampler.

    quantiles: (3, P), those of `QUANTILES`, and their standard errors. deviations: (P,). effective: the least.
    """

    posterior: str
    sampler: str
    parameters: list[str]
    quantiles: list[list[float]]
    standard_errors: list[list[float]]
    deviations: list[float]
    effective: float
    steps: int
    walkers: int
    acceptance: float
    divergences: int
    converged: bool
    moves: str
    seconds: float


def _fitted(free: dict[str, Any], relative: float | fits.Free = NOISE, transport: lj.Transport = TRANSPORT) -> fits.Fit:
    """The fit of some parameters of the coated haze; the others are known. relative: the level of its noise."""
    data = fits.simulate(coated_haze.stack_of(), coated_haze.goniometer_slices(), transport, NOISE, FLOOR, seed=1)
    stack = coated_haze.stack_of(coated_haze.PARAMETERS | free)
    noise = fits.Noise(relative=relative, floor=FLOOR, use_sigma=False)
    return fits.fit(stack, data, transport=transport, noise=noise, starts=4, seed=0)


def five_parameters() -> fits.Fit:
    """Thickness and asymmetry are strongly correlated; the albedo is fixed"""
    return _fitted({name: free for name, free in coated_haze.FREE.items() if name != "albedo"})


def on_a_bound() -> fits.Fit:
    """The base is darker (0.3) than the box has it (0.35 to 1)"""
    free = {name: coated_haze.FREE[name] for name in ("ior", "alpha", "thickness")}
    return _fitted(free | {"base": fits.Free(0.5, 0.35, 1.0)})


def free_noise_level() -> fits.Fit:
    """The level of the noise is found with the stack"""
    free = {name: coated_haze.FREE[name] for name in ("ior", "alpha", "base")}
    return _fitted(free, fits.Free(0.1, 0.005, 1.0))


def banana() -> fits.Fit:
    """Little is known but a product of two parameters, a curved ridge that ends at the bounds"""
    return fitted_case("banana")


def degenerate() -> fits.Fit:
    """The data depend on the product of albedo and scale alone"""
    return fitted_case("degenerate")


def bounded() -> fits.Fit:
    """Roughness and albedo reach their bounds"""
    return fitted_case("bounded")


POSTERIORS: dict[str, Callable[[], fits.Fit]] = {
    "five parameters": five_parameters,
    "on a bound": on_a_bound,
    "free noise level": free_noise_level,
    "banana": banana,
    "degenerate": degenerate,
    "bounded": bounded,
}


def study(
    quick: bool = False,
    report: Callable[[str], None] = lambda line: None,
    directory: Path = DIRECTORY,
    resume: bool = False,
    posteriors: Mapping[str, Callable[[], fits.Fit]] = POSTERIORS,
    ess: float | None = None,
) -> tuple[str, tuple[Path, Path]]:
    """Run it, and write ``samplers.json`` and ``.md``; returns the markdown and the two paths.

    Args:
        quick: 500 effective samples: a look, no result to quote.
        resume: keep what the directory holds, and sample what it lacks. Each chain is written as it ends.
        posteriors: fits by name, made where they are needed.
        ess: required effective samples; 2,000 if None.

    Raises:
        ValueError: samples to resume that were drawn with other settings.
    """
    wanted = ess or (QUICK if quick else ESS)
    settings = rounded(
        {"transport": repr(TRANSPORT), "noise": NOISE, "ess": wanted, "parameters": coated_haze.PARAMETERS}
    )
    done = _stored(directory, settings, posteriors) if resume else []
    surroundings = environment.describe()
    text, paths = "", (Path(), Path())
    for name, made in posteriors.items():
        missing = [key for key in SAMPLERS if not any((one.posterior, one.sampler) == (name, key) for one in done)]
        fit = made() if missing else None
        for sampler in missing:
            assert fit is not None
            found = _sampled(name, sampler, fit, wanted)
            done.append(found)
            text, paths = _save(done, settings, surroundings, posteriors, directory)
            report(f"{name}, {sampler}: {found.effective:,.0f} effective samples, {found.seconds:.0f} s")
    return (text, paths) if text else _save(done, settings, surroundings, posteriors, directory)


def _sampled(name: str, sampler: str, fit: fits.Fit, ess: float) -> Sampled:
    began = time.perf_counter()
    posterior = fits.sample(fit, seed=1, ess=ess, max_steps=STEPS, allow_unconverged=True, **SAMPLERS[sampler])
    chain = posterior.chain[posterior.burn_in :]
    draws = chain.reshape(-1, len(posterior.names))
    return Sampled(
        posterior=name,
        sampler=sampler,
        parameters=list(posterior.names),
        quantiles=np.quantile(draws, QUANTILES, axis=0).tolist(),
        standard_errors=[
            [
                float(arviz.mcse(np.ascontiguousarray(one.T), method="quantile", prob=prob))
                for one in np.moveaxis(chain, 2, 0)
            ]
            for prob in QUANTILES
        ],
        deviations=draws.std(axis=0).tolist(),
        effective=float(posterior.effective_samples.min()),
        steps=posterior.chain.shape[0],
        walkers=posterior.chain.shape[1],
        acceptance=float(posterior.acceptance),
        divergences=posterior.divergences,
        converged=posterior.converged,
        moves=posterior.status,
        seconds=time.perf_counter() - began,
    )


def quantile_difference(one: Sampled, plain: Sampled) -> float:
    """The largest difference of a quantile, in standard deviations of `plain`."""
    return float(np.max(np.abs(np.subtract(one.quantiles, plain.quantiles)) / np.array(plain.deviations)))


def largest_error(one: Sampled) -> float:
    """The largest standard error of a quantile, in standard deviations."""
    return float(np.max(np.array(one.standard_errors) / np.array(one.deviations)))


def difference_in_errors(one: Sampled, plain: Sampled) -> float:
    """The largest difference of a quantile, in standard errors of both chains together."""
    errors = np.hypot(one.standard_errors, plain.standard_errors)
    return float(np.max(np.abs(np.subtract(one.quantiles, plain.quantiles)) / errors))


def _stored(directory: Path, settings: Mapping[str, Any], posteriors: Container[str]) -> list[Sampled]:
    """What the directory holds of these posteriors; ValueError if it was sampled with other settings."""
    path = directory / f"{NAME}.json"
    if not path.exists():
        return []
    content = json.loads(path.read_text())
    if content["settings"] != settings:
        raise ValueError(f"{path}: sampled with other settings, it cannot be resumed")
    return [Sampled(**record) for record in content["chains"] if record["posterior"] in posteriors]


def _save(
    done: list[Sampled],
    settings: Mapping[str, Any],
    surroundings: Mapping[str, Any],
    posteriors: Mapping[str, Callable[[], fits.Fit]],
    directory: Path,
) -> tuple[str, tuple[Path, Path]]:
    """Write all chains so far and what they say; returns the markdown and the paths."""
    order = [(name, sampler) for name in posteriors for sampler in SAMPLERS]
    done.sort(key=lambda one: order.index((one.posterior, one.sampler)))
    plain = {one.posterior: one for one in done if one.sampler == PLAIN}
    text = TEXT.format(
        environment=environment_lines(surroundings),
        transport=settings["transport"],
        noise=NOISE,
        ess=settings["ess"],
        most=MOST_ERRORS,
        seen=MOST_ERRORS * max((largest_error(one) for one in done), default=0.0) * 2**0.5,
        posteriors="".join(f"- *{name}*: {(made.__doc__ or '').strip()}.\n" for name, made in posteriors.items()),
        rows=table(
            HEADER,
            [_row(one, plain.get(one.posterior)) for one in done],
        ),
    )
    content = {
        "environment": dict(surroundings),
        "settings": dict(settings),
        "chains": [asdict(one) for one in done],
    }
    return text, write(NAME, content, text, directory)


def _row(one: Sampled, plain: Sampled | None) -> tuple[str, ...]:
    difference, in_errors, verdict = "-", "-", "-"
    if plain is not None and plain is not one:
        value = difference_in_errors(one, plain)
        difference, in_errors = figure(quantile_difference(one, plain), 2), figure(value, 2)
        verdict = "agree" if value < MOST_ERRORS else "**differ**"
    return (
        one.posterior,
        one.sampler,
        f"{one.effective:,.0f}",
        f"{one.steps:,}",
        str(one.walkers),
        f"{one.acceptance:.2f}",
        str(one.divergences) if one.sampler == "NUTS" else "-",
        figure(one.seconds),
        figure(one.effective / one.seconds),
        difference,
        in_errors,
        verdict,
    )
