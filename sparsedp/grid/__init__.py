"""Grids, the spaces of their fields, and boundary conditions."""
