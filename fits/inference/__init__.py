"""Answers to a `fits.Problem`: the best fit and its uncertainty, samples of the posterior, comparisons of fits."""
