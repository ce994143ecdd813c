"""Wrong derivatives of the layers of networks: transposes, sums, broadcasting, connections that are used twice."""

import numpy as np

from benchmarks.wrong_adjoints.cases import chained, wrong


def weights(n):
    """Return a square matrix of weights."""
    return np.sin(np.arange(float(n * n)) ** 2).reshape(n, n)


@wrong("missing transpose", culprit="dense")
def dense_layer():
    """A dense layer and its activation."""
    W = weights(5)

    def dense(u):
        return W @ u

    def dense_vjp(u, g):
        return W @ g  # fault: W.T

    def activation(u):
        return np.tanh(u)

    def activation_vjp(u, g):
        return (1 - np.tanh(u) ** 2) * g

    return chained(np.linspace(-1.0, 1.0, 5), (dense, dense_vjp), (activation, activation_vjp))


@wrong("wrong axis", entries={"bias": ...})
def bias_of_a_layer():
    """A layer of a batch of five samples with a bias for each of five channels."""

    def f(x):
        return np.tanh(x["batch"] + x["bias"])

    def vjp(x, g):
        g = (1 - f(x) ** 2) * g
        return {"batch": g, "bias": g.sum(axis=1)}  # fault: axis=0

    return f, vjp, {"batch": weights(5), "bias": np.linspace(-1.0, 1.0, 5)}


@wrong("wrong broadcast", entries={"gain": ...})
def gain_of_an_amplifier():
    """A signal that is multiplied with one gain."""

    def f(x):
        return x["gain"] * x["signal"]

    def vjp(x, g):
        return {"gain": np.mean(g * x["signal"]), "signal": x["gain"] * g}  # fault: np.sum

    return f, vjp, {"gain": np.array(2.0), "signal": np.linspace(1.0, 2.0, 6)}


@wrong("overwritten in place")
def residual_layer():
    """A residual layer u + tanh(u), whose input is used twice."""

    def f(u):
        return u + np.tanh(u)

    def vjp(u, g):
        of_activation = g.copy()
        direct = of_activation  # fault: direct = g
        of_activation *= 1 - np.tanh(u) ** 2
        return direct + of_activation

    return f, vjp, np.linspace(-1.0, 1.0, 6)
