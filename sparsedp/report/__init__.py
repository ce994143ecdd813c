"""Instruments beside the core: pictures, certificates, measurements, and the demo.

explain.py           explain: the work of one gradient, and the work that was skipped
certificate.py       certify: the error that solves leave, from recorded solves
work_precision.py    work_precision: error against run time
stress_table.py      stress: one word for each extreme case
stress_cases.py      the table of those cases, and the functions that grade what comes out
stability.py         the growth factor of a time step, and its map
plots.py             pictures of fields and charts, files of a result; all of matplotlib
scene_file.py        a scene in a file that is named on the command line
scene_report.py      all instruments on it in one folder (the command `report`)
demo/                the command `demo`

It may import all packages; only __main__ and the public window import it.
"""

from sparsedp._utils.calls import describe_module
from sparsedp.report.plots import animate, convergence, plot, v_curve

__all__ = ["animate", "convergence", "plot", "v_curve"]

describe_module(__name__, "dp.explain(loss, x), or python -m sparsedp report scene.py")
