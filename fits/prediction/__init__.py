"""Prediction from fits: posterior predictive, cross-validation, evidence, model comparison and averaging.

`fits.Fit`s and their `fits.Posterior`s go in; predictions with intervals and scores come out.
"""
