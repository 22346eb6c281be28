"""Integrating spheres: what they read of a sample that they light again themselves.

Light that a sample sends into a sphere reaches the detector by way of the wall (a baffle stands between), and some of
it meets the sample again, diffusely; between two spheres it may cross the sample several times. After Pickering et al.
1993 (Appl. Opt. 32, 399) and Prahl's iad: with shares of the sphere's area for sample, entrance and detector a_s, a_e,
a_d and for the wall a_w, walls r_w, and what the sample does to diffuse light r_s, t_s,

    G = 1 / (1 - r_w (a_w + (1 - a_e)(a_d r_d + a_s r_s))),
    G_11 = G / (1 - a_s a_s' r_w r_w' (1 - a_e)(1 - a_e') G G' t_s^2).

What a sample passes or mirrors unscattered counts like the rest, wherever it meets the wall first; light that its edges
lose is not followed.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple


@dataclass(frozen=True)
class Sphere:
    """An integrating sphere. Diameters in mm, of the sphere and of its ports: of the sample, of the light (0 where it
    is closed) and of the detector; reflectances of the wall, in [0, 1), and of the detector."""

    diameter: float
    sample: float
    entrance: float = 0.0
    detector: float = 0.0
    wall: float = 0.98
    detector_reflectance: float = 0.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.diameter) and self.diameter > 0.0):
            raise ValueError(f"Sphere.diameter is {self.diameter}, must be above 0")
        for name in ("sample", "entrance", "detector"):
            if not 0.0 <= getattr(self, name) < self.diameter:
                raise ValueError(f"Sphere.{name} is {getattr(self, name)}, must be in [0, {self.diameter:g}) mm")
        if self.share("sample") + self.share("entrance") + self.share("detector") >= 1.0:
            raise ValueError("Sphere: the ports leave nothing of the wall")
        if not 0.0 <= self.wall < 1.0:
            raise ValueError(f"Sphere.wall is {self.wall}, must be in [0, 1)")
        if not 0.0 <= self.detector_reflectance <= 1.0:
            raise ValueError(f"Sphere.detector_reflectance is {self.detector_reflectance}, must be in [0, 1]")

    def share(self, port: str) -> float:
        """Of the sphere's area, that a port takes: a spherical cap."""
        width = getattr(self, port) / self.diameter
        return 0.5 * (1.0 - math.sqrt(1.0 - width * width))

    @property
    def returned(self) -> float:
        """Of light from a port, what the wall sends on: the rest leaves by the entrance, or is absorbed."""
        return (1.0 - self.share("entrance")) * self.wall

    def gain(self, sample: Any) -> Any:
        """Of diffuse light, over that without any reflection, with a sample of this diffuse reflectance."""
        ports = self.share("sample") + self.share("entrance") + self.share("detector")
        again = (1.0 - self.share("entrance")) * (
            self.share("detector") * self.detector_reflectance + self.share("sample") * sample
        )
        return 1.0 / (1.0 - self.wall * ((1.0 - ports) + again))


class Shares(NamedTuple):
    """Shares of light that a sample reflects and transmits: of the beam, and of diffuse light on either side."""

    reflected: Any
    transmitted: Any
    diffuse_reflected: Any
    diffuse_reflected_behind: Any
    diffuse_transmitted: Any
    diffuse_transmitted_up: Any


@dataclass(frozen=True)
class Spheres:
    """Spheres before and behind a sample; a beam meets the sample first.

    reflection, transmission: None where there is none. standard: reflectance of what the reflection sphere is compared
    with, in (0, 1]; the transmission sphere is compared with itself without a sample. together: both stand there at the
    same time, and exchange light through the sample.
    """

    reflection: Sphere | None = None
    transmission: Sphere | None = None
    standard: float = 1.0
    together: bool = False

    def __post_init__(self) -> None:
        if not 0.0 < self.standard <= 1.0:
            raise ValueError(f"Spheres.standard is {self.standard}, must be in (0, 1]")
        if self.together and (self.reflection is None or self.transmission is None):
            raise ValueError("Spheres.together: there is but one sphere")

    def readings(self, of: Shares) -> tuple[Any, Any]:
        """What they read as reflectance and transmittance, over their standards."""
        if not self.together:
            reflected, transmitted = of.reflected, of.transmitted
            if self.reflection is not None:
                gain = self.reflection.gain
                reflected = reflected * gain(of.diffuse_reflected) / gain(self.standard)
            if self.transmission is not None:
                gain = self.transmission.gain
                transmitted = transmitted * gain(of.diffuse_reflected_behind) / gain(0.0)
            return reflected, transmitted
        empty = Shares(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        plate = empty._replace(reflected=self.standard, diffuse_reflected=self.standard)
        passed = empty._replace(transmitted=1.0, diffuse_transmitted=1.0, diffuse_transmitted_up=1.0)
        here, there = self._between(of)
        return self.standard * here / self._between(plate)[0], there / self._between(passed)[1]

    def _between(self, of: Shares) -> tuple[Any, Any]:
        """Diffuse light in both spheres, up to factors of each that all readings share."""
        one, other = self.reflection, self.transmission
        assert one is not None
        assert other is not None
        gains = one.gain(of.diffuse_reflected), other.gain(of.diffuse_reflected_behind)
        down = one.share("sample") * of.diffuse_transmitted * other.returned * gains[0]
        up = other.share("sample") * of.diffuse_transmitted_up * one.returned * gains[1]
        around = 1.0 / (1.0 - down * up)
        here, there = one.returned * of.reflected, other.returned * of.transmitted
        return gains[0] * around * (here + up * there), gains[1] * around * (there + down * here)
