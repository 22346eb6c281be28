"""Model discrepancy: what a stack systematically misses, as a Gaussian process of the logarithm of the BSDF.

Directions of measurements go in; residuals that are independent, and what the process predicts elsewhere, come out.
"""
