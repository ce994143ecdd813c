"""Plots, error estimates, measurements of work and run time, stress tests, and the demo.

explain.py           explain: count the work of one gradient, and list the work that was skipped
certificate.py       certify: estimate the error of value and gradient due to inexact solves
work_precision.py    work_precision: error against run time
stress_table.py      stress: run a loss for extreme parameter values, and grade each case
stress_cases.py      the list of these cases, and the functions that grade their results
stability.py         growth factors of a time step, and the stability map
plots.py             plots of fields and results; the only module that imports matplotlib
html_page.py         the report as an HTML page
scene_file.py        load a loss and a point from a file that is named on the command line
scene_report.py      write a report with all these results to a folder (the command `report`)
demo/                the command `demo`

This package may import all other packages. Only __main__ and the top-level namespace of sparsedp import it.
"""

from sparsedp._utils.calls import describe_module
from sparsedp.report.plots import animate, convergence, plot, v_curve

__all__ = ["animate", "convergence", "plot", "v_curve"]

describe_module(__name__, "dp.explain(loss, x), or python -m sparsedp report scene.py")
