"""Words that arguments and files may have, apart from what reads them: the command line starts without that."""

from typing import Literal, get_args

Format = Literal[
    "csv",
    "totals",
    "rxt",
    "merl",
    "rgl",
    "zemax",
    "lighttools",
    "klems",
    "tensortree",
    "fred",
    "astm",
    "pab",
    "alta",
    "speos",
    "ssdd",
]
Quantity = Literal["brdf", "brdf_cos", "reflectance_factor"]
Strata = Literal["bins", "flux"]
Objective = Literal["likelihood", "cosine_l2", "log1p_cos", "cube_root"]
To = Literal["rgl", "merl", "zemax", "klems", "openpbr", "csv"]

FORMATS: tuple[Format, ...] = get_args(Format)
QUANTITIES: tuple[Quantity, ...] = get_args(Quantity)
STRATA: tuple[Strata, ...] = get_args(Strata)
EXPORTS: tuple[To, ...] = get_args(To)
