"""Result directories, tables, verdicts in words, pictures and reports. Nothing is inferred here.

A `fits.Fit`, and its `fits.Posterior` where there is one, go in; files, figures and sentences come out.
"""
