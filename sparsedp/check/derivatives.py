"""Checks of derivatives of any program: NumPy functions, torch, JAX, LinearOperators and simulator objects."""

from __future__ import annotations

import inspect
import time
from collections.abc import Callable, Sequence
from math import inf
from typing import Any

import numpy as np

from sparsedp._utils.pytree import copied, leaves
from sparsedp._utils.validation import check_choice, check_function, check_number, check_whole
from sparsedp.autodiff.backend import require_arrays
from sparsedp.check.chain import Chain
from sparsedp.check.derivative_audit import DerivativeAudit, Options
from sparsedp.check.direction_evidence import CONFIRMING_WORDS
from sparsedp.check.gradient_check import FEWEST_STEPS, Audit
from sparsedp.check.hessian_audit import GradientHessianAudit, LossHessianAudit
from sparsedp.check.matrices import Products, flattened, unflattened
from sparsedp.check.point import audit_generator
from sparsedp.check.programs import CONVENTIONS, Program, library_of
from sparsedp.check.table import Table
from sparsedp.grid.grid import Grid
from sparsedp.grid.space import Space
from sparsedp.operators.operator import Operator

__all__ = ["DerivativeCheck", "hessian", "jacobian", "jvp", "vjp"]

DERIVATIVES = ("vjp", "jvp")
EXAMPLES = {"vjp": "lambda x, g: ...", "jvp": "lambda x, t: ..."}


def vjp(
    f: Any,
    vjp: Callable[[Any, Any], Any] | None = None,
    x: Any = None,
    *,
    jvp: Callable[[Any, Any], Any] | None = None,
    directions: int = 1,
    steps: Sequence[float] | None = None,
    rng: int | np.random.Generator | None = None,
    grid: Any = None,
    noise: float = 0.0,
    convention: str | None = None,
    beside: bool = True,
    stages: Sequence[Any] | None = None,
) -> DerivativeCheck:
    """Check the vector-Jacobian product of any program against finite differences.

    Parameters
    ----------
    f : callable or object
        ``f(x)`` returns an array, or a tree (tuple, list, dict) of arrays. It may be a NumPy function, a torch function
        or module, a JAX function, an Operator, a SciPy LinearOperator, or an object with the methods ``apply(x)`` and
        ``vjp(x, g)``, or ``vjp(g)`` for the last ``apply``. For a torch module, the point is ``{"x": x, "parameters":
        {...}}``, so that the derivatives in its parameters are checked, too.
    vjp : callable, optional
        ``vjp(x, g)`` returns the cotangent of `x`, as a tree like `x`, for a cotangent `g` of the result. Default: the
        method of `f`, or the derivative of the library of `f`: torch, JAX, or the tape of this library.
    x : array, or tree of arrays
        The point. For an operator it may be omitted.
    jvp : callable, optional
        ``jvp(x, t)``. If it is given, it is compared with the VJP by <g, J t> = <J^T g, t>.
    directions : int
        Number of random directions at `x`.
    steps : sequence of float, optional
        At least eight step sizes, relative to the root mean square of each leaf of `x`. Default: nine steps over eight
        decades, and more of them for a direction in which these give no decision.
    rng : None, int or numpy Generator
        Seed or generator of the random directions. Default: a fixed seed.
    grid : Grid, Space, or sequence of them, optional
        Gives the coordinates of wrong entries.
    noise : float
        Relative noise of `f`, for example the tolerance of its iterative solver. Smaller noise is measured.
    convention : "transpose" or "adjoint", optional
        Inner product of complex cotangents: the change of a real loss along dz is Re(sum(g * dz)) for "transpose" (this
        library, autograd, JAX), and Re(sum(conj(g) * dz)) for "adjoint" (torch, LinearOperator). Default: that of the
        library of `f`.
    beside : bool
        Whether a second direction starts at a point near `x`. False for a VJP that is valid at `x` only.
    stages : sequence, optional
        The stages of `f` in the order in which they run: pairs ``(f_i, vjp_i)``, triples ``(name, f_i, vjp_i)``, or
        objects with ``apply`` and ``vjp``. If the verdict is "disagrees", each stage is checked, and `.culprit` is the
        first one that is wrong. With stages, `f` and `vjp` may be None: they are composed of the stages.

    Returns
    -------
    DerivativeCheck
        `.verdict` is "agrees", "disagrees" or "inconclusive"; bool() is True only for "agrees".

    See Also
    --------
    check.jvp, check.jacobian, check.gradient, testing.assert_gradient

    Examples
    --------
    >>> x = np.linspace(1.0, 2.0, 5)
    >>> vjp(lambda u: u**3, lambda u, g: 3 * u**2 * g, x).verdict
    'agrees'
    >>> vjp(lambda u: u**3, lambda u, g: 3 * u * g, x).verdict
    'disagrees'
    """
    options = _options("check.vjp", directions, steps, rng, grid, noise, beside)
    if stages is not None:
        chain = Chain(stages, "vjp")
        f, vjp = chain.completed(f, vjp)
        return _with_stage(_checked("vjp", f, vjp, jvp, x, options, convention), chain, x, options, convention)
    return _checked("vjp", f, vjp, jvp, x, options, convention)


def jvp(
    f: Any,
    jvp: Callable[[Any, Any], Any] | None = None,
    x: Any = None,
    *,
    vjp: Callable[[Any, Any], Any] | None = None,
    directions: int = 1,
    steps: Sequence[float] | None = None,
    rng: int | np.random.Generator | None = None,
    grid: Any = None,
    noise: float = 0.0,
    convention: str | None = None,
    beside: bool = True,
    stages: Sequence[Any] | None = None,
) -> DerivativeCheck:
    """Check the Jacobian-vector product of any program against finite differences.

    Parameters
    ----------
    f : callable or object
        As for `check.vjp`; an object has the methods ``apply(x)`` and ``jvp(x, t)``.
    jvp : callable, optional
        ``jvp(x, t)`` returns the tangent of the result, as a tree like ``f(x)``, for a tangent `t` of `x`. Default: the
        method of `f`, or the derivative of the library of `f`.
    x : array, or tree of arrays
        The point. For an operator it may be omitted.
    vjp : callable, optional
        ``vjp(x, g)``. If it is given, it is compared with the JVP by <g, J t> = <J^T g, t>.
    directions, steps, rng, grid, noise, convention, beside
        As for `check.vjp`.
    stages : sequence, optional
        As for `check.vjp`, with ``jvp_i`` in place of ``vjp_i``.

    Returns
    -------
    DerivativeCheck
        `.verdict` is "agrees", "disagrees" or "inconclusive"; bool() is True only for "agrees".

    See Also
    --------
    check.vjp

    Examples
    --------
    >>> x = np.linspace(1.0, 2.0, 5)
    >>> jvp(np.sin, lambda u, t: np.cos(u) * t, x).verdict
    'agrees'
    """
    options = _options("check.jvp", directions, steps, rng, grid, noise, beside)
    if stages is not None:
        chain = Chain(stages, "jvp")
        f, jvp = chain.completed(f, jvp)
        return _with_stage(_checked("jvp", f, vjp, jvp, x, options, convention), chain, x, options, convention)
    return _checked("jvp", f, vjp, jvp, x, options, convention)


def jacobian(
    f: Any,
    J: Any,
    x: Any,
    *,
    directions: int = 1,
    steps: Sequence[float] | None = None,
    rng: int | np.random.Generator | None = None,
    grid: Any = None,
    noise: float = 0.0,
    beside: bool = True,
) -> DerivativeCheck:
    """Check a Jacobian matrix of any program against finite differences.

    Parameters
    ----------
    f : callable or object
        As for `check.vjp`.
    J : array, sparse matrix, LinearOperator, Operator, or callable
        The Jacobian, with one row for each entry of ``f(x)`` and one column for each entry of `x`, both in C order; the
        leaves of a tree follow each other. An array may also have the shape ``f(x).shape + x.shape``. A callable
        ``J(x)`` returns any of these.
    x : array, or tree of arrays
        The point.
    directions, steps, rng, grid, noise, beside
        As for `check.vjp`. A second point beside `x` is used only if `J` is a callable.

    Returns
    -------
    DerivativeCheck
        `.verdict` is "agrees", "disagrees" or "inconclusive"; bool() is True only for "agrees".

    See Also
    --------
    check.vjp, check.hessian

    Examples
    --------
    >>> x = np.linspace(1.0, 2.0, 5)
    >>> jacobian(np.sin, np.diag(np.cos(x)), x).verdict
    'agrees'
    """
    products = Products(J, "the Jacobian")
    options = _options("check.jacobian", directions, steps, rng, grid, noise, beside and products.is_function)
    f, x, _, _ = _function_and_point("check.jacobian", f, x, options.rng, None)

    def pull(tree: Any, g: Any) -> Any:
        vector = flattened(program.result.variables(g))
        columns = sum(map(np.size, program.point.values))
        slopes = products.transposed_product(program.library.tensors(tree), vector, columns)
        return program.point.build(unflattened(slopes, program.point.values))

    def push(tree: Any, t: Any) -> Any:
        vector = flattened(program.point.variables(t))
        rows = sum(map(np.size, program.result.values))
        slopes = products.product(program.library.tensors(tree), vector, rows)
        return program.result.build(unflattened(slopes, program.result.values))

    program = Program(f, x, pull, push, "transpose")
    program.takes_arrays = True
    return _audited(DerivativeAudit(program, options, "vjp", True, "the Jacobian"), "jacobian")


def hessian(
    f: Callable[[Any], Any],
    H: Any,
    x: Any,
    *,
    gradient: Callable[[Any], Any] | None = None,
    directions: int = 1,
    steps: Sequence[float] | None = None,
    rng: int | np.random.Generator | None = None,
    grid: Any = None,
    noise: float = 0.0,
    beside: bool = True,
) -> DerivativeCheck:
    """Check the Hessian of a loss, or products with it, against finite differences.

    Parameters
    ----------
    f : callable
        ``f(x) -> real scalar``.
    H : array, sparse matrix, LinearOperator, Operator, or callable
        The Hessian; or a function ``H(x, v)`` that returns the product with a tree `v` like `x`; or a function ``H(x)``
        that returns a matrix.
    x : array, or tree of real arrays
        The point.
    gradient : callable, optional
        ``gradient(x)``, a tree like `x`. With a gradient, the Hessian is compared with first differences of it, to
        about nine digits. Without one, it is compared with second differences of `f`, to about six digits.
    directions, steps, rng, grid, noise, beside
        As for `check.vjp`.

    Returns
    -------
    DerivativeCheck
        `.verdict` is "agrees", "disagrees" or "inconclusive"; bool() is True only for "agrees". One of the identities
        is the symmetry <u, H v> = <v, H u>.

    Raises
    ------
    TypeError
        If `f` or `gradient` is not a function, or `x` is complex.

    See Also
    --------
    check.jacobian

    Examples
    --------
    >>> x = np.linspace(1.0, 2.0, 5)
    >>> loss = lambda u: np.sum(u**4)
    >>> hessian(loss, lambda u, v: 12 * u**2 * v, x).verdict
    'agrees'
    >>> hessian(loss, np.diag(12 * x), x, gradient=lambda u: 4 * u**3).verdict
    'disagrees'
    """
    check_function("check.hessian", f, "lambda x: np.sum(x**2)")
    if gradient is not None:
        check_function("gradient of check.hessian", gradient, "lambda x: ...")
    has_products = _takes_vector(H)
    product = H
    is_function = True
    if not has_products:
        matrix = Products(H, "the Hessian")
        is_function = matrix.is_function

        def product(tree: Any, v: Any) -> Any:
            vector = flattened(program.point.variables(v))
            slopes = matrix.product(program.library.tensors(tree), vector, vector.size)
            return program.point.build(unflattened(slopes, program.point.values))

    options = _options("check.hessian", directions, steps, rng, grid, noise, beside and is_function)
    require_arrays("check.hessian", leaves(x))
    program = Program(f if gradient is None else gradient, x, None, product, None)
    program.takes_arrays = not has_products
    program.jvp_name = "H(x, v)"
    if program.point.complex:
        raise TypeError("check.hessian takes real x, got complex numbers; split them into real and imaginary parts")
    if gradient is None:
        return _audited(LossHessianAudit(program, options), "hessian")
    return _audited(GradientHessianAudit(program, options, "jvp", False, "the Hessian"), "hessian")


def _takes_vector(H: Any) -> bool:
    """Return whether H is a function H(x, v), not a matrix or a function H(x)."""
    if not callable(H) or hasattr(H, "matvec") or isinstance(H, Operator):
        return False
    return _needed_arguments(H) != 1


def _needed_arguments(function: Any) -> int | None:
    """Return the number of positional arguments without a default; None if it is not known."""
    try:
        parameters = inspect.signature(function).parameters.values()
    except (TypeError, ValueError):  # functions without a signature
        return None
    kinds = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    return len([p for p in parameters if p.kind in kinds and p.default is inspect.Parameter.empty])


def _options(
    name: str,
    directions: int,
    steps: Sequence[float] | None,
    rng: int | np.random.Generator | None,
    grid: Any,
    noise: float,
    beside: bool,
) -> Options:
    """Return the checked options of an audit."""
    check_number(f"noise of {name}", noise, ">= 0")
    return Options(
        directions=check_whole(f"directions of {name}", directions, 1, "; the default is 1"),
        steps=_checked_steps(steps),
        rng=audit_generator(rng),
        spaces=_spaces(grid),
        noise=float(noise),
        beside=beside,
    )


def _checked(
    kind: str, f: Any, vjp: Any, jvp: Any, x: Any, options: Options, convention: str | None
) -> DerivativeCheck:
    """Check the VJP or JVP of a program."""
    name = f"check.{kind}"
    if convention is not None:
        check_choice("convention", convention, CONVENTIONS)
    both = vjp is not None and jvp is not None
    for word, function in (("vjp", vjp), ("jvp", jvp)):
        if function is not None:
            check_function(f"{word} of {name}", function, EXAMPLES[word], 2)
    f, x, methods, convention = _function_and_point(name, f, x, options.rng, convention)
    program = Program(f, x, vjp or methods.get("vjp"), jvp or methods.get("jvp"), convention)
    return _audited(DerivativeAudit(program, options, kind, both), kind)


def _audited(audit: DerivativeAudit, title: str) -> DerivativeCheck:
    """Run an audit and return its result."""
    start = time.perf_counter()
    audit.run()
    return _result(audit, title, time.perf_counter() - start)


def _with_stage(
    result: DerivativeCheck, chain: Chain, x: Any, options: Options, convention: str | None
) -> DerivativeCheck:
    """Return the result of a check, with the first stage that is wrong if the whole is wrong."""
    if result.verdict != "disagrees":
        return result
    undecided = []
    for stage, point in chain.inputs(x):
        function, derivative = stage.function, stage.derivative
        derivatives = {"vjp": None, "jvp": None, chain.kind: derivative}
        found = _checked(chain.kind, function, derivatives["vjp"], derivatives["jvp"], point, options, convention)
        if found.verdict == "disagrees":
            gaps = tuple(f"{stage.name}: {gap}" for gap in found.gaps)
            result_gaps = tuple(f"{stage.name}: {gap}" for gap in found.result_gaps)
            note = f"{stage.name}: {found.reason}"
            if found.culprit:
                note += f"; {found.culprit}"
            notes = (f"culprit: {note}", *_gap_notes(gaps, result_gaps))
            return _changed(result, culprit=stage.name, gaps=gaps, result_gaps=result_gaps, notes=notes)
        if found.verdict == "inconclusive":
            undecided.append((stage.name, found.reason))
    if len(undecided) == 1:
        name, reason = undecided[0]
        note = f"culprit: {name}, as all other stages agree: {reason}"
        return _changed(result, culprit=name, notes=(note, *_gap_notes(result.gaps, result.result_gaps)))
    note = "culprit: no stage is wrong; the stages may be put together wrongly"
    return _changed(result, culprit=None, notes=(note, *_gap_notes(result.gaps, result.result_gaps)))


def _changed(result: DerivativeCheck, **values: Any) -> DerivativeCheck:
    """Return a result with other values of some attributes."""
    return DerivativeCheck(**(vars(result) | values))


def _gap_notes(gaps: Sequence[str], result_gaps: Sequence[str]) -> list[str]:
    """Return the notes about entries of x and of f(x)."""
    notes = []
    if gaps:
        notes.append(f"largest gaps: {'; '.join(gaps)}")
    if result_gaps:
        notes.append(f"largest gaps in the result: {'; '.join(result_gaps)}")
    return notes


def _checked_steps(steps: Sequence[float] | None) -> tuple[float, ...]:
    """Return the steps of a sweep; raise an error if there are too few."""
    if steps is None:
        return ()
    chosen = tuple(map(float, steps))
    if len(set(chosen)) < FEWEST_STEPS or not all(0 < step < inf for step in chosen):
        raise ValueError(f"a sweep needs at least {FEWEST_STEPS} different positive steps, got {chosen}")
    return chosen


def _spaces(grid: Any) -> list[Any]:
    """Return the spaces of a grid, a space, or a sequence of them."""
    if grid is None:
        return []
    if isinstance(grid, Grid):
        return [grid.cells, grid.faces, grid.nodes, grid.edges]
    if isinstance(grid, Space):
        return [grid]
    if isinstance(grid, (tuple, list)):
        return [space for part in grid for space in _spaces(part)]
    raise TypeError(
        f"grid takes a Grid, a Space, or a list of them, got {type(grid).__name__}; write grid=dp.Grid(...)"
    )


def _function_and_point(
    name: str, f: Any, x: Any, rng: np.random.Generator, convention: str | None
) -> tuple[Callable[[Any], Any], Any, dict[str, Any], str | None]:
    """Return the function of a program, its point, its own derivatives by name, and the convention of its VJP."""
    methods: dict[str, Any] = {}
    require_arrays(name, leaves(x))
    if isinstance(f, Operator):
        f.backend.check(name)
        if x is None:
            x = rng.standard_normal(f.domain.shape)
    elif hasattr(f, "matvec") and hasattr(f, "shape"):
        f, x, methods = _linear_operator(f, x, rng)
        convention = convention or "adjoint"
    elif library_of(f).name == "torch" and hasattr(f, "named_parameters"):
        f, x = library_of(f).with_parameters(f, x)
    elif _is_simulator(f):
        methods = {word: _method(f, word) for word in DERIVATIVES if hasattr(f, word)}
        f = getattr(f, "apply", f)
    check_function(name, f, f"dp.{name}(f, x=x) with a function or an object with apply and vjp")
    if x is None:
        raise TypeError(f"{name} needs the point x at which the derivative is checked; write x=...")
    return f, x, methods, convention


def _method(simulator: Any, name: str) -> Callable[[Any, Any], Any]:
    """Return the derivative of a simulator object as a function of x and a vector.

    The method may take the vector only, and differentiate the last call of ``apply``. Then ``apply`` runs first.
    """
    method = getattr(simulator, name)
    if _needed_arguments(method) != 1:
        return method

    def after_apply(x: Any, vector: Any) -> Any:
        simulator.apply(copied(x))
        return method(vector)

    return after_apply


def _is_simulator(f: Any) -> bool:
    """Return whether a program is an object of other code with the methods ``apply`` or ``vjp``."""
    if type(f).__module__.partition(".")[0] in ("sparsedp", "jax", "jaxlib", "torch", "functools", "builtins"):
        return False
    return any(hasattr(f, word) for word in (*DERIVATIVES, "apply")) and not isinstance(f, type)


def _linear_operator(op: Any, x: Any, rng: np.random.Generator) -> tuple[Any, Any, dict[str, Any]]:
    """Return function, point and derivatives of a SciPy LinearOperator."""

    def apply(u: Any) -> Any:
        return op.matvec(u)

    def pull(u: Any, g: Any) -> Any:
        return op.rmatvec(g)

    def push(u: Any, t: Any) -> Any:
        return op.matvec(t)

    if x is None:
        x = rng.standard_normal(op.shape[1])
        if np.dtype(op.dtype or float).kind == "c":
            x = x + 1j * rng.standard_normal(op.shape[1])
    return apply, x, {"vjp": pull, "jvp": push}


# ------------------------------------------------------------ the result


def _result(audit: DerivativeAudit, title: str, seconds: float) -> DerivativeCheck:
    """Return the result of an audit."""
    lines = [direction for group in audit.groups for direction in group.directions]
    digits = None
    if audit.verdict == "agrees":
        digits = min(int(line.digits) for line in lines if line.word in CONFIRMING_WORDS)
    notes = [note for word, note in audit.findings if word == "note"]
    if audit.culprit:
        notes.append(f"culprit: {audit.culprit}")
    notes += _gap_notes(audit.gaps, audit.result_gaps)
    return DerivativeCheck(
        kind=title,
        verdict=audit.verdict,
        reason=audit.reason,
        digits=digits,
        culprit=audit.culprit,
        hessian=None,
        gaps=audit.gaps,
        result_gaps=audit.result_gaps,
        value=float(np.linalg.norm(audit.base)),
        evaluations=sum(audit.program.runs.values()),
        runs=dict(audit.program.runs),
        seconds=seconds,
        size=audit.program.point.entries,
        result_size=audit.base.size,
        identities=tuple(audit.rows),
        notes=tuple(notes),
        lines=tuple(line.result() for line in lines),
    )


class DerivativeCheck(Audit):
    """The result of `check.vjp`, `check.jvp`, `check.jacobian` and `check.hessian`.

    It is immutable, and bool(check) is True only if the derivative agrees.

    Attributes
    ----------
    kind : "vjp", "jvp", "jacobian" or "hessian"
    verdict : "agrees", "disagrees" or "inconclusive"
    reason : str
        Explanation of the verdict.
    digits : int or None
        Number of digits that agree in the worst direction. None if the verdict is not "agrees".
    gaps : tuple of str
        If the verdict is "disagrees": the entries of `x` with the largest gaps between derivative and finite
        differences, or the rows, walls and leaves whose entries are all wrong.
    result_gaps : tuple of str
        The same for the entries of ``f(x)``.
    culprit : str or None
        The stage whose derivative is wrong, or the kind of the mistake if it is known, such as a missing conjugate.
    identities : tuple of Row
        The tested identities: linearity, equal results of equal calls, <g, J t> = <J^T g, t>.
    runs : dict
        Number of runs of "f", "vjp" and "jvp".
    evaluations : int
        Sum of all runs.
    seconds : float
    size, result_size : int
        Number of entries of `x` and of ``f(x)``.
    value : float
        Norm of ``f(x)``.
    notes : tuple of str
        Further observations.
    lines : tuple of DirectionResult
        One for each direction and each functional <w, f(x)>.
    """

    _plain: tuple[str, ...] = (
        "kind",
        "verdict",
        "reason",
        "digits",
        "culprit",
        "gaps",
        "result_gaps",
        "runs",
        "evaluations",
        "seconds",
        "size",
        "result_size",
        "identities",
        "notes",
        "lines",
        "rows",
    )

    def parts(self) -> list[str | Table]:
        """Return the tables of gaps, directions and identities, the notes, and the verdict."""
        _, *parts = super().parts()
        runs = ", ".join(f"{count} of {name}" for name, count in self.runs.items() if count)
        title = f"{self.kind} of {self.size} -> {self.result_size} values, runs: {runs}"
        words = {True: "ok", False: "FAILS", None: "-"}
        cells = [(row.name, row.figure, f"<= {row.limit:.0e}", words[row.ok]) for row in self.identities]
        if cells:
            parts.insert(2 * bool(self.lines), Table(("identity", "gap", "allowed", ""), cells))
        return [title, *parts]

    def __repr__(self) -> str:
        """Return one line. It is what pytest shows for a failed assertion."""
        return super().__repr__().replace("<gradient", f"<{self.kind}", 1)
