"""Totals: slabs in closed form, through spheres by the sum over all ways of light, beside inverse adding-doubling."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import expn

import fits
import layerjax as lj
from fits import Free, Joint, LogUniform, Problem, Sphere, Spheres, Totals, fit, read_slab, simulate, slices
from fits.data.spheres import Shares
from tests.helpers.refusals import refuses

SINGLE = lj.SingleScattering()
ANGLES = np.array([0.0, 60.0])
COSINE = np.cos(np.radians(ANGLES))
DEPTH = Free(0.5, 0.01, 5.0)
PAINT = lj.Stack([], lj.Lambertian(Free(0.5, 0.0, 1.0)))
HALF = Totals.of(reflectance=0.5)
FRONT = Sphere(100.0, 30.0, 15.0, 10.0, 0.95, 0.1)
BEHIND = Sphere(80.0, 30.0, 0.0, 12.0, 0.97)
OF = Shares(0.4, 0.35, 0.5, 0.45, 0.3, 0.28)


def predicted(stack, transport=SINGLE, **kinds):
    problem = Problem(stack, Totals.of(ANGLES, **kinds), transport)
    return np.asarray(problem.predict(problem.start))[:, 0].reshape(-1, len(ANGLES))


def test_slabs_and_bases_in_closed_form():
    stack = lj.Stack([lj.Medium(DEPTH, 0.0)])
    reflected, passed, unscattered = predicted(stack, reflectance=[0, 0], transmittance=[0, 0], unscattered=[0, 0])
    np.testing.assert_allclose(passed, np.exp(-0.5 / COSINE), rtol=1e-12)
    np.testing.assert_allclose(unscattered, passed, rtol=1e-12)
    np.testing.assert_allclose(reflected, 0.0, atol=1e-15)
    hazy = lj.Stack([lj.Medium(DEPTH, 0.8, lj.HenyeyGreenstein(0.7))])  # what is unscattered has no albedo
    np.testing.assert_allclose(predicted(hazy, unscattered=[0, 0])[0], np.exp(-0.5 / COSINE), rtol=1e-12)
    painted = lj.Stack([lj.Medium(DEPTH, 0.0)], lj.Lambertian(0.7))
    reflected, passed = predicted(painted, reflectance=[0, 0], transmittance=[0, 0])
    np.testing.assert_allclose(reflected, 0.7 * np.exp(-0.5 / COSINE) * 2 * expn(3, 0.5), rtol=1e-5)
    np.testing.assert_allclose(passed, 0.0)
    lossless = lj.Stack([lj.Medium(DEPTH, 1.0, lj.HenyeyGreenstein(0.3))])
    both = predicted(lossless, lj.AddingDoubling(nodes=8, modes=8), reflectance=[0, 0], transmittance=[0, 0])
    np.testing.assert_allclose(both.sum(axis=0), 1.0, atol=1e-3)  # of 8 nodes


def test_totals_and_values_are_one_likelihood():
    stack = lj.Stack([lj.Medium(DEPTH, Free(0.5, 0.0, 1.0), lj.HenyeyGreenstein(0.2))])
    totals = Problem(stack, Totals.of(reflectance=0.1, transmittance=0.5, sigma=0.003), SINGLE)
    seen, noise = slices((20, 50)), fits.Noise(Free(0.1, 0.01, 1.0), discrepancy=fits.Discrepancy(length_half=10.0))
    values = Problem(stack, simulate(lj.Stack([], lj.Lambertian(0.5)), seen, noise=0.05), SINGLE, noise)
    joint = Joint({"sphere": totals, "angles": values}, shared=["layers"])
    assert joint.names == tuple(name if name in totals.names else f"angles.{name}" for name in values.names)
    whole, *parts = [
        [float(of.log_likelihood(at)), float(np.sum(np.square(of.residuals(at))))]
        for of, at in ((joint, joint.start), (totals, joint.start[:2]), (values, joint.start))
    ]
    np.testing.assert_allclose(whole, np.sum(parts, axis=0), rtol=1e-12)


def detected(spheres: tuple[Sphere, Sphere | None], of: Shares) -> np.ndarray:
    """Light of a beam on the detectors of both spheres, by a chain of states that is followed to its end.

    Light in a sphere is either just sent off by the sample or the detector, which a baffle keeps from each other (some
    leaves by the entrance, the wall gets the rest), or sent off by the wall, and goes to all parts by their areas.
    """
    n = 4  # sent off by a port, by the wall; of the first sphere, of the second
    moves, found = np.zeros((n, n)), np.zeros((2, n))
    for k, sphere in enumerate(spheres):
        if sphere is None:
            continue
        port, wall, other = 2 * k, 2 * k + 1, 2 * (1 - k)
        reflected = (of.diffuse_reflected, of.diffuse_reflected_behind)[k]
        passed = (of.diffuse_transmitted, of.diffuse_transmitted_up)[k]
        areas = {name: sphere.area_fraction(name) for name in ("sample", "entrance", "detector")}
        moves[wall, port] = (1.0 - areas["entrance"]) * sphere.wall
        moves[wall, wall] = (1.0 - sum(areas.values())) * sphere.wall
        moves[port, wall] = areas["sample"] * reflected + areas["detector"] * sphere.detector_reflectance
        moves[other, wall] = areas["sample"] * passed
        found[k, wall] = areas["detector"]
    light = np.array([of.reflected, 0.0, of.transmitted, 0.0])
    total = np.zeros(2)
    while light.max() > 1e-18:
        total += found @ light
        light = moves @ light
    return total


@pytest.mark.parametrize("together", [True, False])
def test_two_spheres_exchange_light_where_they_stand_together(together) -> None:
    spheres = Spheres(FRONT, BEHIND, standard=0.98, together=together)
    exchanged = float(together)
    plate, nothing = Shares(0.98, 0.0, 0.98, 0.0, 0.0, 0.0), Shares(0.0, 1.0, 0.0, 0.0, exchanged, exchanged)
    sample = OF if together else OF._replace(diffuse_transmitted=0.0, diffuse_transmitted_up=0.0)
    both = (FRONT, BEHIND)
    expected = detected(both, sample) / [detected(both, plate)[0] / 0.98, detected(both, nothing)[1]]
    np.testing.assert_allclose(spheres.measured(OF), expected, rtol=1e-12)
    many = spheres.measured(Shares(*(jnp.full(3, share) for share in OF)))
    np.testing.assert_allclose(many, np.tile(expected[:, None], 3), rtol=1e-12)
    if not together:
        np.testing.assert_allclose(Spheres(FRONT, None, 0.98).measured(OF), [expected[0], OF.transmitted])
        np.testing.assert_allclose(Spheres().measured(OF), [OF.reflected, OF.transmitted])


def test_slabs_and_bases_are_seen_by_diffuse_light() -> None:
    """An absorbing slab through E3, and what is opaque by its albedo."""
    for stack, shares, given in (
        (lj.Stack([lj.Medium(DEPTH, 0.0)]), Shares(0.0, np.exp(-0.7), 0.0, 0.0, *[2.0 * expn(3, 0.7)] * 2), 0.7),
        *((PAINT, Shares(albedo, 0.0, albedo, 0.0, 0.0, 0.0), albedo) for albedo in (0.0, 0.3, 1.0)),
    ):
        spheres = Spheres(FRONT, BEHIND, 0.98, together=True)
        problem = Problem(stack, Totals.of(0.0, reflectance=0.1, transmittance=0.5, spheres=spheres), SINGLE)
        np.testing.assert_allclose(np.ravel(problem.predict([given])), spheres.measured(shares), rtol=1e-4, atol=1e-12)


@pytest.mark.slow
def test_light_from_behind_meets_the_other_face() -> None:
    """A slab that is dark on one side: only the sphere there sees it."""
    grey, white, gains = lj.Medium(0.5, 0.2), lj.Medium(Free(1.0, 0.1, 5.0), 0.999), []
    for layers in ([grey, white], [white, grey]):
        seen, alone = (
            Problem(lj.Stack(layers), Totals.of(transmittance=0.5, spheres=one), lj.AddingDoubling(nodes=8, modes=1))
            for one in (Spheres(None, BEHIND), None)
        )
        gains.append(float(seen.predict([1.0])[0, 0] / alone.predict([1.0])[0, 0]))
    assert gains[0] > 1.02 * gains[1]


def test_refused() -> None:
    for make, message in (
        (lambda: Totals.of(), "give reflectance, transmittance or unscattered"),
        (lambda: Totals.of(95.0, reflectance=0.1), r"incidence is \[95.0\], must be in \[0, 90\)"),
        (lambda: Totals.of(reflectance=-0.1), "values holds -0.1, must be at least 0"),
        (lambda: Totals.of([0, 30], reflectance=[0.1, 0.2, 0.3]), r"reflectance has shape \(3,\)"),
        (lambda: Totals.of(reflectance=0.1, sigma={"transmittance": 0.1}), "sigma has nothing for reflectance"),
        (lambda: Totals.of(reflectance=[[0.1, 0.2]], transmittance=0.3), "must be as many for every kind"),
        (lambda: Problem(PAINT, HALF, instrument=fits.Instrument(1.0)), "instrument.* is given, but the data are tota"),
        (lambda: Problem(PAINT, HALF, noise=fits.Noise(discrepancy=True)), "noise.* is given, but the data are totals"),
        (lambda: Sphere(100.0, 99.999, 95.0, 95.0), "the ports cover the whole wall"),
        (lambda: Sphere(100.0, 10.0, wall=1.0), r"Sphere.wall is 1.0, must be a number in \[0, 1\)"),
        (lambda: Spheres(FRONT, together=True), "Spheres.together: there is only one sphere"),
    ):
        refuses(message, make)


WITHIN = 0.02  # what is asked of coefficients, relative to iad's
G = 0.9
TWO_BEAMS = """\
IAD1 1.41 1.00  # indices of refraction of sample and slides
2.65 0 10 0.98  # [mm] thickness of sample and slides, diameter of beam; standard
1 100 21.8 18.3 8 0.98 100 18.3 0 8 0.98  # spheres
# Measurements made by Anisha Bahl at King's College of a PDMS
# without glass slides using a dual beam spectrometer
# Process this file as 'iad -X -i 8 -g 0.9 filename'
L r t n
600.0 0.64189 0.17381 1.42970
"""
"""A row of `docs/phantom_with_no_slides.rxt` of github.com/scottprahl/iad, of which iad makes mu_s' 2.9135 and mu_a
0.0195 per mm; by spheres as the header describes them mu_s' would be 4.05."""


@pytest.mark.slow
def test_a_file_of_two_beams_is_what_iad_makes_of_it(tmp_path):
    """Its coefficients give the readings within what is lost at the edges, and with spheres none that is near."""
    path = tmp_path / "pdms.rxt"
    path.write_text(TWO_BEAMS)

    def predicted(corrected, reduced, mu_a):
        slab = read_slab(path, incidence=8.0, corrected=corrected)
        stack = slab.stack(Free(20.0, 1.0, 100.0), Free(0.05, 1e-3, 5.0), lj.HenyeyGreenstein(G))
        problem = Problem(stack, slab.totals, transport=lj.AddingDoubling(nodes=12, modes=1))
        return np.asarray(problem.predict([reduced / (1.0 - G), mu_a])) / slab.totals.values - 1.0

    assert np.max(np.abs(predicted(None, 2.9135, 0.0195))) < WITHIN
    assert np.min(np.abs(predicted(None, 4.05, 0.0168))) > 0.08
    assert np.min(np.abs(predicted(False, 2.9135, 0.0195))) > 0.08
    assert np.max(np.abs(predicted(False, 4.05, 0.0168))) < 0.005


@pytest.mark.peers
@pytest.mark.parametrize(
    ("albedo", "depth", "g", "ior", "slides"),
    [(0.9, 1.0, 0.0, 1.0, 1.0), (0.98, 5.0, 0.7, 1.33, 1.5)],
)
def test_slabs_of_its_forward_model_are_what_it_inverts_them_to(tmp_path, albedo, depth, g, ior, slides):
    iad = pytest.importorskip("iadpython")
    sample = {"g": g, "n": ior, "n_above": slides, "n_below": slides, "quad_pts": 16}
    reflected, passed = (float(part) for part in iad.Sample(a=albedo, b=depth, **sample).rt()[:2])
    inverse = iad.Experiment(sample=iad.Sample(a=None, b=None, **sample), r=reflected, t=passed, default_g=g)
    a, b = inverse.invert_rt()[:2]
    assert (a, b) == (pytest.approx(albedo, rel=WITHIN), pytest.approx(depth, rel=WITHIN))
    path, glass = tmp_path / "slab.rxt", f"{slides} 1 1" if slides > 1 else "1 1 0"
    path.write_text(f"IAD1 {ior} {glass} 5 1 0 200 25 12 1 .96 200 25 12 1 .96 2 {reflected} {passed}")
    slab, phase = read_slab(path, sigma=0.001), lj.HenyeyGreenstein(g)
    stack = slab.stack(Free(1.0, 0.1, 50.0, LogUniform()), Free(0.05, 1e-3, 5.0, LogUniform()), phase)
    found = {name.rpartition(".")[2]: value for name, value in fit(stack, slab.totals, starts=1).values.items()}
    assert found == pytest.approx({"mu_s": a * b, "mu_a": b * (1 - a)}, rel=WITHIN)
