"""Flow around a cylinder in Mosaic: the stored velocities in an open channel, and the task to lower the drag.

The cylinder is the friction of `dp.brinkman`, or a set of solid cells as in most solvers of Mosaic.
"""

import autograd.numpy as np

import sparsedp as dp

__all__ = ["DragTask", "OpenChannel", "flux_variation"]

TWO_PI = 2.0 * np.pi


def _around_cylinder(x, y, side, radius):
    """Return the signed distance to a cylinder in the middle of a square."""
    return np.hypot(x - 0.5 * side, y - 0.5 * side) - radius


class OpenChannel:
    """A square of side 2 pi between two walls; both ends are open, and the fluid starts with the velocity 1.

    Parameters
    ----------
    n : int
        Cells along each axis.
    nu : float
    steps : int
        Until the time 5.
    solid : bool
        Whether the cylinder is a set of solid cells instead of a friction.
    """

    END = 5.0
    RADIUS = 0.1 * TWO_PI

    def __init__(self, n, nu, steps, solid=False):
        self.grid = grid = dp.Grid((n, n), size=TWO_PI)
        self.n, self.steps = n, steps
        settings = {}
        if solid:
            settings["solid"] = _around_cylinder(*grid.centres(), TWO_PI, self.RADIUS) <= 0.0
        else:
            x, y = (grid.join(*(grid.face_centres(axis)[a] for axis in (0, 1))) for a in (0, 1))
            settings["friction"] = nu * dp.brinkman(grid)(_around_cylinder(x, y, TWO_PI, self.RADIUS))
        sides = {"x": dp.outflow, "y": dp.no_slip}
        # The start does not vanish on the walls: the first steps are steeper than the stability check allows.
        self.step = dp.flow_step(grid, self.END / steps, nu, boundary=sides, unstable="allow", **settings)

    def __call__(self, cells=None):
        """Return the mean velocities of n x n cells, or of as many larger cells as asked for, shape (n, n, 2)."""
        start = self.step.start(self.grid.join(1.0, 0.0) * np.ones(self.grid.faces.shape))
        u, v = self.grid.split(dp.rollout(self.step, start, None, self.steps)["v"])
        centred = np.stack([0.5 * (u[1:] + u[:-1]), 0.5 * (v[:, 1:] + v[:, :-1])], axis=-1)
        cells = cells or self.n
        width = self.n // cells
        return np.mean(centred.reshape(cells, width, cells, width, 2), axis=(1, 3))


def flux_variation(velocity):
    """Return how much the flux through the sections x = const differs, relative to its mean; 0 if mass is conserved."""
    flux = np.mean(velocity[..., 0], axis=1)
    return float((np.max(flux) - np.min(flux)) / np.mean(flux))


class DragTask:
    """A channel of side 1 with a cylinder: which inflow of mean velocity 0.5 has the least drag?

    Re = 20 with the diameter 0.1. The loss is |drag| + 50 (mean inflow - 0.5)^2, where the drag is the mean over the
    second half of 200 steps of 0.02. The inflow has one value for each cell, between 0 and 1.5.
    """

    NU = 2.5e-3
    DT = 0.02
    STEPS = 200
    MEAN = 0.5
    LARGEST = 1.5
    PENALTY = 50.0
    RADIUS = 0.05

    def __init__(self, n=32, steps=STEPS, dt=DT):
        self.grid = grid = dp.Grid((n, n), size=1.0)
        self.n, self.steps = n, steps
        self.solid = _around_cylinder(*grid.centres(), 1.0, self.RADIUS) < 0.0
        sides = {"x": (dp.inflow, dp.outflow), "y": dp.no_slip}
        enters = np.zeros((n + 1, n))
        enters[0] = 1.0
        self.at_inflow = grid.join(enters, 0.0)

        def inflow(profile):
            return self.at_inflow * grid.join(np.ones((n + 1, 1)) * profile[None, :], 0.0)

        self.flow = dp.flow_step(grid, dt, self.NU, boundary=sides, solid=self.solid, inflow=inflow, unstable="allow")
        self.forces = dp.forces(grid, solid=self.solid, boundary=sides)
        tail = np.zeros(steps)
        tail[steps // 2 :] = 1.0 / (steps - steps // 2)
        self.tail = tail
        self.start = self.flow.start(grid.join(self.MEAN, 0.0) * np.ones(grid.faces.shape), np.full(n, self.MEAN))

    def flat(self):
        """Return the inflow to start from."""
        return np.full(self.n, self.MEAN)

    def drag(self, profile):
        """Return the mean drag of the second half of the steps [velocity^2 length]."""

        def step(state, profile, weight):
            flow = self.flow(state["flow"], profile)
            force = self.forces(flow["v"], flow["p"], self.NU)[0]
            return {"flow": flow, "drag": state["drag"] + weight * force}

        first = {"flow": self.start, "drag": np.array(0.0)}
        return dp.rollout(step, first, profile, self.steps, inputs=self.tail)["drag"]

    def loss(self, profile):
        """Return |drag| + 50 (mean inflow - 0.5)^2."""
        return np.abs(self.drag(profile)) + self.PENALTY * (np.mean(profile) - self.MEAN) ** 2
