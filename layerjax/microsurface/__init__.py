"""What the many facets of a rough surface do together, masking and bounces from facet to facet included.

In go a cosine of incidence, the width of GGX normals and the index; out come the shares of light reflected and
transmitted. `directional_albedo` finds them by quadrature over `visible_facets`, with `multiple_bounces` for what meets
more than one facet; `energy_tables` reads them off `splines`; `heitz_walk` is the random walk that is behind them, a
facet at a time.
"""

from layerjax.microsurface.directional_albedo import interface_energies as interface_energies
