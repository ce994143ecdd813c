"""Optimization over any nesting of arrays: minimize() and its methods."""
