"""Side room: pictures, certificates, measurements, and the demo.

It may import every floor; only __main__ and the shop window open it.
"""

from sparsedp.report.charts import convergence, v_curve
from sparsedp.report.plots import animate, plot

__all__ = ["animate", "convergence", "plot", "v_curve"]
