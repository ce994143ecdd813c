"""Structured multigrid: on the grid itself, compiled, for symmetric 5- and 7-point operators that no transform solves.

- `engine`: what the contract calls: conjugate gradients with the cycle as preconditioner.
- `stencil`: an operator as a stencil, read off its products.
- `cycle`: the levels, black-box interpolation between them, and the cycle.
- `loops`: the compiled functions.
"""
