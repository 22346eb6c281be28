"""The best fit: multi-start, Levenberg-Marquardt within bounds, polish, uncertainties, identifiability, resolution.

A `fits.Problem` goes in, a `fits.Fit` comes out.
"""
