"""Side room: pictures, certificates, measurements, and the demo.

It may import every floor; only __main__ and the shop window open it.
"""

from sparsedp.report.plots import animate, convergence, plot, v_curve

__all__ = ["animate", "convergence", "plot", "v_curve"]
