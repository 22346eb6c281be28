"""The second way to a minimum within bounds: jaxopt's L-BFGS-B over the unit box, which uses gradients only.

It shares nothing with the Levenberg-Marquardt solver but the objective, so it is a check on a minimum that lies on a
bound, and a way on for an objective on which Gauss-Newton steps stall. jaxopt is imported on first use.
"""

import warnings
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from fits.problem.model import Model, half_squares

TOLERANCE = 1e-12
MOST_STEPS = 500


def cost(model: Model, s: Any) -> Any:
    """Half the sum of squared residuals at `s` (P,) in the unit box."""
    return half_squares(model.residuals(model.box.from_unit(s)))


def cost_and_gradient(model: Model, s: Any) -> tuple[Any, Any]:
    """Half the sum of squared residuals at `s` (P,) in the unit box, and its gradient (P,) by `s`."""
    return jax.value_and_grad(cost, argnums=1)(model, s)


def minimise_in_box(
    value_and_gradient: Callable[[Any], tuple[Any, Any]], start: NDArray[np.float64], tolerance: float = TOLERANCE
) -> tuple[NDArray[np.float64], float, int, bool]:
    """Minimise from `start` (P,) in the unit box: the point, its cost, the iterations, and whether it converged.

    tolerance: it ends where a step gains less than this share of the cost, or where the gradient is smaller.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="JAXopt is no longer maintained", category=DeprecationWarning)
        from jaxopt import ScipyBoundedMinimize

    solver = ScipyBoundedMinimize(
        fun=value_and_gradient,
        method="l-bfgs-b",
        value_and_grad=True,
        jit=False,  # the function is compiled already, and for all problems of this structure
        tol=tolerance,
        maxiter=MOST_STEPS,
    )
    inside = jnp.clip(jnp.asarray(start), 0.0, 1.0)
    point, info = solver.run(inside, bounds=(jnp.zeros_like(inside), jnp.ones_like(inside)))
    lowest = float(info.fun_val)
    return np.asarray(point, float), lowest, int(info.iter_num), bool(info.success) and bool(np.isfinite(lowest))
