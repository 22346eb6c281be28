"""Published and reference values: SpongeCake single scattering.

Point values come from a matrix form of SGGX (determinant and inverse), projected areas by quadrature over the sphere
and the depth integral by adaptive quadrature; hemispherical values from converged product quadrature, matched by an
analog random walk. Neither shares code or formulas with the package. Directions are (theta, phi).
"""

from math import pi

import layerjax as lj

NORMAL = None
X = (1.0, 0.0, 0.0)


def flakes(kind, alpha, axis, thickness, albedo=1.0, f0=1.0):
    """An SGGX medium."""
    return lj.Medium(thickness, albedo, lj.SGGX(kind, alpha, axis), f0)


def haze(g, thickness, albedo=1.0):
    """A Henyey-Greenstein medium."""
    return lj.Medium(thickness, albedo, lj.HenyeyGreenstein(g))


def surface_3():
    return [flakes("surface", 0.3, NORMAL, 0.8)]


def fiber_2():
    return [flakes("fiber", 0.2, X, 1.5)]


def tilt3():
    return [
        flakes("surface", 0.3, (0.4, 0.2, 0.9), 0.4),
        flakes("fiber", 0.2, (1.0, 0.5, 0.3), 0.6, 0.7, 0.2),
        haze(-0.3, 0.5),
    ]


def fig7():
    return [flakes("surface", 0.5, NORMAL, 0.5), flakes("surface", 0.9, NORMAL, 2.0)]


# name: (layers, (theta_i, phi_i), (theta_o, phi_o), f)
POINTS = {
    "surface": (surface_3, (0.6, 0.2), (1.0, 2.5), 0.0999332247847),
    "surface, transmitted": (surface_3, (0.6, 0.2), (pi - 1.0, 2.5), 0.00770553359642),
    "fiber": (fiber_2, (0.9, 0.1), (0.4, 3.0), 0.0536238106173),
    "fiber, transmitted": (fiber_2, (0.9, 0.1), (pi - 0.4, 3.0), 0.000976506139495),
    "tilted surface": (
        lambda: [flakes("surface", 0.1, (0.4, 0.2, 0.9), 2.0, 0.9, 0.04)],
        (0.5, 0.3),
        (1.2, -0.8),
        0.000365714853341,
    ),
    "tilted fiber, from below": (
        lambda: [flakes("fiber", 0.5, (0.3, 0.2, 0.9), 0.05, 0.7, 0.2)],
        (2.4, 1.0),
        (0.7, 4.0),
        0.00547478173951,
    ),
    "grazing": (lambda: [flakes("surface", 0.05, NORMAL, 1e4)], (1.5, 0.0), (1.48, pi), 1940.97623366),
    "thin": (lambda: [flakes("surface", 0.5, NORMAL, 1e-6)], (0.7, 0.0), (0.3, 2.0), 2.52939554802e-07),
    "equal attenuations": (
        lambda: [flakes("surface", 0.5, NORMAL, 3.0)],
        (0.7, 0.0),
        (pi - 0.7, 2.0),
        0.0039354706715,
    ),
    "haze": (lambda: [haze(0.4, 0.7, 0.8)], (0.6, 0.2), (1.1, 2.5), 0.0292158328285),
    "haze, transmitted": (lambda: [haze(0.4, 0.7, 0.8)], (0.6, 0.2), (2.1, 2.5), 0.0696975769741),
    # the reference has thickness 1e12: what the box ends at, 1e4, leaves exp(-1e4) of difference
    "half space": (lambda: [flakes("surface", 1.0, NORMAL, 1e4, 0.8)], (0.6, 0.2), (1.1, 2.5), 0.0497774630405),
    "stack": (tilt3, (0.5, 0.3), (1.1, 2.0), 0.0501323039295),
    "stack, transmitted": (tilt3, (0.5, 0.3), (2.3, 2.0), 0.00798152768065),
    "stack, transmitted from below": (tilt3, (2.4, 1.0), (1.1, 2.0), 0.00887907760322),
    "stack, from below": (tilt3, (2.4, 1.0), (2.0, 4.0), 0.0485691062516),
}

# name: (layers, (theta_i, phi_i), upwards, downwards, unscattered), with the digits of each known
HEMISPHERES = {
    "flakes": (surface_3, (0.6, 0.2), "0.3501966798", "0.0260045784", "0.4418981940"),
    "fibers": (fiber_2, (0.9, 0.1), "0.2495191019", "0.0506383017", "0.2105741668"),
    "two flakes": (fig7, (0.5, 0.3), "0.2914069053", "0.0348675575", "0.0641207941"),
    "three tilted": (tilt3, (0.5, 0.3), "0.2926647612", "0.0326991914", "0.2162521396"),
    "three tilted, from below": (tilt3, (2.4, 1.0), "0.0395246339", "0.2176334588", "0.1825739633"),
    "haze": (lambda: [haze(0.7, 1.0, 0.9)], (0.5, 0.3), "0.0236577333", "0.2527396431", "0.3199809144"),
    "flat flakes": (
        lambda: [flakes("surface", 0.1, NORMAL, 5.0)],
        (0.8, 0.5),
        "0.4906253964",
        "0.0003476181",
        "0.0065621695",
    ),
    # unscattered: exp(-2 sigma / cos) by hand
    "flakes of a mirror": (
        lambda: [flakes("surface", 0.01, NORMAL, 2.0)],
        (0.6, 0.2),
        "0.4907814",
        "0.000032576",
        "0.1353289492",
    ),
}
