"""A slab by eigenvectors, against the exponential of its equations and doubling in extended precision."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import layerjax as lj
from layerjax.transport.adding_doubling import media
from layerjax.transport.adding_doubling.grid import make_grid
from layerjax.transport.adding_doubling.moments import terms
from layerjax.transport.adding_doubling.slab import slab

Long = np.longdouble
NODES = 6
value = jax.jit(slab)
change = jax.jit(lambda primals, tangents: jax.jvp(slab, primals, tangents))


def inverse(matrix):
    n = len(matrix)
    rows = np.concatenate([matrix, np.eye(n, dtype=Long)], axis=1)
    for k in range(n):
        pivot = k + np.argmax(np.abs(rows[k:, k]))
        rows[[k, pivot]] = rows[[pivot, k]]
        rows[k] /= rows[k, k]
        others = np.arange(n) != k
        rows[others] -= np.outer(rows[others, k], rows[k])
    return rows[:, n:]


def truth(p, q, half):
    """R and T by the Taylor series of a thin slab's exponential, doubled: numpy's extended precision throughout."""
    p, q = np.asarray(p).astype(Long), np.asarray(q).astype(Long)
    n = len(p)
    a, b = (p + q) / 2, (p - q) / 2
    generator = 2 * Long(half) * np.block([[-a, b], [-b, a]])
    steps = max(0, int(np.ceil(np.log2(float(np.abs(generator).sum(axis=0).max()) + 1e-300))) + 2)
    thin, term = np.eye(2 * n, dtype=Long), np.eye(2 * n, dtype=Long)
    for order in range(1, 25):
        term = term @ generator / Long(2) ** steps / order
        thin = thin + term
    into = -inverse(thin[n:, n:]) @ thin[n:, :n]
    reflect, transmit = into, thin[:n, :n] + thin[:n, n:] @ into
    for _ in range(steps):
        again = inverse(np.eye(n, dtype=Long) - reflect @ reflect) @ transmit
        reflect, transmit = reflect + transmit @ reflect @ again, transmit @ again
    return reflect, transmit


def equations(albedo, g, modes=2):
    """P and Q of a Henyey-Greenstein medium, (modes, n, n)."""
    region = make_grid([1.0], (0,), NODES, jnp.float64).regions[0]
    kernel = media.kernel_modes(lj.HenyeyGreenstein(g), False, region, modes, terms(NODES, False))
    rate = jnp.sqrt(2.0 * jnp.pi * kernel.solid / kernel.cosine)
    back, onward = (albedo * rate[:, None] * part * rate for part in kernel.plain)
    area = kernel.area if kernel.ballistic is None else kernel.area - albedo * kernel.ballistic[0]
    removed = jnp.diag(area / kernel.cosine)
    return np.asarray(removed - onward + back), np.asarray(removed - onward - back)


MEDIA = [(0.0, 0.5), (0.3, -0.9), (0.999999, 0.5), (1.0, 0.0), (1.0, 0.999)]


@pytest.mark.parametrize("thickness", [0.0, 1e-8, 1e-3, 1.0, 30.0, 1e4])
def test_values(thickness):
    for albedo, g in MEDIA:
        p, q = equations(albedo, g)
        found = value(p, q, jnp.full(2, 0.5 * thickness))
        for mode in range(2):
            expected = truth(p[mode], q[mode], 0.5 * thickness)
            for part, exact in zip(found, expected, strict=True):
                # eigenvalues are right to rounding times the largest; near 0 their roots enter with the thickness
                np.testing.assert_allclose(part[mode], exact.astype(float), rtol=0, atol=1e-14 * (1 + thickness))


@pytest.mark.parametrize("thickness", [1e-8, 1e-3, 0.1, 1.0, 30.0])
def test_derivatives(thickness):
    """By differences of extended precision, of an error of 1e-9 of the slope; both of P, of Q and of the thickness."""
    random = np.random.default_rng(0)
    half = 0.5 * thickness
    for albedo, g in MEDIA[1:]:
        p, q = (part[0] for part in equations(albedo, g, 1))
        dp = random.normal(size=p.shape)
        dp, zero = 1e-2 * (dp + dp.T), np.zeros_like(p)
        for tangent in ((dp, zero, 0.0), (zero, dp @ dp.T, 0.0), (zero, zero, 1.0)):
            step = 1e-4 * (half if tangent[2] else 1.0)
            _, slopes = change((p, q, jnp.asarray(half)), tuple(map(jnp.asarray, tangent)))

            def moved(times, p=p, q=q, tangent=tangent, step=step):
                long = [np.asarray(part).astype(Long) for part in (*tangent, p, q, half)]
                return truth(*(base + Long(times * step) * rate for rate, base in zip(long[:3], long[3:], strict=True)))

            # one-sided, of the second order: Q may be singular, and lossless media cannot scatter more
            ends = [moved(times) for times in (0, 1, 2)]
            expected = [(-3 * a + 4 * b - c) / (2 * Long(step)) for a, b, c in zip(*ends, strict=True)]
            size = max(float(np.abs(part).max()) for part in expected)
            for found, exact in zip(slopes, expected, strict=True):
                # the rounding of a difference, 1e-19 / step, beside its own error
                np.testing.assert_allclose(
                    found, exact.astype(float), rtol=0, atol=1e-5 * size + 1e-18 / min(step, 1e-4)
                )


def test_nothing_is_lost_without_absorption():
    """Down to the last mode that fades: R + T of flux is 1 for every direction."""
    for thickness in (1e-8, 1.0, 1e4):
        p, q = equations(1.0, 0.5)
        region = make_grid([1.0], (0,), NODES, jnp.float64).regions[0]
        root = np.sqrt(np.asarray(region.solid * region.cosine))
        reflect, transmit = value(p, q, jnp.full(2, 0.5 * thickness))
        np.testing.assert_allclose(root @ (reflect + transmit)[0] / root, 1.0, atol=1e-9)


@pytest.mark.slow
def test_gradients_are_finite_at_the_ends():
    p, q = equations(1.0, 0.0)

    def total(p, q, half):
        return sum(jnp.sum(part) for part in slab(p, q, half))

    for half in (0.0, 1e-12, 0.5, 5e3):
        for slope in jax.jit(jax.grad(total, (0, 1, 2)))(p, q, jnp.full(2, half)):
            assert np.isfinite(slope).all()


@pytest.mark.slow
def test_decomposed_together_as_on_a_gpu(monkeypatch):
    """Slabs of several media side by side, and their derivatives by all: to the rounding of eigenvalues."""
    modes = [equations(albedo, g, 1) for albedo, g in MEDIA]
    p, q = (jnp.stack([jnp.asarray(both[k][0]) for both in modes]) for k in range(2))
    primals, tangents = (p, q, jnp.linspace(0.0, 2.0, len(MEDIA))), (0.1 * p, 0.2 * q, jnp.ones(len(MEDIA)))

    def program():
        return jax.vmap(lambda primals, tangents: jax.jvp(slab, primals, tangents))

    one_by_one = jax.jit(program())(primals, tangents)
    assert "custom_vmap" in str(jax.make_jaxpr(slab)(*primals))
    monkeypatch.setattr("layerjax.transport.adding_doubling.slab.chunk_factor", lambda: 2)
    assert "custom_vmap" not in str(jax.make_jaxpr(lambda *given: slab(*given))(*primals))
    together = jax.jit(program())(primals, tangents)
    for found, expected in zip(jax.tree.leaves(together), jax.tree.leaves(one_by_one), strict=True):
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * np.abs(expected).max())


FIBERS = lj.SGGX("fiber", 0.4, (0.5, 0.3, 0.8))


@eqx.filter_jit
def layer(medium, doubled):
    region = make_grid([1.0], (0,), 4, medium.thickness.dtype).regions[0]
    if medium.phase.is_axisymmetric:
        kernel = media.kernel_modes(medium.phase, False, region, 4, terms(4, False))
    else:
        kernel = media.kernel_ordinates(medium.phase, False, region, 8)
    return media.medium_layer(medium, kernel, doubled)


def assert_close(one, other, atol):
    for side in ("reflect_top", "reflect_bottom", "transmit_down", "transmit_up"):
        np.testing.assert_allclose(getattr(one, side).rest, getattr(other, side).rest, rtol=0, atol=atol)


@pytest.mark.slow
@pytest.mark.parametrize("thickness", [1e-8, 1e-3, 1.0, 1e4])
@pytest.mark.parametrize("phase", [lj.HenyeyGreenstein(-0.9), lj.HenyeyGreenstein(0.999), FIBERS])
def test_eigenvectors_and_doublings_agree(phase, thickness):
    """From no absorption to much; doubling begins with a slab that is right to the square of its thickness: 1e-7."""
    for albedo in (0.3, 0.999999, 1.0):
        medium = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), lj.Medium(thickness, albedo, phase))
        assert_close(layer(medium, False), layer(medium, True), 1e-7)


def test_single_precision_agrees_with_double():
    """Doublings with eigenvectors: 2e-6 is 17 times the rounding of 1 in single precision, after 15 doublings."""
    fibers = [
        jax.tree.map(lambda x, dtype=dtype: jnp.asarray(x, dtype), lj.Medium(2.0, 0.95, FIBERS))
        for dtype in (jnp.float32, jnp.float64)
    ]
    assert_close(layer(fibers[0], True), layer(fibers[1], False), 2e-6)
