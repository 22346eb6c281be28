"""Proposals fitted to draws by weight, of which few may be left, or all on a line."""

import numpy as np
import pytest
from scipy import special, stats

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


def test_draws_of_a_normal_are_found_again() -> None:
    """Two parameters of widths 1e-2 and 1e-6, correlated by 0.99: where the proposal is dense, the normal is."""
    random = np.random.RandomState(2)
    width, centre = np.array([1e-2, 1e-6]), np.array([0.4, 0.7])
    normal = stats.multivariate_normal([0.0, 0.0], [[1.0, 0.99], [0.99, 1.0]])
    proposal = FittedProposal.to(special.logit(centre + width * normal.rvs(4000, random_state=random)), random)
    fresh = normal.rvs(2000, random_state=random)
    positions = special.logit(centre + width * fresh)
    stretch = np.sum(stats.logistic.logpdf(positions) - np.log(width), axis=1)  # d standard / d log-odds
    lost = np.mean(normal.logpdf(fresh) - (proposal.log_density(positions) - stretch))
    assert 0.0 < lost < 0.2  # the divergence of Kullback and Leibler, of tails that are wider by design
