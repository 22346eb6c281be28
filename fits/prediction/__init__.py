"""What fits say of measurements not made: posterior predictive, cross-validation, evidence, comparison, averages.

`fits.Fit`s and their `fits.Posterior`s go in; predictions with intervals and scores come out.
"""
