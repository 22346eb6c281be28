"""Integrating spheres: what they measure of a sample that their own diffuse light illuminates as well.

Light that a sample reflects or transmits into a sphere reaches the detector by way of the wall, as a baffle blocks the
direct path, and some of it illuminates the sample again, diffusely; between two spheres it may cross the sample several
times. After Pickering et al. 1993 (Appl. Opt. 32, 399) and Prahl's iad: with area fractions a_s, a_e, a_d of the ports
for sample, entrance and detector and a_w of the wall, reflectances r_w of the wall and r_d of the detector, and the
sample's reflectance r_s and transmittance t_s of diffuse light,

    G = 1 / (1 - r_w (a_w + (1 - a_e)(a_d r_d + a_s r_s))),
    G_11 = G / (1 - a_s a_s' r_w r_w' (1 - a_e)(1 - a_e') G G' t_s^2).

Collimated transmittance and specular reflection count like the rest; light lost at the edges is neglected.
"""

import math
from dataclasses import dataclass, fields
from numbers import Real
from typing import Any, NamedTuple

from fits._files import require_switch


@dataclass(frozen=True)
class Sphere:
    """An integrating sphere, of which `sample`, `entrance` and `detector` are ports.

    Args:
        diameter: of the sphere, in mm.
        sample: diameter of the port, in mm.
        entrance: diameter of the port of the light, in mm; 0 if closed.
        detector: diameter of the port, in mm.
        wall: reflectance of the wall, in [0, 1).
        detector_reflectance: reflectance of the detector, in [0, 1).
    """

    diameter: float
    sample: float
    entrance: float = 0.0
    detector: float = 0.0
    wall: float = 0.98
    detector_reflectance: float = 0.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            below = {"diameter": math.inf, "wall": 1.0, "detector_reflectance": 1.0}.get(field.name, self.diameter)
            if not (isinstance(value, Real) and 0.0 <= float(value) < below) or (field.name, value) == ("diameter", 0):
                bracket = "(" if field.name == "diameter" else "["
                raise ValueError(f"Sphere.{field.name} is {value!r:.60}, must be a number in {bracket}0, {below:g})")
        if sum(self.area_fraction(port) for port in ("sample", "entrance", "detector")) >= 1.0:
            raise ValueError("Sphere: the ports cover the whole wall")

    def area_fraction(self, port: str) -> float:
        """Fraction of the sphere's area that a port takes: a spherical cap."""
        width = getattr(self, port) / self.diameter
        return 0.5 * (1.0 - math.sqrt(1.0 - width * width))

    @property
    def first_reflection(self) -> float:
        """Share of light from the sample that the wall reflects; the rest leaves by the entrance or is absorbed."""
        return (1.0 - self.area_fraction("entrance")) * self.wall

    def gain(self, sample: Any) -> Any:
        """Multiplier G of diffuse light by inter-reflection, for a sample of this diffuse reflectance."""
        ports = self.area_fraction("sample") + self.area_fraction("entrance") + self.area_fraction("detector")
        port_reflectance = (1.0 - self.area_fraction("entrance")) * (
            self.area_fraction("detector") * self.detector_reflectance + self.area_fraction("sample") * sample
        )
        return 1.0 / (1.0 - self.wall * ((1.0 - ports) + port_reflectance))


class Shares(NamedTuple):
    """Hemispherical reflectances and transmittances of a sample: of the collimated beam, and of diffuse light that is
    incident from the side of the beam, from behind, and from behind upwards."""

    reflected: Any
    transmitted: Any
    diffuse_reflected: Any
    diffuse_reflected_behind: Any
    diffuse_transmitted: Any
    diffuse_transmitted_up: Any


@dataclass(frozen=True)
class Spheres:
    """Integrating spheres before and behind a sample; the collimated beam is incident on the sample.

    Args:
        reflection: the sphere before the sample, or None.
        transmission: the sphere behind the sample, or None; it is calibrated without a sample.
        standard: reflectance of the standard of the reflection sphere, in (0, 1].
        together: whether both are in place at the same time and exchange light through the sample (double integrating
            sphere).
    """

    reflection: Sphere | None = None
    transmission: Sphere | None = None
    standard: float = 1.0
    together: bool = False

    def __post_init__(self) -> None:
        for name in ("reflection", "transmission"):
            if not isinstance(one := getattr(self, name), Sphere | None):
                raise ValueError(f"Spheres.{name} is {one!r:.60}, must be a Sphere or None")
        if not (isinstance(self.standard, Real) and 0.0 < float(self.standard) <= 1.0):
            raise ValueError(f"Spheres.standard is {self.standard}, must be in (0, 1]")
        require_switch("Spheres.together", self.together)
        if self.together and (self.reflection is None or self.transmission is None):
            raise ValueError("Spheres.together: there is only one sphere")

    def measured(self, sample: Shares) -> tuple[Any, Any]:
        """Reflectance and transmittance that the spheres measure, relative to their standards."""
        if not self.together:
            reflected, transmitted = sample.reflected, sample.transmitted
            if self.reflection is not None:
                gain = self.reflection.gain
                reflected = reflected * gain(sample.diffuse_reflected) / gain(self.standard)
            if self.transmission is not None:
                gain = self.transmission.gain
                transmitted = transmitted * gain(sample.diffuse_reflected_behind) / gain(0.0)
            return reflected, transmitted
        empty = Shares(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        standard = empty._replace(reflected=self.standard, diffuse_reflected=self.standard)
        no_sample = empty._replace(transmitted=1.0, diffuse_transmitted=1.0, diffuse_transmitted_up=1.0)
        front, back = self._double_sphere(sample)
        return self.standard * front / self._double_sphere(standard)[0], back / self._double_sphere(no_sample)[1]

    def _double_sphere(self, sample: Shares) -> tuple[Any, Any]:
        """Diffuse light in both spheres, up to a constant factor of each."""
        one, other = self.reflection, self.transmission
        assert one is not None
        assert other is not None
        gains = one.gain(sample.diffuse_reflected), other.gain(sample.diffuse_reflected_behind)
        down = one.area_fraction("sample") * sample.diffuse_transmitted * other.first_reflection * gains[0]
        up = other.area_fraction("sample") * sample.diffuse_transmitted_up * one.first_reflection * gains[1]
        exchange = 1.0 / (1.0 - down * up)
        front, back = one.first_reflection * sample.reflected, other.first_reflection * sample.transmitted
        return gains[0] * exchange * (front + up * back), gains[1] * exchange * (back + down * front)
