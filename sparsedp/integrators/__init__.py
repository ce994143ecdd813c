"""Time steps: explicit, implicit, split and exponential integrators with exact derivatives."""
