"""What an instrument does not resolve: lobes narrower than its aperture, or than the steps of its scans."""

import math

import numpy as np

import layerjax as lj
from fits.data.measurements import Measurements
from fits.data.scans import in_plane, scans, signed_angle
from fits.optimise.result import Fit
from layerjax.mixture import stacks_by_name

# tangent of the half vector, over alpha, at which facets are half as many as along the normal
HALF = {"ggx": math.sqrt(math.sqrt(2.0) - 1.0), "vmf": math.sqrt(math.log(2.0))}
STEPS = 2.0  # of a scan, that a lobe has to hold within its full width at half maximum
NEAR = 10.0  # degrees from the mirror direction within which steps of a scan count


def instrument_limits(fit: Fit) -> dict[str, float]:
    """Fitted roughnesses whose lobe is narrower than what can be seen of it, and the least alpha that could be.

    A mirror lobe is as wide as its full width at half maximum, in the angle of the viewer. That has to be wider than
    the aperture of the `Instrument`, and hold two steps of the scan that is finest about the mirror direction.
    """
    instrument = fit.problem.instrument
    aperture = 0.0 if instrument is None else math.hypot(instrument.source_aperture, instrument.detector_aperture)
    resolved = max(aperture, STEPS * finest_step(fit.problem.data.used()))
    if not (resolved > 0.0 and isinstance(fit.problem.stack, lj.Stack | lj.Mixture)):
        return {}
    found = {}
    for name, distribution in _facets(fit.problem.stack).items():
        least = math.tan(math.radians(resolved / 4.0)) / HALF[distribution]
        if name in fit.values and fit.values[name] < least:
            found[name] = least
    return found


def finest_step(data: Measurements) -> float:
    """Degrees between neighbours about the mirror direction, of the scan that is finest there; 0 if none crosses it."""
    signed, plane = signed_angle(data), in_plane(data)
    steps = []
    for rows in scans(data):
        rows = rows[plane[rows]]
        angle, mirror = signed[rows], float(data.theta_i[rows[0]]) if rows.size else 0.0
        if rows.size < 2 or not angle.min() <= mirror <= angle.max():
            continue
        gaps = np.diff(angle)
        middle = 0.5 * (angle[1:] + angle[:-1])
        near = (np.abs(middle - mirror) <= NEAR) & (gaps > 0.0)
        if near.any():
            steps.append(float(np.min(gaps[near])))
    return min(steps, default=0.0)


def _facets(material: lj.Stack | lj.Mixture) -> dict[str, str]:
    """Names of roughnesses, and the distribution of each."""
    facets: dict[str, str] = {}
    for prefix, stack in stacks_by_name(material).items():
        for place, layer in enumerate(stack.layers):
            if isinstance(layer, lj.Interface):
                facets[f"{prefix}layers[{place}].alpha"] = layer.distribution
        if isinstance(stack.base, lj.Conductor):
            facets[f"{prefix}base.alpha"] = stack.base.distribution
    return facets
