"""Structured multigrid: on the grid itself, compiled, for symmetric 5- and 7-point operators that no transform solves.

- `engine`: what the contract calls: conjugate gradients with the cycle as preconditioner.
- `stencil`, `reading`, `lines`, `facts`: an operator as a stencil, its components and null space.
- `spread`: cells without content in between, so that any size coarsens well.
- `layout`: in which order a level keeps its numbers.
- `interpolation`, `coarsening`, `coarsest`, `levels`: the set-up.
- `smoother`, `cycle`: what a solve does on the levels.
- `loops`: the compiled functions.
"""
