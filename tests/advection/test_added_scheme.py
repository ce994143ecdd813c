"""The scheme that CONTRIBUTING.md adds in one function and one line: its order, and its gradient."""

import re
from textwrap import dedent

import autograd.numpy as anp
import numpy as np
import pytest
from sources import ROOT

import sparsedp as dp
from sparsedp.advection import transport
from sparsedp.kernels import fluxes


@pytest.mark.whole
def test_example_of_contributing(monkeypatch):
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    scheme, order = [dedent(block) for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL)]
    page = {"SCHEMES": {}, "Scheme": fluxes.Scheme, "dp": dp, "np": np}
    exec(scheme, page)
    (line,) = page["SCHEMES"].values()
    loop = fluxes.slope_loop("third_order", line.limiter, cache=False)
    monkeypatch.setitem(fluxes.SCHEMES, "third_order", line)
    monkeypatch.setitem(fluxes.slope_loops, "third_order", loop)
    monkeypatch.setitem(transport.METHODS, "third_order", transport.Eulerian)
    exec(order, page)
    grid = dp.Grid((6, 5), size=1.0, periodic=(True, False))
    rng = np.random.default_rng(0)
    move = dp.transport(grid, "third_order", dp.dirichlet)
    given = rng.normal(size=grid.shape), 0.3 * rng.normal(size=grid.faces.size), 0.02, rng.normal(size=move.walls.size)
    result = dp.check.gradient(lambda p: anp.sum(move(*p) ** 2), given)
    assert result.verdict == "agrees", str(result)
