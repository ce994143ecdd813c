"""Transport of a field by a velocity: one differentiable rule for each scheme."""
