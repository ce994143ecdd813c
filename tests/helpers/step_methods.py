"""Names of the methods of steppers whose state is one field or a tree of fields."""

METHODS = [
    "euler",
    "heun",
    "ssprk3",
    "rk4",
    "backward_euler",
    "crank_nicolson",
    "tr_bdf2",
    "radau",
    "rodas5p",
    "imex",
    "etdrk4",
]
