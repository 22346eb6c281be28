"""Where a user forbids arrays of different ranks to broadcast, that is of their own code: fits do as without."""

import jax
import numpy as np
import pytest

import fits
from fits.reports import verdicts
from tests.helpers.models import line

STACK = {"a": fits.Free(0.9, 0.1, 3.0), "b": fits.Free(0.1, -1.0, 3.0)}
GEOMETRY = fits.slices([10.0, 50.0], np.arange(-80.0, 81.0, 8.0))


@pytest.mark.parametrize("discrepancy", [False, True])
def test_fits_and_what_follows_from_them(discrepancy: bool) -> None:
    """Starts run in threads, which have settings of their own."""
    exact = np.asarray(line({"a": 1.0, "b": 0.5}, GEOMETRY.wi, GEOMETRY.wo))
    values = exact * (1.0 + 0.02 * np.random.default_rng(0).standard_normal(exact.shape))
    data = fits.Measurements(GEOMETRY.wi, GEOMETRY.wo, values, None, np.ones(len(values), bool), ("value",))
    noise = fits.Noise(relative=0.02, floor=1e-4, discrepancy=discrepancy)
    jax.clear_caches()  # nothing that was traced before is taken for this
    with jax.numpy_rank_promotion("raise"):
        found = fits.fit(STACK, data, transport=line, noise=noise, starts=3)
        assert found.values["['a']"] == pytest.approx(1.0, abs=0.3)
        assert verdicts.summary(found)
        assert np.isfinite(fits.evidence(found).log_evidence)
        assert np.all(np.isfinite(fits.predict(found, fits.slices([30.0]), draws=8).bsdf.mean))
