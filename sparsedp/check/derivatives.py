"""Checks of derivatives of any program: NumPy functions, torch, JAX, LinearOperators and simulator objects."""

from __future__ import annotations

import inspect
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from sparsedp._utils.pytree import copied, leaves, mapped, norm
from sparsedp._utils.validation import check_choice, check_function, check_number, check_whole
from sparsedp.autodiff.backend import require_arrays
from sparsedp.check.chain import Chain
from sparsedp.check.derivative_audit import DerivativeAudit, Options
from sparsedp.check.direction_evidence import CONFIRMING_WORDS
from sparsedp.check.gradient_check import Audit
from sparsedp.check.hessian_audit import GradientHessianAudit, LossHessianAudit
from sparsedp.check.matrices import Products, adjoint_product, flattened, unflattened
from sparsedp.check.point import audit_generator
from sparsedp.check.programs import CONVENTIONS, Program, WrongResult, library_of, real_part
from sparsedp.check.step_sizes import checked_steps
from sparsedp.check.table import Table
from sparsedp.errors import ShapeError
from sparsedp.grid.grid import Grid
from sparsedp.grid.space import Space
from sparsedp.operators.operator import Operator

__all__ = ["DerivativeCheck", "gradient_as_vjp", "hessian", "jacobian", "jvp", "transposed_products", "vjp"]

DERIVATIVES = ("vjp", "jvp")
DUALITY = "<g, jvp(t)> = <vjp(g), t>"  # name of the identity that compares them
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
        ``jvp(x, t)``. If it is given, or is a method of `f`, it is compared with the VJP by <g, J t> = <J^T g, t>.
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

    Raises
    ------
    TypeError
        If `f`, `vjp` or `jvp` is not a function of this kind, if there is no point `x`, or if ``f(x)`` is not a tree of
        arrays.
    ValueError
        If `convention`, `directions`, `noise` or `steps` is not valid, or there is no stage.
    DerivativeError
        If no `vjp` is given and `f` has no derivative of its own.
    Exception
        Every exception that `f` raises at `x`. Near `x`, ValueError, ArithmeticError and RuntimeError (also those of
        this library) only make a step unusable.

    See Also
    --------
    check.jvp, check.jacobian, check.gradient, testing.assert_gradient

    Notes
    -----
    For weights w of the result and a direction d in x, the number <w, J d> = <J^T w, d> is the derivative of
    <w, f(x)> along d. The right-hand side, with J^T w = ``vjp(x, w)``, is compared with finite differences of
    <w, f(x + t d)>. For complex numbers <a, b> is the sum of the products of real parts and of imaginary parts.

    A cotangent of `x` has the structure and the shapes of `x`. A tuple or list with one entry is accepted if `x` is one
    array, and so are complex numbers for a real `x` if their imaginary parts are rounding errors, as an FFT leaves
    them.

    Examples
    --------
    >>> x = np.linspace(1.0, 2.0, 5)
    >>> vjp(lambda u: u**3, lambda u, g: 3 * u**2 * g, x).verdict
    'agrees'
    >>> vjp(lambda u: u**3, lambda u, g: 3 * u * g, x).verdict
    'disagrees'
    """
    options = _options("check.vjp", directions, steps, rng, grid, noise, beside)
    return _checked_with_stages("vjp", f, {"vjp": vjp, "jvp": jvp}, x, options, convention, stages)


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
        ``vjp(x, g)``. If it is given, or is a method of `f`, it is compared with the JVP by <g, J t> = <J^T g, t>.
    directions, steps, rng, grid, noise, convention, beside
        As for `check.vjp`.
    stages : sequence, optional
        As for `check.vjp`, with ``jvp_i`` in place of ``vjp_i``.

    Returns
    -------
    DerivativeCheck
        `.verdict` is "agrees", "disagrees" or "inconclusive"; bool() is True only for "agrees".

    Raises
    ------
    TypeError, ValueError, DerivativeError, Exception
        As for `check.vjp`.

    See Also
    --------
    check.vjp

    Notes
    -----
    For weights w of the result and a direction d in x, the left-hand side of <w, J d> = <J^T w, d>, with
    J d = ``jvp(x, d)``, is compared with finite differences of <w, f(x + t d)>.

    Examples
    --------
    >>> x = np.linspace(1.0, 2.0, 5)
    >>> jvp(np.sin, lambda u, t: np.cos(u) * t, x).verdict
    'agrees'
    """
    options = _options("check.jvp", directions, steps, rng, grid, noise, beside)
    return _checked_with_stages("jvp", f, {"vjp": vjp, "jvp": jvp}, x, options, convention, stages)


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
        `.verdict` is "agrees", "disagrees" or "inconclusive"; bool() is True only for "agrees". A matrix of another
        shape disagrees.

    Raises
    ------
    TypeError
        If `J` is neither a matrix nor a function, or as for `check.vjp`.
    DerivativeError
        If `J` is a LinearOperator without `rmatvec`.
    ValueError, Exception
        As for `check.vjp`.

    See Also
    --------
    check.vjp, check.hessian

    Notes
    -----
    The products J^T w and J d are compared with finite differences as by `check.vjp`, and with each other by
    <w, J d> = <J^T w, d>.

    Examples
    --------
    >>> x = np.linspace(1.0, 2.0, 5)
    >>> jacobian(np.sin, np.diag(np.cos(x)), x).verdict
    'agrees'
    """
    products = Products(J, "the Jacobian")
    options = _options("check.jacobian", directions, steps, rng, grid, noise, beside and products.is_function)
    subject = _subject("check.jacobian", f, x, options.rng)

    def pull(tree: Any, g: Any) -> Any:
        vector = flattened(program.result.variables(g))
        columns = sum(map(np.size, program.point.values))
        slopes = products.transposed_product(program.library.tensors(tree), vector, columns)
        return program.point.build(unflattened(slopes, program.point.values))

    def push(tree: Any, t: Any) -> Any:
        vector = flattened(program.point.variables(t))
        rows = sum(map(np.size, program.result.values))
        slopes = products.product(program.library.tensors(tree), vector, rows)
        if not (program.point.complex or program.result.complex):
            try:
                slopes = real_part("the product of the Jacobian with t", slopes)
            except ShapeError as error:
                raise WrongResult(str(error)) from error
        return program.result.build(unflattened(slopes, program.result.values))

    program = Program(subject.function, subject.x, pull, push, "transpose")
    program.takes_arrays = True
    program.vjp_name = "the product of the transposed Jacobian with g"
    program.jvp_name = "the product of the Jacobian with t"
    return _audited(DerivativeAudit(program, options, "vjp", True, "the Jacobian"), "jacobian")


def gradient_as_vjp(
    f: Any,
    gradient: Any,
    x: Any,
    *,
    convention: str | None = None,
    beside: bool = True,
    stages: Sequence[Any] | None = None,
    **options: Any,
) -> DerivativeCheck:
    """Check the gradient of a loss of another library as its VJP, g * gradient(x), with the options of `check.vjp`."""

    def pull(x: Any, g: Any) -> Any:
        slopes = gradient(x) if callable(gradient) else gradient
        return mapped(lambda slope: g * slope, slopes)

    checked = _options("check.gradient", beside=beside and callable(gradient), **options)
    result = _checked_with_stages("vjp", f, {"vjp": pull}, x, checked, convention, stages, "gradient(x)")
    return _changed(result, kind="gradient")


def transposed_products(op: Operator) -> DerivativeCheck:
    """Compare an Operator with its transpose as a derivative, to find the entries at which the transpose is wrong."""
    options = Options(beside=False)
    x = options.rng.standard_normal(op.domain.shape)
    if op.dtype.kind == "c":
        x = x + 1j * options.rng.standard_normal(op.domain.shape)

    def pull(u: Any, g: Any) -> Any:
        return op.T.apply(g)

    program = Program(op.apply, x, pull, None, "transpose")
    summary = _audited(DerivativeAudit(program, options, "vjp", False, "the transpose"), "transpose")
    if summary.culprit:
        return _changed(summary, culprit=summary.culprit.replace("the Jacobian", "the operator"))
    return summary


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
        about nine digits, and the gradient with differences of `f`. Without one, the Hessian is compared with second
        differences of `f`, to about six digits.
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
        If `f` or `gradient` is not a function, `H` is neither a matrix nor a function, or `x` is missing or complex.
    ValueError
        If `f` has several values and there is no `gradient`, or if an option is not valid.

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
        matrix = Products(H, "the Hessian", rows="x")
        is_function = matrix.is_function

        def product(tree: Any, v: Any) -> Any:
            vector = flattened(program.point.variables(v))
            slopes = matrix.product(program.library.tensors(tree), vector, vector.size)
            return program.point.build(unflattened(slopes, program.point.values))

    options = _options("check.hessian", directions, steps, rng, grid, noise, beside and is_function)
    require_arrays("check.hessian", leaves(x))
    _require_point("check.hessian", x)
    loss = Program(f, x, None, product, None)
    program = loss if gradient is None else Program(gradient, x, None, product, None)
    if gradient is not None:
        program.value_name = "gradient(x)"
    for of_vectors in (loss, program):
        of_vectors.takes_arrays = not has_products
        of_vectors.jvp_name = "H(x, v)"
    if program.point.complex:
        raise TypeError("check.hessian takes real x, got complex numbers; split them into real and imaginary parts")
    if gradient is None:
        return _audited(LossHessianAudit(loss, options), "hessian")
    return _audited(GradientHessianAudit(program, options, loss), "hessian")


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
    directions: int = 1,
    steps: Sequence[float] | None = None,
    rng: int | np.random.Generator | None = None,
    grid: Any = None,
    noise: float = 0.0,
    beside: bool = True,
) -> Options:
    """Return the checked options of an audit."""
    check_number(f"noise of {name}", noise, ">= 0")
    return Options(
        directions=check_whole(f"directions of {name}", directions, 1, "; the default is 1"),
        steps=checked_steps(steps),
        rng=audit_generator(rng),
        spaces=_spaces(grid),
        noise=float(noise),
        beside=beside,
    )


def _checked_with_stages(
    kind: str,
    f: Any,
    derivatives: dict[str, Any],
    x: Any,
    options: Options,
    convention: str | None,
    stages: Sequence[Any] | None,
    title: str = "",
) -> DerivativeCheck:
    """Check the VJP or JVP of a program, and of its stages if the whole is wrong. The title names a derivative."""
    if stages is None:
        return _checked(kind, f, derivatives, x, options, convention, title)
    chain = Chain(stages, kind)
    f, derivative = chain.completed(f, derivatives[kind])
    result = _checked(kind, f, {**derivatives, kind: derivative}, x, options, convention, title)
    if result.verdict != "disagrees":
        return result
    return _with_stage(result, chain, x, options, convention)


def _checked(
    kind: str,
    f: Any,
    derivatives: dict[str, Any],
    x: Any,
    options: Options,
    convention: str | None,
    title: str = "",
) -> DerivativeCheck:
    """Check the VJP or JVP of a program. The given derivatives, by name, take the place of its own ones."""
    name = f"check.{kind}"
    if convention is not None:
        check_choice("convention", convention, CONVENTIONS)
    own_derivatives = {word: function for word, function in derivatives.items() if function is not None}
    for word, function in own_derivatives.items():
        check_function(f"{word} of {name}", function, EXAMPLES[word], 2)
    subject = _subject(name, f, x, options.rng)
    chosen = {**subject.methods, **own_derivatives}
    program = Program(
        subject.function, subject.x, chosen.get("vjp"), chosen.get("jvp"), convention or subject.convention
    )
    if title:
        program.vjp_name = title
    both = all(word in chosen for word in DERIVATIVES)
    return _audited(DerivativeAudit(program, options, kind, both, title), kind)


def _audited(audit: DerivativeAudit, title: str) -> DerivativeCheck:
    """Run an audit and return its result."""
    start = time.perf_counter()
    audit.run()
    return _result(audit, title, time.perf_counter() - start)


def _with_stage(
    result: DerivativeCheck, chain: Chain, x: Any, options: Options, convention: str | None
) -> DerivativeCheck:
    """Return the result of a check of a program that is wrong, with the first stage that is wrong."""
    undecided = []
    for stage, point in chain.inputs(x):
        summary = _checked(chain.kind, stage.function, {chain.kind: stage.derivative}, point, options, convention)
        if summary.verdict == "disagrees":
            gaps = tuple(f"{stage.name}: {gap}" for gap in summary.gaps)
            result_gaps = tuple(f"{stage.name}: {gap}" for gap in summary.result_gaps)
            note = f"{stage.name}: {summary.reason}"
            if summary.culprit:
                note += f"; {summary.culprit}"
            notes = (f"culprit: {note}", *_gap_notes(gaps, result_gaps))
            return _changed(result, culprit=stage.name, gaps=gaps, result_gaps=result_gaps, notes=notes)
        if summary.verdict == "inconclusive":
            undecided.append((stage.name, summary.reason))
    if len(undecided) == 1:
        name, reason = undecided[0]
        note = f"culprit: {name}, as all other stages agree: {reason}"
        return _changed(result, culprit=name, notes=(note, *_gap_notes(result.gaps, result.result_gaps)))
    if undecided:
        names = ", ".join(name for name, _ in undecided)
        note = f"culprit: one of {names}, which are inconclusive, as all other stages agree"
        return _changed(result, culprit=None, notes=(note, *_gap_notes(result.gaps, result.result_gaps)))
    culprit = "the composition of the stages"
    note = (
        f"culprit: {culprit}, as each stage agrees alone: f may have other stages, or their derivatives are taken in "
        "another order or at other points"
    )
    return _changed(result, culprit=culprit, notes=(note, *_gap_notes(result.gaps, result.result_gaps)))


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


class Subject(NamedTuple):
    """What is checked: a function, its point, its own derivatives by name, and the convention of its VJP."""

    function: Any
    x: Any
    methods: dict[str, Any] = {}
    convention: str | None = None


def _subject(name: str, f: Any, x: Any, rng: np.random.Generator) -> Subject:
    """Return the function and the point of a program, which may be an operator, a module or an object with methods."""
    require_arrays(name, leaves(x))
    if isinstance(f, type):
        raise TypeError(
            f"{name} takes a function or an object, got the class {f.__name__}; write {f.__name__}(...), "
            "or one of its functions"
        )
    if isinstance(f, Operator):
        f.backend.check(name)
        return Subject(f, rng.standard_normal(f.domain.shape) if x is None else x)
    if hasattr(f, "matvec") and hasattr(f, "shape"):
        return _linear_operator(f, x, rng)
    methods = {}
    is_module = library_of(f).name == "torch" and hasattr(f, "named_parameters")
    if _is_simulator(f) and not is_module:  # a module of torch has a method `apply` for another purpose
        methods = {word: _method(f, word) for word in DERIVATIVES if hasattr(f, word)}
        f = getattr(f, "apply", f)
    check_function(name, f, f"dp.{name}(f, x=x) with a function or an object with apply and vjp")
    _require_point(name, x)
    if is_module:
        f, x = library_of(f).with_parameters(f, x)
    return Subject(f, x, methods)


def _require_point(name: str, x: Any) -> None:
    """Raise an error if no point is given."""
    if x is None:
        raise TypeError(f"{name} needs the point x at which the derivative is checked; write x=...")


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


def _linear_operator(op: Any, x: Any, rng: np.random.Generator) -> Subject:
    """Return a SciPy LinearOperator as a function with derivatives."""

    def apply(u: Any) -> Any:
        return op.matvec(u)

    def pull(u: Any, g: Any) -> Any:
        slopes = adjoint_product(op, g)
        return slopes if np.iscomplexobj(u) else np.real(slopes)

    def push(u: Any, t: Any) -> Any:
        return op.matvec(t)

    if x is None:
        x = rng.standard_normal(op.shape[1])
        if np.dtype(op.dtype or float).kind == "c":
            x = x + 1j * rng.standard_normal(op.shape[1])
    return Subject(apply, x, {"vjp": pull, "jvp": push}, "adjoint")


# ------------------------------------------------------------ the result


def _result(audit: DerivativeAudit, title: str, seconds: float) -> DerivativeCheck:
    """Return the result of an audit."""
    lines = [direction for group in audit.groups for direction in group.directions]
    digits = None
    if audit.verdict == "agrees":
        digits = min(int(line.digits) for line in lines if line.word in CONFIRMING_WORDS)
    notes = [note for word, note in audit.findings if word == "note"]
    culprit = audit.culprit
    if audit.verdict == "disagrees" and culprit is None:
        culprit = audit.program.less_precise or _other_derivative(audit, lines)
    if culprit:
        notes.append(f"culprit: {culprit}")
    notes += _gap_notes(audit.gaps, audit.result_gaps)
    return DerivativeCheck(
        kind=title,
        verdict=audit.verdict,
        reason=audit.reason,
        digits=digits,
        culprit=culprit,
        hessian=None,
        gaps=audit.gaps,
        result_gaps=audit.result_gaps,
        value=norm(audit.base),
        evaluations=sum(audit.program.runs.values()),
        runs=dict(audit.program.runs),
        seconds=seconds,
        size=audit.program.point.entries,
        result_size=audit.base.size,
        identities=tuple(audit.rows),
        notes=tuple(notes),
        lines=tuple(line.result() for line in lines),
    )


def _other_derivative(audit: DerivativeAudit, lines: Sequence[Any]) -> str | None:
    """Return a phrase if the derivative under test is right, and only the one that it is compared with is wrong."""
    other = {"vjp": "jvp", "jvp": "vjp"}[audit.kind]
    failed = [row.name for row in audit.rows if row.ok is False]
    if failed == [DUALITY] and all(line.word in CONFIRMING_WORDS for line in lines):
        return f"{other}, as {audit.title} agrees with differences"
    return None


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
    hessian : None
        An audit of `check.gradient` has a verdict on products with the Hessian here; the checks of this class have
        none.
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
    rows : tuple of dict
        One for each of these lines and each step, with the values of the first table.
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
