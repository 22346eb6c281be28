"""A fit for every texel, against `fits.fit`: all shapes and precisions, wrong values, models that break, interrupts."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import zarr

import fits
import layerjax as lj
from fits.maps.report import summarise, verdict
from tests.helpers import quick_maps
from tests.helpers.quick_maps import FREE, NAMES, NOISE, TRANSPORT, assert_same, fitted
from tests.helpers.refusals import refuses
from tests.helpers.tasks import stop_at

SHAPE = (8, 8)
CLOSE = 2e-3  # standard errors that a converged fit may be off by, times twenty: it has converged within 1e-4
GEOMETRY = quick_maps.geometry()
INSTRUMENT = fits.Instrument(detector_aperture=2.0, floor=1e-4, gain_sd=0.01)
AWKWARD = {"poor": [1e30, 0.0, -1.0, 1e-300], "too_few_measurements": [np.nan, np.inf], "failed": [1e300, -1e308]}
OWN = {"view": lambda w: np.tile(w, (*SHAPE, 1, 1))}


@pytest.fixture(scope="module")
def holes(measured):
    """Values with a texel of which four measurements are missing, and one that has none; and a mask of two more."""
    values, mask = measured.copy(), np.ones(SHAPE, bool)
    values[0, 1, :4] = values[0, 2] = np.nan
    mask[7, 6:] = False
    return values, mask


@pytest.fixture(scope="module")
def partial(tmp_path_factory, holes):
    return fitted(tmp_path_factory.mktemp("map") / "coat.zarr", holes[0], mask=holes[1])


def data_of(values):
    used = np.isfinite(values)
    return fits.Measurements(GEOMETRY.wi, GEOMETRY.wo, np.where(used, values, 0.0), None, used[:, 0], ("value",))


def distance(map, expected, where=Ellipsis, there=Ellipsis):
    """How far values are from each other at most, in standard errors."""
    moves = [
        (map.values[name].ravel()[where] - expected.values[name].ravel()[there]) / expected.errors[name].ravel()[there]
        for name in NAMES
    ]
    return float(np.nanmax(np.abs(moves)))


def test_every_texel_ends_where_a_fit_does_and_others_are_flagged(partial, holes):
    for place in ((0, 0), (0, 1), (7, 0)):
        noise, data = replace(NOISE, floor=partial.attributes["pilot"]["floor"]), data_of(holes[0][place])
        one = fits.fit(FREE, data, transport=TRANSPORT, noise=replace(noise, discrepancy=False), starts=2)
        for name, value in one.values.items():
            assert abs(value - partial.values[name][place]) < CLOSE * partial.errors[name][place]
        assert partial.measurements[place] == data.mask.sum()
    assert (partial.done, partial.has("masked").sum()) == (1.0, 2)
    np.testing.assert_array_equal(np.argwhere(partial.has("too_few_measurements")), [[0, 2]])
    excluded = partial.has("masked") | partial.has("too_few_measurements")
    for name in NAMES:
        np.testing.assert_array_equal(np.isnan(partial.values[name]), excluded)
    assert partial.has("fitted").sum() == partial.has("converged").sum() == 61


@pytest.mark.parametrize(
    "options",
    [
        {"noise": None},
        pytest.param({"noise": None, "objective": "cosine_l2"}, marks=pytest.mark.slow),
        {"noise": fits.Noise(relative=fits.Free(0.05, 1e-3, 0.5), floor=1e-4)},
        pytest.param({"noise": NOISE, "instrument": INSTRUMENT}, marks=pytest.mark.slow),
    ],
    ids=["assumed noise", "named objective", "fitted noise", "instrument"],
)
def test_values_and_errors_are_those_of_a_fit(tmp_path, measured, options):
    map = fitted(tmp_path / "map.zarr", measured[3:4], **options)
    named = options.get("objective")
    noise = options["noise"] or fits.Noise(relative=0.05, floor=map.attributes["pilot"]["floor"])
    settings = options | {"noise": None if named else replace(noise, discrepancy=False)}
    one = fits.fit(FREE, data_of(measured[3, 5]), transport=TRANSPORT, **settings)
    assert map.names == one.problem.names
    for name in NAMES:
        assert map.errors[name][0, 5] == pytest.approx(one.standard_errors[name], rel=1e-3)
        assert named or abs(map.values[name][0, 5] - one.values[name]) < CLOSE * one.standard_errors[name]
    close = 1e-3 if "noise.relative" in map.names else 1e-6  # a level that is fitted moves it to first order
    assert named or map.reduced_chi_square[0, 5] == pytest.approx(one.reduced_chi_square, rel=close)
    is_assumed = options == {"noise": None}
    said = "No noise is stated: 5 %" in " ".join(verdict(summarise(map), map)[0])
    assert map.attributes["noise_assumed"] == said == is_assumed
    assert (map.numerical_error is not None) == ("instrument" in options)
    if "instrument" in options:
        assert map.attributes["pilot"]["rings"] == one.problem.instrument.rings == 1


@pytest.mark.slow
def test_every_texel_may_have_directions_of_its_own(tmp_path):
    tilts = [np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]]) for a in (0.0, 0.1, 0.2, 0.3)]
    wo = np.stack([GEOMETRY.wo @ tilt.T for tilt in tilts])
    keep = np.all(wo[..., 2] > 0.05, axis=0)
    wi, wo = np.stack([GEOMETRY.wi[keep]] * 4), wo[:, keep]
    own = [fits.Geometry(*pair) for pair in zip(wi, wo, strict=True)]
    values = np.stack([quick_maps.seen(np.array([0.6, 0.5]), one) for one in own])
    noise = fits.Noise(relative=0.02, floor=1e-4)
    map = fitted(tmp_path / "own.zarr", values, view=(wi, wo), noise=noise)
    single = fitted(tmp_path / "single.zarr", values[2:3], view=own[2], noise=noise)
    assert distance(map, single, [2], [0]) < CLOSE
    for name in NAMES:
        assert map.errors[name][2] == pytest.approx(single.errors[name][0], rel=1e-3)


def test_thresholds_of_flags_are_options(tmp_path, measured):
    """A chi-square that every other texel exceeds is poor if that is the threshold, which is stored with the map."""
    thresholds = {"poor_probability": 0.5, "pilot_quantile": 0.0, "pilot_factor": 0.01}
    map = fitted(tmp_path / "map.zarr", measured, **thresholds, restarts=0)
    assert 0.2 < map.has("poor").sum() / map.has("fitted").sum() < 0.8
    assert (map.option("poor_probability"), map.option("numerical_error")) == (0.5, fits.MapOptions.numerical_error)


@pytest.mark.parametrize(
    ("shape", "kind", "options"),
    [
        ((64,), np.float16, {}),
        ((4, 4, 4), ">f8", {}),
        (SHAPE, "<f8", {"chunk_size": 10**9, "pilot_texels": 10**6}),  # no program is made for a million texels
    ],
)
def test_maps_of_every_rank_and_type_are_the_same(tmp_path, measured, whole, shape, kind, options):
    map = fitted(tmp_path / "map.zarr", measured.reshape(*shape, 16, 1).astype(kind), **options)
    assert map.shape == shape
    assert map.has("converged").all()
    # half precision rounds all values the same way, in units of their noise: sixteen of them weigh four times as much
    assert distance(map, whole) < CLOSE + (4.0 * 4.0 * 1e-3 / NOISE.relative if kind == np.float16 else 0.0)
    if options:
        assert map.chunk == SHAPE
        assert fitted(map.path, measured, chunk_size=10**8, pilot_texels=10**6).done == 1.0  # nor is it another fit


def test_a_map_may_have_a_single_texel_or_one_that_can_be_fitted(tmp_path, measured, whole):
    one = fitted(tmp_path / "one.zarr", measured[5:6, 3:4, :, 0], pilot_texels=64)
    only = fitted(tmp_path / "map.zarr", np.where(np.arange(64).reshape(8, 8, 1, 1) == 43, measured, np.nan))
    assert (one.shape, only.has("converged").sum()) == ((1, 1), 1)
    assert distance(one, whole, [0], [43]) < CLOSE
    assert distance(only, whole, [43], [43]) < CLOSE


def test_values_that_cannot_be_cost_their_texel_alone_also_in_single_precision(tmp_path, measured, whole):
    flags = [flag for flag, numbers in AWKWARD.items() for _ in numbers]
    changed, rest = measured.copy(), slice(8, None)
    changed[0] = np.concatenate(list(AWKWARD.values()))[:, None, None]
    changed[0, 2] *= measured[0, 2]
    map = fitted(tmp_path / "map.zarr", changed)
    for column, flag in enumerate(flags):
        assert map.has(flag)[0, column], column
        assert np.isfinite(map.values[NAMES[0]][0, column]) == (flag == "poor")
    assert map.has("converged")[1:].all()
    assert not map.has("poor")[1:].any()
    assert distance(map, whole, rest, rest) < CLOSE
    changed[1, 0, 3] = 1e300  # finite in double precision alone
    jax.config.update("jax_enable_x64", False)
    try:
        spoilt = fitted(tmp_path / "spoilt.zarr", changed)
        refuses("precision float64, not float32", fitted, whole.path, measured)
    finally:
        jax.config.update("jax_enable_x64", True)
    assert np.all(spoilt.flags[1:] == whole.flags[1:])
    # of a cost of ten, 1e-6 is lost to rounding there: 1e-3 standard errors, and a few times that for its gradient
    assert distance(spoilt, whole, slice(9, None), slice(9, None)) < 0.1
    assert spoilt.measurements[1, 0] == 15
    np.testing.assert_allclose(spoilt.errors[NAMES[0]][2:], whole.errors[NAMES[0]][2:], rtol=0.03)


def test_a_model_that_breaks_costs_the_texels_beyond(tmp_path, measured, whole):
    """Texels whose best thickness is above 0.6 have no fit, or one below it that has not converged."""

    def transport(stack, wi, wo):
        exact = lj.evaluate(stack, wi, wo, TRANSPORT)
        return jnp.where(jnp.max(stack.layers[0].thickness) > 0.6, jnp.nan, exact)

    map = fitted(tmp_path / "map.zarr", measured, transport=transport)
    near = whole.values[NAMES[0]] + 5.0 * whole.errors[NAMES[0]] < 0.6
    far = whole.values[NAMES[0]] > 0.61
    assert min(near.sum(), far.sum()) >= 16
    assert distance(map, whole, np.flatnonzero(near), np.flatnonzero(near)) < CLOSE
    assert map.has("converged")[near].all()
    assert not map.has("converged")[far].any()
    assert (map.has("fitted") | map.has("failed")).all()
    assert np.isfinite(map.values[NAMES[0]][map.has("fitted")]).all()


def test_bad_input_is_refused(tmp_path, measured):
    for options, words in (
        ({"poor_probability": 2.0}, r"poor_probability is 2.0; it must be a number in \[0, 1\]"),
        ({"emulator": True, **OWN}, "emulator: there is none where every texel has directions of its own"),
        ({"instrument": fits.Instrument(detector_aperture=2.0), **OWN}, "there can be no instrument"),
        ({"noise": 0.02}, "noise: 0.02 is not a Noise or None"),
        ({"noise": fits.Noise(relative=0.02, discrepancy=True)}, "noise.discrepancy"),
        ({"instrument": fits.Instrument(tilt=fits.Free(0, -1, 1, same_for_all_texels=True))}, r"\.tilt is common"),
        ({"transport": lambda *given: np.nan * lj.evaluate(*given, TRANSPORT)}, "no texel of the pilot has a"),
        ({"mask": np.zeros(SHAPE, bool)}, "mask: no texel takes part, it is 0 everywhere"),
        ({"given": np.full((*SHAPE, 16, 1), np.nan)}, "no measurement of a texel that takes part is a finite number"),
        ({"given": np.ones((*SHAPE, 1)), "view": lambda w: w[:1]}, "no texel has as many measurements as .* free"),
        ({"sigma": np.zeros((*SHAPE, 16, 1))}, "sigma is 0 in block"),
    ):
        view = tuple(map(options.get("view", np.asarray), (GEOMETRY.wi, GEOMETRY.wo)))
        refuses(words, fitted, tmp_path / "none.zarr", **{"given": measured} | options | {"view": view})
        assert not (tmp_path / "none.zarr").exists()


def test_what_stands_in_masked_texels_is_not_looked_at(tmp_path, measured, whole):
    mask, sigma = np.ones(SHAPE, bool), np.full_like(measured, 1e-9)
    mask[0], sigma[0, :4], sigma[0, 4:] = False, 0.0, -999.0
    map = fitted(tmp_path / "map.zarr", measured, sigma=sigma, mask=mask)
    assert map.has("masked")[0].all()
    assert distance(map, whole, slice(8, None), slice(8, None)) < CLOSE
    without = fitted(tmp_path / "without.zarr", measured, sigma=measured, noise=replace(NOISE, use_sigma=False))
    np.testing.assert_array_equal(without.errors[NAMES[1]], whole.errors[NAMES[1]])


# ---- work that is interrupted or damaged (kills: `tests.helpers.kills`) ----


@pytest.mark.parametrize("chunks", [0, 2])
def test_a_run_that_was_stopped_is_resumed_to_the_bit(tmp_path, partial, holes, chunks):
    out, calls = tmp_path / "stopped.zarr", []

    with pytest.raises(KeyboardInterrupt):
        fitted(out, holes[0], mask=holes[1], progress=stop_at("map", chunks))
    assert (0.0 < fits.open_map(out).done < 1.0) == bool(chunks)
    assert_same(fitted(out, holes[0], mask=holes[1], progress=lambda *call: calls.append(call)), partial)
    assert chunks == 0 or ("map", 2, 4) in calls or ("map", 3, 4) in calls  # not begun anew
    assert "pilot" not in {stage for stage, *_ in calls}


def test_chunks_that_cannot_be_done_are_named(tmp_path, holes):
    path = tmp_path / "measured.zarr"
    zarr.create_array(path, shape=holes[0].shape, chunks=(4, 4, 16, 1), dtype="f8")[...] = holes[0]

    def damage(stage, *_):
        for one in path.glob("c/*/*/0/0") if stage == "map" else ():
            one.write_bytes(b"")

    words = refuses("all other chunks are done", fitted, tmp_path / "none.zarr", path, progress=damage)
    for block in ("0:4, 0:4", "0:4, 4:8", "4:8, 0:4", "4:8, 4:8"):  # all four, and not the first alone
        assert f"chunk [{block}]: {path}: block [{block}] cannot be read" in words
