"""Light that has met a Lambertian base under rough dielectrics: the closed form against the walk."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj

CASES = [
    (1.33, 0.2, False, 2, 0.9, False, 1.0),
    (1.33, 0.6, True, 1, 0.5, False, 1.5),
    (1.5, 0.05, False, 2, 0.5, False, 1.0),
    (1.5, 0.6, True, 2, 0.9, False, 4.0),
    (2.0, 0.05, True, 1, 0.9, False, 3.0),
    (2.0, 0.6, False, 1, 0.1, False, 1.0),
    (1 / 1.5, 0.05, True, 2, 0.1, False, 1.5),
    (1 / 1.5, 0.2, False, 1, 0.9, False, 1.0),
    (1.5, 0.05, False, 1, 0.9, True, 1.0),
    (1.5, 0.6, True, 2, 0.9, True, 3.5),
    (1 / 1.5, 0.2, False, 1, 0.5, True, 1.0),
]
"""Index, width, whether coats absorb, how many there are, albedo of the base, multiple scattering of facets, and the
millions of paths by which walks are exact enough: every index, width and kind of coat at least twice."""


def stacks(ior, alpha, absorbing, count, albedo):
    """One coat, or two, the lower one denser and smoother; over the base, and over black."""
    faces = [lj.Interface(ior, alpha), lj.Interface(1.2 * ior, 0.5 * alpha)][:count]
    media = [lj.Medium(depth, 0.0) for depth in (0.3, 0.15)][:count]
    layers = [part for pair in zip(faces, media, strict=True) for part in pair] if absorbing else faces
    return [lj.Stack(layers, lj.Lambertian(share)) for share in (albedo, 0.0)]


@pytest.mark.slow
def test_values():
    """What two coats reflect themselves is taken off both: 4 standard errors and 0.3 %."""
    wi = lj.direction(jnp.array([0.3, 1.0]), 0.0)
    wo = lj.direction(jnp.array([0.9, 0.5]), jnp.array([1.5, 2.2]))
    both = stacks(1.5, 0.3, True, 2, 0.9)
    white, black = (lj.evaluate(stack, wi, wo, lj.Statistical(facet_multiple_scattering=False)) for stack in both)
    (value, error), (rest, noise) = (
        lj.evaluate_with_error(stack, wi, wo, lj.RandomWalk(paths=1 << 16), key=jax.random.key(seed))
        for seed, stack in enumerate(both)
    )
    errors = np.hypot(error, noise)
    np.testing.assert_array_less(np.abs(white - black - (value - rest)), 4 * errors + 3e-3 * np.abs(value - rest))


@pytest.mark.slow
@pytest.mark.parametrize(
    "case", CASES, ids=lambda case: "-".join(f"{part:.3g}" for part in case[:5]) + ("multiple" if case[5] else "single")
)
def test_energies(case):
    """0.3 %, and 3 standard errors of the walks: 0.5 %, over a dark base 2 %. What the top reflects is not in them."""
    *kind, facet_multiple_scattering, millions = case
    wi = lj.direction(0.5, 0.0)
    transport = lj.Statistical(symmetric=False, facet_multiple_scattering=facet_multiple_scattering)
    walked, errors, found = [], [], []
    for seed, stack in enumerate(stacks(*kind)):
        found.append(float(lj.albedo(stack, wi, transport)[0][0]))
        if kind[3] == 1 and seed == 1:  # nothing comes from below one coat over black
            continue
        seen = lj.goniophotometer(
            stack,
            wi,
            key=jax.random.fold_in(jax.random.key(seed), CASES.index(case)),
            paths=round(millions * 1e6),
            polar=1,
            azimuth=1,
            orders=2,
            facet_multiple_scattering=facet_multiple_scattering,
            batch_size=1 << 15,
        )
        walked.append(float(seen.orders[0, 1, 0]))
        errors.append(float(seen.orders_error[0, 1, 0]))
    base, noise = walked[0] - sum(walked[1:]), np.hypot.reduce(errors)
    assert 3 * noise < (0.02 if kind[4] < 0.5 else 0.005) * base
    assert abs(found[0] - found[1] - base) < 3 * noise + 3e-3 * base
