"""Solvers: from an Operator to its inverse or a function of it, and solves that are differentiable in coefficients."""
