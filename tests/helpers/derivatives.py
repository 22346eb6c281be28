"""Stacks, and the points of their parameters at which derivatives are compared with differences of values."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import layerjax as lj
from layerjax import Conductor, HenyeyGreenstein, Interface, Lambertian, Medium, OrenNayar, Stack, VMFDiffuse
from layerjax._parameters import RANGES, leaves_with_names

HAZE = Medium(0.7, 0.8, HenyeyGreenstein(0.3))
FLAKES = Medium(0.7, 0.8, lj.SGGX("surface", 0.3), 0.4)
FIBERS = Medium(0.7, 0.8, lj.SGGX("fiber", 0.3, (0.5, 0.3, 0.7)), 0.4)
DYE = Medium(0.7, 0.0)
METAL = Conductor(0.4, 2.0, 0.3)
TINTED = Conductor(0.4, 2.0, 0.3, film=lj.ThinFilm(1.8, 150.0, 550.0))
BRUSHED = Conductor(0.4, 2.0, 0.3, alpha_y=0.15, tangent=0.6)
FACE = Interface(1.5, 0.3)
VMF_FACE = Interface(1.5, 0.3, "vmf")

STACKS = {
    "haze over paint": Stack([Medium(0.7, 0.8, HenyeyGreenstein(0.3), 0.4)], Lambertian(0.5)),
    "flakes over rough paint": Stack([FLAKES], OrenNayar(0.5, 0.4)),
    "fibers": Stack([FIBERS]),
    "two hazes": Stack([HAZE, Medium(0.4, 0.9, HenyeyGreenstein(-0.3))]),
    "haze over metal": Stack([HAZE], METAL),
    "haze over flakes' fit": Stack([HAZE], VMFDiffuse(0.5, 0.3)),
    "flakes' fit": Stack([], VMFDiffuse(0.5, 0.3)),
    "flakes' fit as printed": Stack([], VMFDiffuse(0.5, 0.3, "literal")),
    "flakes' transport": Stack([], VMFDiffuse(0.5, 0.3, "all_orders")),
    "rough paint": Stack([], OrenNayar(0.5, 0.4)),
    "metal": Stack([], METAL),
    "metal, beckmann": Stack([], Conductor(0.4, 2.0, 0.3, "beckmann")),
    "metal, gtr": Stack([], Conductor(0.4, 2.0, 0.3, "gtr", gamma=3.0)),
    "metal, vmf": Stack([], Conductor(0.4, 2.0, 0.3, "vmf")),
    "brushed metal": Stack([], BRUSHED),
    "tinted metal": Stack([], TINTED),
    "face": Stack([FACE]),
    "varnish": Stack([FACE], Lambertian(0.5)),
    "varnish, beckmann": Stack([Interface(1.5, 0.3, "beckmann")], Lambertian(0.5)),
    "varnish, vmf": Stack([VMF_FACE], Lambertian(0.5)),
    "varnish on rough paint": Stack([FACE], OrenNayar(0.5, 0.4)),
    "varnish on flakes' fit": Stack([FACE], VMFDiffuse(0.5, 0.3)),
    "varnish on flakes' transport": Stack([FACE], VMFDiffuse(0.5, 0.3, "all_orders")),
    "coated metal": Stack([FACE], METAL),
    "coated tinted metal": Stack([FACE], TINTED),
    "coated brushed metal": Stack([FACE], BRUSHED),
    "brushed varnish": Stack([Interface(1.5, 0.3, alpha_y=0.15)], Lambertian(0.5)),
    "coated metal, vmf": Stack([VMF_FACE], Conductor(0.4, 2.0, 0.3, "vmf")),
    "dyed varnish": Stack([FACE, DYE], Lambertian(0.5)),
    "dyed coat on metal": Stack([FACE, DYE], METAL),
    "hazy varnish": Stack([FACE, HAZE], Lambertian(0.5)),
    "hazy coat on metal": Stack([FACE, HAZE], METAL),
    "fibers in varnish": Stack([FACE, FIBERS], Lambertian(0.5)),
    "plate": Stack([FACE, HAZE, Interface(1.2, 0.2)]),
    "clear plate": Stack([FACE, Interface(1.2, 0.2)]),
    "slab, vmf": Stack([VMF_FACE, Interface(1.0, 0.2, "vmf")]),
    "two coats on metal": Stack([FACE, Interface(1.2, 0.2)], METAL),
    "two coats on paint": Stack([FACE, Interface(1.2, 0.2)], Lambertian(0.5)),
}

ABSORBING = {"dyed varnish": "layers[1].albedo", "dyed coat on metal": "layers[1].albedo"}
"""Transports that carry no scattering medium must know that it scatters nothing."""


def asked_to_be_known(transport, kind):
    """The parameter that is concrete, if there is one: `ENDF` must know that what surrounds a slab is the same."""
    return "layers[1].ior" if (transport, kind) == ("ENDF", "slab, vmf") else ABSORBING.get(kind)


UNBOUNDED = {
    ("VMFDiffuse.roughness", 0.0): "the value of the fits leaps there, and slopes diverge towards it",
    ("VMFDiffuse.albedo", 1.0): "the slope diverges as (1 - albedo)^-1/2",
}
"""Ends at which no difference converges: derivatives are finite there, and the same in both modes."""


NOTHING = 1e-20
"""Values, 1/sr, that are as good as 0: what is left of a base under an optical depth of 1e4 is rounding."""

JUMP, SHORT = 1e-6, 1e-5
"""By how much of themselves values may jump at equal indices, where tables end; seen with steps that are not short."""


class Point(NamedTuple):
    """One parameter at one value: its place in the vector, a length to step by, and the sides where it may be left.

    kinked: indices are equal there, so that light is totally reflected on one side only, and slopes differ.
    """

    name: str
    place: int
    value: float
    length: float
    sides: tuple[float, ...]
    kinked: bool
    unbounded: bool


class Field(NamedTuple):
    """A parameter of a stack: path, place in the vector, value, and of which range it is (None: an axis)."""

    path: str
    place: int
    value: np.ndarray
    key: str | None
    range: tuple[float, float]


def fields_of(stack, fixed=None):
    """Every parameter but the fixed one."""
    place = 0
    for path, leaf in leaves_with_names(stack):
        owner = stack
        *parents, field = path.replace("]", "").replace("[", ".").split(".")
        for part in parents:
            owner = owner[int(part)] if part.isdigit() else getattr(owner, part)
        key = f"{type(owner).__name__}.{field}"
        kind = getattr(owner, "distribution", "ggx") if field == "alpha" else "ggx"
        bounds = RANGES.get(key if kind == "ggx" else f"{key}, {kind}")
        if path != fixed:
            yield Field(path, place, np.asarray(leaf), key if bounds else None, bounds or (-1.0, 1.0))
        place += np.size(leaf)


def points_of(stack, fixed=None):
    """Every parameter inside its range, exactly at both its ends, and where it is 0, 1 or the index beside it."""
    found = []
    for field in fields_of(stack, fixed):
        if field.key is None:
            for k, value in enumerate(np.ravel(field.value)):
                found.append(Point(f"{field.path}[{k}]", field.place + k, float(value), 1.0, (1.0, -1.0), False, False))
            continue
        (low, high), inside = field.range, float(field.value)
        beside = (1.0, 1.5) if field.key == "Interface.ior" else ()
        values = {low, high, inside, *beside, *(number for number in (0.0, 1.0) if low < number < high)}
        found += [_point(field, value, value in beside and (value == 1.0 or value != inside)) for value in values]
    return sorted(found, key=lambda point: (point.place, point.value))


def _point(field, value, kinked):
    low, high = field.range
    sides = (-1.0,) if value == high else (1.0,) if value == low else (1.0, -1.0)
    length = _length(field.path.split(".")[-1], value)
    return Point(field.path, field.place, value, length, sides, kinked, (field.key, value) in UNBOUNDED)


def random_points(stack, fixed=None, count=17, ends=0.25):
    """Stacks of one structure with random parameters all over their ranges, of which a share is exactly at an end, at
    0, at 1 or at the index of what is outside: vectors, and a parameter of each to differentiate by."""
    rng = np.random.default_rng(len(jax.tree.leaves(stack)))
    fields = [field for field in fields_of(stack, fixed) if field.key is not None]
    start = np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(stack)])
    for _ in range(count):
        vector = start.copy()
        for field in fields:
            low, high = field.range
            if rng.random() < ends:
                vector[field.place] = rng.choice([low, high, *(n for n in (0.0, 1.0) if low < n < high)])
            elif field.key.endswith((".alpha", ".alpha_y", ".ior")):
                vector[field.place] = np.exp(rng.uniform(np.log(low), np.log(high)))
            elif field.key.endswith(".thickness"):
                vector[field.place] = 10.0 ** rng.uniform(-3.0, 2.0)
            else:
                vector[field.place] = rng.uniform(low, high)
        chosen = fields[rng.integers(len(fields))]
        indices = [1.0, *(vector[field.place] for field in fields if field.key == "Interface.ior")]
        value = float(vector[chosen.place])
        kinked = chosen.key == "Interface.ior" and indices.count(value) > 1
        yield jnp.asarray(vector), _point(chosen, value, kinked)


def _length(field, value):
    if field == "g":
        return min(1.0 - abs(value), 0.5)
    if field in ("thickness", "k"):
        return max(abs(value), 1.0)
    return abs(value) if field in ("alpha", "alpha_y", "ior") else 1.0


def vector_and_build(stack, fixed=None):
    """The numbers of a stack as a vector, and the stack of a vector; `fixed` stays what it is, and is known."""
    leaves, structure = jax.tree.flatten(stack)
    kept = [path == fixed for path, _ in leaves_with_names(stack)]

    def build(vector):
        parts, place = [], 0
        for leaf, keep in zip(leaves, kept, strict=True):
            size = int(np.size(leaf))
            parts.append(leaf if keep else vector[place : place + size].reshape(np.shape(leaf)))
            place += size
        return jax.tree.unflatten(structure, parts)

    return jnp.concatenate([jnp.ravel(leaf) for leaf in leaves]), build


def pairs(stack):
    """Pairs of directions: apart, near the mirror direction, grazing, and with no base from and to below."""
    theta_i, phi_i = [0.3, 1.0, 0.6, 0.5, 1.3, 2.4, 2.2, 0.4], [0.0, 0.3, 0.1, 0.0, 0.2, 1.0, 0.3, 0.1]
    theta_o, phi_o = [0.7, 0.4, 0.62, 2.2, 1.2, 2.6, 0.8, 2.75], [2.0, 3.3, 3.2, 1.0, 3.0, 4.0, 2.9, 3.24]
    wi, wo = (
        lj.direction(jnp.asarray(theta_i), jnp.asarray(phi_i)),
        lj.direction(jnp.asarray(theta_o), jnp.asarray(phi_o)),
    )
    if stack.base is None:
        return wi, wo
    return tuple(w.at[:, 2].set(jnp.abs(w[:, 2])) for w in (wi, wo))


def agrees(derivative, value, vector, point):
    """Whether differences that have converged at some step agree with the derivative, output by output.

    Converged to 2 %, where tables kink to 20 %.
    Differences are one-sided and of second order at an end, central inside. Their error is what halving the step
    changes, and the rounding of the values. Where slopes of two sides differ, the derivative lies between them, or
    beyond by a quarter of what they differ by: it is made of many products whose factors have kinks of their own.
    """
    middle = np.asarray(value(vector))
    found = np.zeros(np.shape(middle), bool)
    steps = 10.0 ** (-np.arange(3.0, 9.0) if point.kinked else -np.arange(1.0, 9.0)) * 0.5 * point.length

    def at(step):
        return np.asarray(value(vector.at[point.place].add(step)))

    def slope(step, side):
        if side == 0:
            return (at(step) - at(-step)) / (2 * step)
        return side * (-3 * middle + 4 * at(side * step) - at(2 * side * step)) / (2 * step)

    sides = point.sides if point.kinked or len(point.sides) == 1 else (0,)
    # where values and slopes are 0, such as at an index of 1, what they are away from there
    away = np.max([np.abs(at(side * 1e-2 * point.length)) for side in point.sides], axis=0)
    scale = np.abs(middle).max() + np.abs(derivative).max() + away + NOTHING
    for step in steps:
        slopes, errors = [], []
        for side in sides:
            wide, narrow = slope(step, side), slope(0.5 * step, side)
            slopes.append(narrow)
            errors.append(np.abs(wide - narrow) + 16 * np.finfo(float).eps * np.abs(middle).max() / step)
        jump = JUMP * np.abs(middle) / step if point.kinked and step > SHORT else 0.0
        apart = 0.25 * np.ptp(slopes, axis=0)
        largest = np.max(np.abs(slopes), axis=0)
        slack = 3 * np.max(errors, axis=0) + 1e-3 * largest + 1e-6 * scale + jump
        settled = np.max(errors, axis=0) <= (0.2 if point.kinked else 0.02) * largest + 1e-6 * scale + 2 * jump
        low, high = np.min(slopes, axis=0) - apart - slack, np.max(slopes, axis=0) + apart + slack
        found |= settled & (low <= derivative) & (derivative <= high)
        if found.all():
            break
    return found


def with_slopes(function, places, mode):
    """The function with its derivatives in those arguments, by one evaluation: half the program of asking for both."""
    if mode == "reverse":
        return jax.value_and_grad(function, places)

    def twice(*arguments):
        return (function(*arguments),) * 2

    def both(*arguments):
        slopes, value = jax.jacfwd(twice, places, has_aux=True)(*arguments)
        return value, slopes

    return both
