"""Wrong derivatives of formulas: a dropped term of the product rule, units, coordinates, stale constants."""

import numpy as np

from benchmarks.wrong_adjoints.cases import chained, wrong


@wrong("dropped term")
def conductivity_of_temperature():
    """The heat fluxes in a ring whose conductivity grows with the temperature."""

    def f(u):
        return (1 + u**2) * (np.roll(u, -1) - u)

    def vjp(u, g):
        flux = (1 + u**2) * g
        return np.roll(flux, 1) - flux  # fault: + 2 u g (np.roll(u, -1) - u), the conductivity depends on u

    return f, vjp, 1.5 + np.sin(np.arange(8.0))


@wrong("units", entries={"hectopascal": ...})
def density_of_air():
    """The density of air from the pressure in hPa and the temperature in degrees Celsius."""
    gas_constant = 287.05

    def f(x):
        return 100 * x["hectopascal"] / (gas_constant * (x["celsius"] + 273.15))

    def vjp(x, g):
        kelvin = x["celsius"] + 273.15
        pascal = 100 * x["hectopascal"]
        return {
            "hectopascal": g / (gas_constant * kelvin),  # fault: a factor 100
            "celsius": -pascal / (gas_constant * kelvin**2) * g,
        }

    return f, vjp, {"hectopascal": np.linspace(500.0, 1013.0, 5), "celsius": np.linspace(-20.0, 15.0, 5)}


@wrong("coordinates", entries=np.s_[1])
def polar_coordinates():
    """Points in the plane from their radii and angles."""

    def f(x):
        r, angle = x
        return np.stack([r * np.cos(angle), r * np.sin(angle)])

    def vjp(x, g):
        r, angle = x
        radial = np.cos(angle) * g[0] + np.sin(angle) * g[1]
        around = -np.sin(angle) * g[0] + np.cos(angle) * g[1]
        return np.stack([radial, around])  # fault: r * around

    return f, vjp, np.stack([np.linspace(1.5, 3.0, 6), np.linspace(0.1, 2.0, 6)])


@wrong("coordinates")
def mean_on_a_sphere():
    """The mean square of a field on a sphere, with the areas of the cells as weights."""
    latitudes = np.deg2rad(np.linspace(-80, 80, 9))
    weights = np.cos(latitudes)[:, None] * np.ones(4)
    weights /= weights.sum()

    def f(u):
        return np.sum(weights * u**2)

    def vjp(u, g):
        return 2 * u * g / u.size  # fault: the cells do not have the same area

    return f, vjp, 1.5 + np.sin(np.arange(36.0)).reshape(9, 4)


@wrong("stale constant", culprit="decay")
def radioactive_decay():
    """The activity of a tracer that decays; the half-life was corrected after the derivative had been set up."""
    half_life = {"days": 8.0}
    factor = 0.5 ** (1 / half_life["days"])
    half_life["days"] = 8.02

    def injected(dose):
        return dose / (1 + dose)

    def injected_vjp(dose, g):
        return g / (1 + dose) ** 2

    def decay(amount):
        return 0.5 ** (1 / half_life["days"]) * amount

    def decay_vjp(amount, g):
        return factor * g  # fault: of the old half-life

    return chained(np.linspace(0.5, 2.0, 6), (injected, injected_vjp), (decay, decay_vjp))


@wrong("stale linearization", diagnosis="the same cotangent at x and beside x")
def linearized_once():
    """The drag on a vehicle; its derivative is that at the speed at which the program was started."""
    start = np.linspace(10.0, 30.0, 5)
    slope = 0.6 * start

    def f(speed):
        return 0.3 * speed**2

    def vjp(speed, g):
        return slope * g  # fault: 0.6 * speed, right only at the start

    return f, vjp, start
