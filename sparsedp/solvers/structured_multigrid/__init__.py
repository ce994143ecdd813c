"""Structured multigrid: compiled, on the cells of a grid, for symmetric 5- and 7-point operators.

- `engine`: the solver engine, conjugate gradients with one V-cycle as preconditioner.
- `stencil`: recognition of an operator as a stencil by a few products.
- `cycle`: the levels, black-box interpolation between them, and the V-cycle.
- `loops`: the compiled loops.
"""
