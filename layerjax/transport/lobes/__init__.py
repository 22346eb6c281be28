"""Lobes of a stack by directional statistics (Belcour 2018): for each group of paths one GGX lobe.

In goes a stack of interfaces and hazes over any base; out come the energy and `variance` of the light of every group,
which follow from `adding` layer by layer (`statistics`), and scale and roughness of its lobe (`microfacet`).
`Statistical` evaluates them, and other transports draw from them (`sampling`).
"""
