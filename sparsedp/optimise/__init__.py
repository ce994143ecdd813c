"""Optimisation over any nesting of arrays: minimise() and its methods."""
