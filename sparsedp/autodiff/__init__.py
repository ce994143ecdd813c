"""Automatic differentiation: the tape, derivative rules, grad, vjp, jvp and hvp."""
