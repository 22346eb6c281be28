"""The report of a fitted map: its verdict in words, pictures of every parameter, its worst texels.

A `fits.FittedMap` goes in, finished or not; a page, tables and figures come out.
"""
