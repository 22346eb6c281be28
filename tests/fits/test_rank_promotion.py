"""Where a user forbids arrays of different ranks to broadcast, that is of their own code: fits do as without."""

import jax
import numpy as np
import pytest

import fits
from fits.reports import verdicts
from tests.helpers.models import LINE, line, line_data


@pytest.mark.slow
@pytest.mark.parametrize("discrepancy", [False, True])
def test_fits_and_what_follows_from_them(discrepancy: bool) -> None:
    """Starts run in threads, which have settings of their own."""
    noise = fits.Noise(relative=0.02, floor=1e-4, discrepancy=discrepancy)
    jax.clear_caches()  # nothing that was traced before is taken for this
    with jax.numpy_rank_promotion("raise"):
        found = fits.fit(LINE, line_data(), transport=line, noise=noise, starts=3)
        assert found.values["['a']"] == pytest.approx(1.0, abs=0.3)
        assert verdicts.summary(found)
        assert np.isfinite(fits.evidence(found).log_evidence)
        assert np.all(np.isfinite(fits.predict(found, fits.slices([30.0]), draws=8).bsdf.mean))
