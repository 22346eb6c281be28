"""Coherent thin films, whose interference colours the light that an interface or a metal reflects."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jax import Array

from layerjax import fresnel
from layerjax._parameters import Parameter, parameter
from layerjax._repr import ReprModule
from layerjax.channels import count, per_channel, pick

Films = tuple[fresnel.Film | None, ...]
"""The film on an interface, for all channels or one for each; None: there is none."""

BARE: Films = (None,)
"""The films of an interface without any."""


class ThinFilm(ReprModule):
    """Coherent film of a transparent material on a `Conductor` or an `Interface`: an oxide, a coating.

    Its reflectance replaces that of the bare surface at every facet: all reflections within the film, summed by
    amplitude for each polarisation, and the mean of the two (Born & Wolf, Principles of Optics, 1.6; the sums of Airy).
    Each channel is monochromatic: fringes of a thick film that a broad colour channel would average are all seen.

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

        Glass with an antireflection coating, a quarter of a wavelength of green light thick:

        >>> film = lj.ThinFilm(ior=1.38, thickness_nm=550.0 / 4.0 / 1.38, wavelengths_nm=[610.0, 550.0, 465.0])
        >>> pane = lj.Stack([lj.Interface(1.52, film=film), lj.Interface(1.0, film=film)])
    """

    ior: Parameter = parameter("ThinFilm.ior")
    thickness_nm: Parameter = parameter("ThinFilm.thickness_nm")
    wavelengths_nm: Parameter = parameter("ThinFilm.wavelengths_nm")

    @property
    def phase(self) -> Array:
        """2 pi d / lambda, (), (C,)."""
        return 2.0 * jnp.pi * self.thickness_nm / self.wavelengths_nm

    def relative_to(self, index: Any) -> "ThinFilm":
        """The same film, its index and wavelengths counted in a medium of this index."""
        relative = self.ior / index, self.thickness_nm * index
        return eqx.tree_at(lambda film: (film.ior, film.thickness_nm), self, relative)


def films_of(film: ThinFilm | None, index: Any = None) -> Films:
    """A film as its channels see it from a medium of this index, relative to what it is counted in (None: that)."""
    if film is None:
        return BARE
    iors, phases = per_channel(film.ior), per_channel(film.phase)
    films = tuple(fresnel.Film(pick(iors, c), pick(phases, c)) for c in range(count(iors, phases)))
    return films if index is None else tuple(one.seen_from(index) for one in films)
