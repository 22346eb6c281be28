"""Proposals fitted to draws by weight, of which few may be left, or all on a line."""

import numpy as np
import pytest
from scipy import special

from fits.sampling.proposals import FittedProposal


def uneven(seed: int) -> np.ndarray:
    """Draws (count, P) in the box of which few differ, or which lie on a line, with widths from 1e-13 to 0.1."""
    random = np.random.RandomState(seed)
    dimension, count = random.randint(1, 9), random.choice([200, 1000])
    points = random.uniform(0.001, 0.999, (random.randint(1, 6), dimension))
    width = 10.0 ** random.uniform(-12, -1, dimension)
    draws = points[random.randint(len(points), size=count)]
    if seed % 2:
        along = random.randn(count)[:, None] * width
        draws = draws[:1] + along * (1.0 + 1e-9 * random.randn(count, dimension))
    if seed % 3 == 0:
        draws = draws + 0.1 * width * random.randn(count, dimension)
    return np.clip(draws, 1e-9, 1.0 - 1e-9)


@pytest.mark.parametrize("seed", range(24))
def test_a_proposal_is_fitted_to_few_and_collinear_draws(seed: int) -> None:
    positions = special.logit(uneven(seed))
    proposal = FittedProposal.to(positions, np.random.RandomState(0))
    assert np.isfinite(proposal.log_density(positions)).all()
    assert np.isfinite(proposal.log_density(proposal.draw(np.random.RandomState(1), 100))).all()
    assert np.isfinite(proposal.quantiles).all()
