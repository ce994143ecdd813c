"""Checks of operators catch planted bugs and let right operators pass: transpose, twin, card, order."""

import json

import autograd.numpy as anp
import numpy as np
import pytest
import scipy.sparse as sp

import sparsedp as dp
from sparsedp._utils.counters import recording
from sparsedp.autodiff.derivative import pullback
from sparsedp.check.operators import layouts
from sparsedp.operators.operator import Operator
from sparsedp.operators.structure.base import Structure

GRID = dp.Grid((6, 5), spacing=[np.linspace(1.0, 2.0, 6), 0.3])
CELLS = GRID.cells


def shift(u):
    return np.roll(u, 1, 0)


def back(g):
    return np.roll(g, -1, 0)


def given(forward, transpose, name="foreign", codomain=CELLS):
    return dp.from_functions(forward, transpose, CELLS, codomain, name=name)


def right_operators():
    entries = sp.csr_array(np.where(np.arange(35).reshape(5, 7) % 3, 0.0, np.sin(np.arange(35.0)).reshape(5, 7)))
    return {
        "gradient": dp.gradient(GRID, dp.dirichlet),
        "laplacian": dp.laplacian(GRID, dp.robin(1, 2)),
        "chain": dp.interior(GRID) @ dp.gradient(GRID),
        "sum": dp.laplacian(GRID) + 2 * dp.mask(CELLS, np.arange(30).reshape(6, 5) % 3 == 0),
        "cancelling": dp.divergence(GRID) @ dp.curl(GRID),
        "matrix": dp.from_matrix(entries),
        "complex matrix": dp.from_matrix(entries * (1 + 2j)),
        "complex factor": 2j * dp.laplacian(GRID),
        "functions": given(shift, back),
        "large": 2.0**600 * dp.laplacian(GRID),
        "small": 2.0**-600 * dp.laplacian(GRID),
        "zero": 0 * dp.laplacian(GRID),
        "one cell": dp.gradient(dp.Grid(1)),
        "no cells": dp.gradient(dp.Grid((0, 3))),
    }


RIGHT = right_operators()


@pytest.mark.parametrize("name", RIGHT)
def test_right_operators_pass(name):
    card = dp.check.operator(RIGHT[name])
    assert card.ok, card
    assert card.worst <= 10
    assert dp.check.transpose(RIGHT[name])
    assert dp.check.twin(RIGHT[name]).verdict == "agrees"


@pytest.mark.parametrize("name", RIGHT)
def test_how_numbers_lie_in_memory_does_not_matter(name):
    """The bits of the contiguous copy in every layout and in a batch; whole numbers are float64, without a gradient."""
    op = RIGHT[name]
    u = np.sin(np.arange(float(op.domain.size))).reshape(op.domain.shape)
    wanted = op(u)
    for other in layouts(u).values():
        assert np.array_equal(op(other), wanted)
    for one, other in zip(op(np.stack([u, 2.0 * u])), (u, 2.0 * u)):
        assert np.array_equal(one, op(other))
    for kind in (int, bool):
        whole = op((u > 0).astype(kind))
        assert np.array_equal(whole, op((u > 0).astype(float))) and whole.dtype == wanted.dtype
        with pytest.raises(dp.errors.DerivativeError):
            pullback(op, (u > 0).astype(kind))
    for shape in ((*u.shape, 2), (u.size + 1,)):
        with pytest.raises(dp.errors.ShapeError):
            op(np.zeros(shape))


def test_a_new_operator_in_five_lines():
    weights = np.array([[0.5, 0.5, 0.0], [0.0, 0.5, 0.5]])
    sensor = dp.from_matrix(weights, 3, 2, name="sensor")
    blur = dp.from_functions(lambda u: u + shift(u), lambda g: g + back(g), CELLS, CELLS, name="blur")
    assert dp.check.operator(sensor)
    assert dp.check.operator(blur)


def test_the_summary_as_text_and_data():
    card = dp.check.operator(RIGHT["gradient"])
    text = str(card)
    for word in ("gradient: cells(6, 5) -> faces(6, 5): agrees", "form: explicit", "nnz: 120", "second order"):
        assert word in text
    assert card.nnz == 120
    assert card.failed == ()
    assert json.loads(json.dumps(card.to_dict()))["domain"] == "cells(6, 5)"
    names = {row.name for row in card.rows}
    assert {"linearity, float64", "JVP, float64", "VJP, float64", "same bits twice, float64"} <= names
    assert repr(card) == text


class Mutating(Structure):
    """Twice a field, which it writes into; `from_functions` would hand it a read-only one."""

    shape = (CELLS.size,) * 2
    has_entries = False

    def apply(self, x, out):
        x *= 2
        out[:] = x

    def transpose(self):
        return self


class Reused:
    """Return a function that returns the same array in every call."""

    def __init__(self):
        self.calls = 0

    def __call__(self, u):
        self.calls += 1
        return u * (1 + 1e-3 * self.calls)


MISTAKES = {
    "A for the transpose": (given(shift, shift), {"transpose, float64", "VJP, float64", "second order, float64"}),
    "one sign": (given(lambda u: u - shift(u), lambda g: g + back(g)), {"transpose, float64"}),
    "0.1 % in the transpose": (given(shift, lambda g: 1.001 * back(g)), {"transpose, float64", "VJP, float64"}),
    "one entry of the transpose": (
        given(lambda u: 3.0 * u, lambda g: g * (3.0 + 1e-9 * (np.arange(30).reshape(6, 5) == 7))),
        {"transpose, float64", "twin, transposed, float64"},
    ),
    "no transpose": (given(shift, None), {"transpose, float64", "twin, transposed, float64"}),
    "affine": (given(lambda u: u + 1, lambda g: g), {"linearity, float64"}),
    "quadratic": (given(lambda u: u * np.abs(u), lambda g: g), {"linearity, float64", "twin, forward, float64"}),
    "input modified": (Operator(Mutating(), CELLS, CELLS, "foreign"), {"same bits twice, float64"}),
    "input modified, as a function": (given(lambda u: np.multiply(u, 2, out=u), lambda g: 2 * g), {"application"}),
    "with a state": (given(Reused(), lambda g: g), {"same bits twice, float64"}),
    "imaginary part dropped": (
        given(lambda u: np.real(u) + 0 * u, lambda g: np.real(g) + 1j * np.imag(g) if np.iscomplexobj(g) else g),
        {"transpose, complex128"},
    ),
    "single precision inside": (
        given(lambda u: shift(u).astype(np.complex64 if np.iscomplexobj(u) else np.float32), back),
        {"transpose, float64", "twin, forward, float64"},
    ),
    "complex for real": (given(lambda u: 1j * u, lambda g: 1j * g), {"application"}),
    "wrong shape": (given(shift, back, codomain=(7,)), {"application"}),
    "NaN": (given(lambda u: u * np.nan, lambda g: g), {"linearity, float64", "transpose, float64"}),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_planted_mistakes_are_named(name):
    op, rows = MISTAKES[name]
    card = dp.check.operator(op)
    assert card.verdict == "disagrees"
    assert not card
    assert rows <= set(card.failed), card
    assert all(f"{row}" in line and "FAILS" in line for row in rows for line in [_line(card, row)])


def _line(card, row):
    return next(line for line in str(card).splitlines() if line.strip().startswith(row))


class Torn(Structure):
    """Factor-like: a matrix, and an application that forgets the 1 / h of the last row."""

    def __init__(self, matrix, factor, transposed=False):
        self.matrix = sp.csr_array(matrix)
        self.factor = factor
        self.transposed = transposed
        self.shape = self.matrix.shape

    def apply(self, x, out):
        out[...] = self.matrix @ x
        if not self.transposed:
            out[-1] *= self.factor

    def explicit(self):
        return self.matrix.astype(float)

    def transpose(self):
        return Torn(self.matrix.T, self.factor, not self.transposed)


def test_twins_that_differ():
    op = Operator(Torn(np.eye(4) * 3.0, 1 + 1e-10), dp.Space(4), dp.Space(4), "torn", "matrix-free")
    result = dp.check.twin(op)
    assert result.verdict == "disagrees"
    assert "forward, float64" in result.failed
    assert not dp.check.transpose(op)


def test_a_small_row_beside_a_large_one_counts_as_much():
    op = Operator(Torn(np.diag([1e9, 1.0, 1.0, 2.0]), 1 + 1e-10), dp.Space(4), dp.Space(4), "torn", "matrix-free")
    assert "twin, forward, float64" in dp.check.operator(op).failed


def test_a_check_of_a_solve_applies_it_a_few_times_more_than_it_has_columns():
    inv = dp.inverse(-dp.laplacian(GRID, dp.dirichlet), "direct")
    with recording() as calls:
        assert dp.check.operator(inv)
    assert calls[inv.name, "solve"] + calls[inv.name, "adjoint"] <= 8 * inv.shape[0]


def test_operators_with_one_form_say_so():
    assert "given as a matrix" in dp.check.twin(RIGHT["matrix"]).rows[0].note
    assert "compared with its columns" in dp.check.twin(RIGHT["functions"]).rows[0].note
    large = dp.from_functions(shift, back, 1000, 1000)
    result = dp.check.twin(large)
    assert result.verdict == "inconclusive" and not result
    assert "too large to list its columns" in str(result)
    assert dp.check.operator(large)  # the other rows still decide


def test_real_functions_may_refuse_complex_fields():
    def triple(u):
        if np.iscomplexobj(u):
            raise TypeError("real fields only")
        return 3 * u

    card = dp.check.operator(given(triple, triple))
    assert card.ok
    assert "refused, TypeError: real fields only" in str(card)


def test_norms_from_products_are_bounds_from_below():
    from sparsedp.check.operators import Probe

    op = dp.laplacian(GRID, dp.dirichlet)
    free = given(op.apply, op.T.apply)
    exact = Probe(op).size
    bound = Probe(free).size
    assert 0.3 * exact <= bound <= exact * (1 + 1e-12)
    assert Probe(given(op.apply, None)).size <= exact * (1 + 1e-12)


def test_a_check_draws_from_its_own_generator():
    np.random.seed(5)  # noqa: NPY002
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    one = dp.check.transpose(RIGHT["gradient"])
    two = dp.check.transpose(RIGHT["gradient"])
    assert np.array_equal(before, np.random.get_state()[1])  # noqa: NPY002
    assert one.to_dict() == two.to_dict()
    assert dp.check.transpose(RIGHT["gradient"], seeds=2, rng=7).ok


@pytest.mark.sampled(0)
@pytest.mark.parametrize("method", ["auto", "direct", "separable", "krylov", "multigrid"])
def test_an_inverse_is_an_operator_too(method, drawn):
    """Judged by its rtol: what an iteration leaves is not a mistake, 0.1 % in the transpose is."""
    stretched = dp.Grid((5, 4), spacing=[np.linspace(1.0, 2.0, 5), 0.3])
    for number, grid in enumerate((dp.Grid((6, 5)), stretched)):
        implicit = dp.identity(grid.cells) - 0.1 * dp.laplacian(grid)
        ops = [implicit, -dp.laplacian(grid), -dp.laplacian(grid, dp.dirichlet)]
        for op in ops if drawn is list else ops[number::2]:
            inv = dp.inverse(op, method, nullspace="project")
            assert dp.check.operator(inv).ok, dp.check.operator(inv)
        assert dp.check.operator(dp.divergence(grid) @ dp.gradient(grid) @ inv).ok
        wrong = dp.from_functions(inv.apply, lambda g, inv=inv: 1.001 * inv.T.apply(g), inv.domain, inv.codomain)
        assert "transpose, float64" in dp.check.operator(wrong).failed


# ---- order ---------------------------------------------------------------------------------------------------------


def laplacian_error(n, factor=1.0):
    grid = dp.Grid(n, size=1.0)
    (x,) = grid.centres()
    u = np.cos(np.pi * x)
    return np.max(np.abs(factor * dp.laplacian(grid)(u) + np.pi**2 * u)[2:-2])


def test_order_of_the_laplacian():
    result = dp.check.order(laplacian_error, expected=(1.9, 2.2))
    assert result.ok and result.verdict == "agrees"
    assert 1.9 < float(result) < 2.1
    assert len(result.orders) == 3
    assert "n" in str(result) and "expected 1.9 to 2.2" in str(result)
    assert json.loads(json.dumps(result.to_dict()))["sizes"] == [16, 32, 64, 128]


def test_a_wrong_factor_and_a_one_sided_difference():
    """What is linear and has its transpose may still be another derivative, or of a lower order."""
    assert dp.check.operator(1.001 * dp.laplacian(dp.Grid(16, size=1.0)))
    assert dp.check.order(lambda n: laplacian_error(n, 1.001), expected=2).verdict == "disagrees"

    def upwind_error(n):
        grid = dp.Grid(n, size=1.0)
        (x,) = grid.centres()
        return np.max(np.abs(dp.upwind(grid, "x")(np.sin(3 * x)) - 3 * np.cos(3 * x))[3:-3])

    assert dp.check.order(upwind_error, expected=1)


def test_order_that_is_wrong_unknown_or_undefined():
    assert dp.check.order(lambda n: 1 / n, expected=2).verdict == "disagrees"
    assert dp.check.order(lambda n: n**-2.0).verdict == "inconclusive"
    zero = dp.check.order(lambda n: 0.0, expected=2)
    assert zero.verdict == "inconclusive" and not zero
    assert "an error is 0 or not finite" in zero.reason
    with pytest.raises(ValueError, match=r"order needs at least three increasing sizes, got \(16, 8, 4\)"):
        dp.check.order(laplacian_error, sizes=(16, 8, 4))


def test_results_are_frozen():
    with pytest.raises(AttributeError, match="Summary is frozen; make a new one instead of setting rows"):
        dp.check.transpose(RIGHT["gradient"]).rows = ()
    with pytest.raises(AttributeError, match="Refinement is frozen; make a new one instead of setting errors"):
        dp.check.order(lambda n: 1 / n).errors = ()


# ---- linear over the real numbers only -------------------------------------------------------------------------------


def half_spectrum(n, slope=1.0):
    """The real FFT, with a transpose that is off by a factor: real fields to complex coefficients."""
    size = n // 2 + 1

    def transpose(g):
        return slope * np.fft.fft(g, n).real

    return dp.from_functions(lambda u: np.fft.rfft(u), transpose, n, size, name="half spectrum", dtype=complex)


def field_of_half_spectrum(n, slope=1.0):
    """The inverse real FFT: complex coefficients to real fields."""
    size = n // 2 + 1
    weights = np.full(size, 2.0)
    weights[[0, -1]] = 1.0  # n is even; the imaginary parts of these two do not count

    def transpose(g):
        back = slope * weights / n * np.conj(np.fft.rfft(g.real))
        back[[0, -1]] = back[[0, -1]].real
        return back

    return dp.from_functions(lambda v: np.fft.irfft(v, n), transpose, size, n, name="field", dtype=complex)


@pytest.mark.parametrize(("make", "side"), [(half_spectrum, "takes real fields"), (field_of_half_spectrum, "are real")])
def test_an_operator_that_is_linear_over_the_real_numbers(make, side):
    card = dp.check.operator(make(8))
    assert card.ok, str(card)
    assert side in str(card) and "its transpose is compared in real parts" in str(card)
    assert dp.check.transpose(make(8)).ok
    assert dp.check.twin(make(8)).verdict == "inconclusive"  # no matrix to compare with
    off = dp.check.operator(make(8, 1.001))
    assert off.verdict == "disagrees" and any(name.startswith("transpose") for name in off.failed)


@pytest.mark.parametrize("make", [half_spectrum, field_of_half_spectrum])
def test_the_gradient_through_a_real_linear_operator(make):
    """The transpose that the check accepts gives right gradients, and one that it refuses is named."""
    op = make(8)
    x = np.random.default_rng(0).standard_normal(op.domain.shape)
    weights = np.arange(1.0, 1.0 + op.codomain.size)
    loss = lambda act: lambda u: anp.sum(weights * anp.abs(act(u)) ** 2)
    assert dp.check.gradient(loss(op), x, quick=True)
    if make is field_of_half_spectrum:
        assert dp.check.gradient(loss(op), x + 1j * x[::-1], quick=True)
    found = dp.check.gradient(loss(make(8, 1.001)), x, quick=True)
    assert found.verdict == "disagrees" and found.culprit == op.name


def test_complex_results_of_an_operator_declared_real_are_refused():
    op = dp.from_functions(np.fft.rfft, lambda g: np.fft.fft(g, 8).real, 8, 5, name="half spectrum")
    card = dp.check.operator(op)
    assert not card.ok and "give its operator dtype=complex" in str(card)


def test_an_operator_on_complex_numbers_that_is_not_linear_there_fails():
    conjugate = dp.from_functions(np.conj, np.conj, 6, 6, name="conjugate", dtype=complex)
    assert dp.check.operator(conjugate).verdict == "disagrees"
