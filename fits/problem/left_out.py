"""A problem in which some readings count for nothing, in the programs of the one in which they do."""

from dataclasses import replace

import jax.numpy as jnp
from numpy.typing import ArrayLike

from fits.problem.likelihood import total_sigma
from fits.problem.logarithm import size
from fits.problem.problem import Problem

ENORMOUS = 1e8
"""Noise that leaves a reading without influence, in units of the largest one."""


def without(problem: Problem, rows: ArrayLike) -> Problem:
    """The problem, whose used samples in `rows` (N,) bool count for nothing: their noise is without bounds.

    Residuals of these rows are 0; their number counts still.
    """
    model, left = problem.model, jnp.asarray(rows)[:, None]
    enormous = ENORMOUS * jnp.max(jnp.abs(model.values) + model.lowest)
    model = replace(
        model,
        variance=jnp.where(left, enormous**2, model.variance),
        lowest=jnp.where(left, enormous, model.lowest),
    )
    if model.process is not None and model.process.gram is not None:
        parts = model.build(jnp.asarray(problem.start))
        sigma = total_sigma(model.values, model.variance, parts.relative, parts.floor)
        gram = model.process.gram_of(size(model.values, model.softness) / sigma)
        model = replace(model, process=replace(model.process, gram=gram))
    return problem.with_model(model)
