"""Side room: pictures, certificates, measurements, and the demo.

explain.py           explain: what one gradient computes, and the work that was skipped
certificate.py       certify, certified: the error that solves leave, from recorded solves
work_precision.py    work_precision: error against run time
stress_table.py      stress: one word for each extreme case
stress_cases.py      the table of those cases, and the judges of what comes out
stability.py         the growth factor of a time step, and its map
plots.py             pictures of fields and charts, files of a result; all of matplotlib
scene_report.py      a scene in a file, and all instruments on it in one folder (the command `report`)
demo/                the command `demo`

It may import every floor; only __main__ and the shop window open it.
"""

from sparsedp._utils.calls import describe_module
from sparsedp.report.plots import animate, convergence, plot, v_curve

__all__ = ["animate", "convergence", "plot", "v_curve"]

describe_module(__name__, "dp.explain(loss, x), or python -m sparsedp report scene.py")
