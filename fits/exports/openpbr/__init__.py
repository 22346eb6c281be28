"""A stack as an OpenPBR surface in MaterialX: coat over base, as renderers and tools of look development read it.

`surface` is the model and its equations, `translation` finds its parameters and how far they are off, `document` writes
them.
"""
