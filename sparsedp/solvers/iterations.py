"""Krylov iterations on plain flat arrays: conjugate gradients and GMRES, stopped by the caller's test.

Both keep the best iterate, and name what went wrong with a status word ("" when nothing did).
"""

import numpy as np

__all__ = ["conjugate_gradients", "dot", "gmres"]

DIVERGED = 1e8  # growth of the residual over the first one


def dot(x, y):
    """Inner product without BLAS: its threads would stall compiled kernels."""
    return float(np.einsum("i,i->", x, y))


class Best:
    """The best iterate so far, and how long ago it was found."""

    def __init__(self, x, residual, window):
        self.x, self.residual, self.window = x.copy(), residual, window
        self.first, self.found = residual, 0

    def trouble(self, x, residual, number):
        """Note an iterate; a status word when the iteration should end."""
        if not np.isfinite(residual) or residual > DIVERGED * self.first:
            return "diverged"
        if residual < self.residual:
            np.copyto(self.x, x)
            self.residual, self.found = residual, number
        return "stagnated" if number - self.found >= self.window else ""


def conjugate_gradients(apply, b, precondition, measure, accepted, maxiter, window, best_of=True):
    """Preconditioned conjugate gradients for S x = b from 0; S symmetric and positive (semi-)definite.

    Parameters
    ----------
    apply : callable
        S p, as a fresh array.
    b : array
        Overwritten: it becomes the residual.
    precondition : callable
        z ~ S^-1 r as a fresh array, symmetric and positive.
    measure : callable
        Norm of the true residual from the residual of S.
    accepted : callable
        accepted(residual norm, x) -> bool.
    maxiter, window : int
        Most iterations; most iterations without a better iterate.
    best_of : bool
        Whether `maxiter` iterations give the best iterate, or the last one.

    Returns
    -------
    (x, iterations, word)
    """
    r, x = b, np.zeros_like(b)
    best = Best(x, measure(r), window)
    z = precondition(r)
    p, rz = z.copy(), dot(r, z)
    scratch = np.empty_like(b)
    for number in range(1, maxiter + 1):
        q = apply(p)
        pq = dot(p, q)
        if not (pq > 0 and rz > 0):
            return best.x, number - 1, _without_descent(pq, rz, p, q, r, z)
        x += np.multiply(p, rz / pq, out=scratch)
        r -= np.multiply(q, rz / pq, out=scratch)
        residual = measure(r)
        if accepted(residual, x):
            return x, number, ""
        trouble = best.trouble(x, residual, number)
        if trouble:
            return best.x, number, trouble
        z = precondition(r)
        rz, before = dot(r, z), rz
        p *= rz / before
        p += z
    return best.x if best_of else x, maxiter, "max_iterations"


def _without_descent(pq, rz, p, q, r, z):
    """Why p.Sp or r.z is not positive: rounding, or an operator that is not definite."""
    if not np.isfinite(pq) or not np.isfinite(rz):
        return "diverged"
    noise = 1e-13 * np.sqrt(dot(p, p) * dot(q, q)), 1e-13 * np.sqrt(dot(r, r) * dot(z, z))
    return "stagnated" if abs(pq) <= noise[0] or abs(rz) <= noise[1] else "indefinite_operator"


def gmres(apply, b, precondition, goal, accepted, maxiter, restart):
    """Restarted GMRES for A x = b from 0, preconditioned from the right: its residuals are those of A.

    Parameters
    ----------
    apply, precondition : callables
        A p and z ~ A^-1 r, as fresh arrays.
    b : array
    goal : float
        Residual norm at which a cycle ends.
    accepted : callable
        accepted(residual norm, x) -> bool, asked at the end of each cycle.
    maxiter, restart : int

    Returns
    -------
    (x, iterations, word)

    Notes
    -----
    Source: Saad and Schultz, SIAM J. Sci. Stat. Comput. 7, 1986.
    """
    x, r, used = np.zeros_like(b), b, 0
    residual = np.sqrt(dot(r, r))
    basis = np.empty((restart + 1, b.size))
    while True:
        change, steps = _gmres_cycle(apply, r, residual, precondition, goal, basis, min(restart, maxiter - used))
        used += steps
        trial = x + precondition(change)
        r = b - apply(trial)
        before, residual = residual, np.sqrt(dot(r, r))
        if not residual < before:
            return x, used, "stagnated" if np.isfinite(residual) else "diverged"
        x = trial
        if accepted(residual, x):
            return x, used, ""
        if used >= maxiter:
            return x, used, "max_iterations"
        if residual > 0.999 * before:
            return x, used, "stagnated"


def _gmres_cycle(apply, r, residual, precondition, goal, basis, steps):
    """The combination of basis vectors with the smallest residual, by Givens rotations."""
    triangle, rotations = np.zeros((steps + 1, steps)), np.zeros((steps, 2))
    rest = np.zeros(steps + 1)
    rest[0] = residual
    np.divide(r, residual, out=basis[0])
    for j in range(steps):
        w = apply(precondition(basis[j]))
        for _ in range(2):  # once is not enough: orthogonality is lost to rounding
            overlap = basis[: j + 1] @ w
            w -= overlap @ basis[: j + 1]
            triangle[: j + 1, j] += overlap
        length = np.sqrt(dot(w, w))
        cosine, sine = _rotate(triangle, rotations, j, length)
        rest[j], rest[j + 1] = cosine * rest[j], -sine * rest[j]
        if abs(rest[j + 1]) <= 0.9 * goal or not length > 0:
            break
        np.divide(w, length, out=basis[j + 1])
    top = triangle[: j + 1, : j + 1]
    shares = np.linalg.lstsq(top, rest[: j + 1], rcond=None)[0]  # the last pivot can be 0 for a singular A
    return shares @ basis[: j + 1], j + 1


def _rotate(triangle, rotations, j, length):
    """Turn column j, whose entry below the diagonal is `length`, into an upper triangular one."""
    column = triangle[:, j]
    for i, (cosine, sine) in enumerate(rotations[:j]):
        column[i], column[i + 1] = cosine * column[i] + sine * column[i + 1], cosine * column[i + 1] - sine * column[i]
    radius = np.hypot(column[j], length)
    cosine, sine = (column[j] / radius, length / radius) if radius > 0 else (1.0, 0.0)
    column[j] = radius
    rotations[j] = cosine, sine
    return cosine, sine
