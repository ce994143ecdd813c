"""Random functions of small arrays that `dp.jit` can translate to machine code."""

import autograd.numpy as anp

import sparsedp as dp

UNARY = [
    anp.sin,
    anp.cos,
    anp.tanh,
    lambda u: anp.exp(-anp.abs(u)),
    lambda u: anp.sqrt(u * u + 0.5),
    lambda u: anp.log(1.0 + u * u),
    lambda u: -u,
    lambda u: u**2,
    lambda u: (1.5 + anp.sin(u)) ** 1.3,
    lambda u: anp.arctan(u),
    lambda u: anp.sign(u) * u,
    lambda u: anp.where(u > 0.1, u, 0.5 * u),
    lambda u: anp.maximum(u, -0.3),
    lambda u: u + anp.sum(u),
    lambda u: u * anp.mean(u),
    lambda u: anp.where((u > 0.0) & (u < 0.8), u * u, 1.0 - u),
]
BINARY = [
    lambda u, v: u + v,
    lambda u, v: u - 2.0 * v,
    lambda u, v: u * v,
    lambda u, v: u / (2.0 + v * v),
    lambda u, v: anp.minimum(u, v),
    lambda u, v: anp.arctan2(u, 2.0 + v * v),
    lambda u, v: anp.where(u < v, u, 0.3 * v),
    lambda u, v: u * anp.sum(u * v),
]


def movements(rng, n):
    """Return functions from an array of n entries to one of n entries."""
    k = int(rng.integers(-n, n + 1))
    cut = int(rng.integers(0, n + 1))
    at = int(rng.integers(0, n))
    halves = [(rows, n // rows) for rows in range(1, n + 1) if n % rows == 0]
    shape = halves[rng.integers(len(halves))]
    matrix = rng.normal(size=(n, n)) * (rng.random((n, n)) < 0.5) / n
    weights = rng.normal(size=n)
    n_padded = min(n - 1, 1)
    ring = dp.laplacian(dp.Grid(n, periodic=True)) if n > 2 else None
    found = [
        lambda u: anp.roll(u, k),
        lambda u: u[::-1],
        lambda u: anp.concatenate([u[cut:], u[:cut]]),
        lambda u: anp.concatenate([u[:cut] * 2.0, weights[cut:]]),
        lambda u: u * u[at],
        lambda u: u[at] + weights * u,
        lambda u: anp.array([u[(3 * i) % n] * u[i] for i in range(n)]),
        lambda u: anp.ravel(anp.transpose(anp.reshape(u, shape))),
        lambda u: anp.ravel(anp.reshape(u, shape) + anp.sum(anp.reshape(u, shape), axis=0)),
        lambda u: anp.ravel(anp.reshape(u, shape) * anp.mean(anp.reshape(u, shape), axis=1)[:, None]),
        lambda u: anp.dot(matrix, u),
        lambda u: u @ matrix,
        lambda u: anp.ravel(anp.reshape(u, shape) @ (anp.reshape(u, shape).T @ anp.reshape(u, shape)) / n),
        lambda u: anp.ravel(anp.outer(u, u)[:, 0]),
        lambda u: anp.stack([u, u * weights])[1],
        lambda u: anp.repeat(u, 2)[::2],
        lambda u: anp.pad(u[n_padded:], (n_padded, 0), "constant"),
    ]
    if ring is not None:
        found.append(lambda u: u + 0.05 * ring(u))
    return found


def random_function(rng, n, m):
    """Return a function of two arrays of n and m entries, and a list with the name of each operation."""
    plan = []
    for _ in range(int(rng.integers(2, 9))):
        kind = rng.integers(3)
        first, second = rng.integers(0, 1000, 2)
        choices = (UNARY, BINARY, None)[kind]
        if choices is None:
            choices = movements(rng, n)
        plan.append((kind, choices[rng.integers(len(choices))], int(first), int(second)))

    def function(u, p):
        values = [u, u * p[0] + anp.sum(p)]
        for kind, act, first, second in plan:
            a = values[first % len(values)]
            b = values[second % len(values)]
            values.append(act(a, b) if kind == 1 else act(a))
        result = values[-1] + 0.1 * values[-2]
        return result / (1.0 + anp.sum(result**2))

    return function
