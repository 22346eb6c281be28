"""Coherent thin films, whose interference colours the light that a metal reflects."""

import jax.numpy as jnp
from jax import Array

from layerjax._parameters import Parameter, parameter
from layerjax._repr import ReprModule


class ThinFilm(ReprModule):
    """Coherent film of a transparent material on a `Conductor`: an oxide, an anodic layer, a coating.

    Its reflectance replaces that of the bare metal at every facet: all reflections within the film, summed by amplitude
    for each polarisation, and the mean of the two (Born & Wolf, Principles of Optics, 1.6; the sums of Airy). Each
    channel is monochromatic: fringes of a thick film that a broad colour channel would average are all seen.

    ============== ====== ======== ==== ============ ======== ============== ===========================================
    parameter      symbol shape    unit range        default  differentiable meaning
    ============== ====== ======== ==== ============ ======== ============== ===========================================
    ior            n      (), (C,) 1    [0.25, 4]    required yes            index, relative to the surroundings of the
                                                                             stack
    thickness_nm   d      ()       nm   [0, 5000]    required yes            thickness; 0: no film
    wavelengths_nm lambda (), (C,) nm   [100, 1e5]   required yes            wavelength of each channel in the
                                                                             surroundings
    ============== ====== ======== ==== ============ ======== ============== ===========================================

    Example:
        Heat-tinted titanium, the oxide 40 nm thick:

        >>> import layerjax as lj
        >>> ior, k = lj.metal("titanium", "rgb")
        >>> film = lj.ThinFilm(ior=2.4, thickness_nm=40.0, wavelengths_nm=[610.0, 550.0, 465.0])
        >>> stack = lj.Stack([], lj.Conductor(ior, k, alpha=0.2, film=film))
    """

    ior: Parameter = parameter("ThinFilm.ior")
    thickness_nm: Parameter = parameter("ThinFilm.thickness_nm")
    wavelengths_nm: Parameter = parameter("ThinFilm.wavelengths_nm")

    @property
    def phase(self) -> Array:
        """2 pi d / lambda, (), (C,)."""
        return 2.0 * jnp.pi * self.thickness_nm / self.wavelengths_nm
