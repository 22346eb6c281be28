"""Fits of files: one into a result directory, or all of a folder by several stacks, with one table over them."""
