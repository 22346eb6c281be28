"""What is asked of data: free parameters and priors, noise and likelihood, all put together in a `fits.Problem`.

A stack with `fits.Free` in it, `fits.Measurements` and a transport go in; functions of a vector come out. Stacks and
problems are also read from TOML files here, and simulated.
"""

from typing import TYPE_CHECKING

from fits._lazy import directory_of, names_from

if TYPE_CHECKING:
    from fits.problem.correlated import Correlated as Correlated
    from fits.problem.likelihood import Noise as Noise
    from fits.problem.parameters import Free as Free
    from fits.problem.parameters import LogNormal as LogNormal
    from fits.problem.parameters import LogUniform as LogUniform
    from fits.problem.parameters import Normal as Normal
    from fits.problem.parameters import Uniform as Uniform
    from fits.problem.problem import Problem as Problem
    from fits.problem.stack_file import read_problem as read_problem
    from fits.problem.stack_file import write_problem as write_problem

_HOMES = {
    "Problem": "problem",
    "Correlated": "correlated",
    "Noise": "likelihood",
    "Free": "parameters",
    "Uniform": "parameters",
    "LogUniform": "parameters",
    "Normal": "parameters",
    "LogNormal": "parameters",
    "read_problem": "stack_file",
    "write_problem": "stack_file",
}

__all__ = list(_HOMES)

__getattr__ = names_from(__name__, _HOMES)
__dir__ = directory_of(__name__, _HOMES)
