"""Incompressible flow on faces: the projection, viscosity, and what carries momentum."""
