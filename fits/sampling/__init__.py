"""The posterior: emcee's ensemble or NUTS, their proposals and starting points, and when a chain has converged.

A `fits.Fit` goes in, a `fits.Posterior` comes out.
"""
