"""Random scenes: whole programs composed of the library's parts, each compared with an independent twin.

`boxes` holds grids and conditions as plain data, `operators` expressions of linear operators, `ingredients` the
nonlinear parts, solves and time steps, `scene` the composition and its comparison, `strategies` what Hypothesis draws,
`script` the program that reproduces one scene without this folder.
"""
