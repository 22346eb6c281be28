"""Files of materials for renderers and for optical design: one format a file, all of the values of a stack.

A stack with its transport goes in, or a fit; what comes out is a file, and sentences on what it holds and loses.
"""
