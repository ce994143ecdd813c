"""Incompressible flow with velocities on faces (projection, viscosity, convection), and conservation laws."""
