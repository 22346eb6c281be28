"""Exports of a material to files for renderers and optical design: one format a module.

A stack with its transport, or a fit, goes in; a file comes out, and sentences on what it holds and how accurately.
"""
