"""The problems of Mosaic, a public benchmark of differentiable solvers, computed with this library."""
