"""Normals of the facets of a rough surface (GGX, Beckmann, von Mises-Fisher) and of the flakes in a medium (SGGX).

In go directions as components and a width; out come densities, projected areas, masking, and normals drawn as they are
seen. One file holds one distribution; `facets` is the common front of those that surfaces may have.
"""

from layerjax.normals.facets import Distribution as Distribution
from layerjax.normals.sggx import Kind as Kind
