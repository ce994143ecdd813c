"""The plugin of pytest: fixtures `assert_gradient` and `assert_transpose`, and the options of their reports.

pytest loads this module in every project of an environment in which sparsedp is installed (entry point `pytest11`).
It therefore imports nothing but the standard library and pytest until a fixture is used.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

__all__ = ["GradientCheck", "GradientChecks", "annotation"]

CHECKS = pytest.StashKey["list[dict[str, Any]]"]()  # the checks of a test, in the order of the calls
ANNOTATIONS = ("auto", "github", "none")
LONGEST_LINE = 110  # characters of a line of the summary


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options ``--gradients`` and ``--gradients-annotations``."""
    group = parser.getgroup("gradients", "checks of gradients (sparsedp)")
    group.addoption(
        "--gradients",
        action="store_true",
        help="examine all directions in assert_gradient, show the tables of failures, and list all checks at the end",
    )
    group.addoption(
        "--gradients-annotations",
        choices=ANNOTATIONS,
        default="auto",
        help="print failed checks as annotations: of GitHub Actions, none, or as the environment says (default: auto)",
    )


# ------------------------------------------------------------ fixtures


class GradientCheck(NamedTuple):
    """One call of `assert_gradient` or `assert_transpose` in a test.

    Attributes
    ----------
    test : str
        Node id of the test.
    kind : str
        "gradient", "vjp", "jvp", "jacobian", "hessian" or "transpose".
    verdict : "agrees", "disagrees" or "inconclusive"
    digits : int or None
        Digits that agree.
    runs : int or None
        Evaluations of the functions.
    seconds : float
    message : str
        Reason and wrong entries, if the verdict is not "agrees".
    file : str
        Path of the test, relative to the root of the project.
    line : int
    passed : bool
        Whether the assertion holds: an inconclusive check may be allowed.
    """

    test: str
    kind: str
    verdict: str
    digits: int | None
    runs: int | None
    seconds: float
    message: str
    file: str
    line: int
    passed: bool


class GradientChecks:
    """The checks of one test: both fixtures call it, and it writes down each result.

    Parameters
    ----------
    item : pytest.Item
        The test.
    """

    def __init__(self, item: pytest.Item) -> None:
        self.item = item
        self.is_complete = bool(item.config.getoption("--gradients"))
        item.stash.setdefault(CHECKS, [])

    def assert_gradient(
        self, f: Any, x: Any = None, *, quick: bool | None = None, allow_inconclusive: bool = False, **options: Any
    ) -> Any:
        """Call `sparsedp.testing.assert_gradient`; the check is complete with the option ``--gradients``."""
        from sparsedp.check.choice import check_derivative
        from sparsedp.testing.assertions import raise_unless_accepted

        __tracebackhide__ = True
        if quick is None:
            quick = not self.is_complete
        start = time.perf_counter()
        result = check_derivative(f, x, quick=quick, **options)
        is_accepted = bool(result) or (allow_inconclusive and result.verdict == "inconclusive")
        self._note(result, time.perf_counter() - start, sys._getframe(1), is_accepted)
        raise_unless_accepted(result, allow_inconclusive, complete=not quick)
        return result

    def assert_transpose(self, op: Any, transpose: Callable[[Any], Any] | None = None, **options: Any) -> Any:
        """Call `sparsedp.testing.assert_transpose`."""
        from sparsedp.testing.assertions import check_transpose_of, raise_unless_accepted

        __tracebackhide__ = True
        start = time.perf_counter()
        result = check_transpose_of(op, transpose, **options)
        self._note(result, time.perf_counter() - start, sys._getframe(1), bool(result))
        raise_unless_accepted(result)
        return result

    def _note(self, result: Any, seconds: float, frame: Any, is_accepted: bool) -> None:
        """Write down a check: for the reports of this plugin, and as properties of the test in a JUnit file."""
        from sparsedp.testing.assertions import kind_of, reason_of

        check = GradientCheck(
            test=self.item.nodeid,
            kind=kind_of(result),
            verdict=result.verdict,
            digits=getattr(result, "digits", None),
            runs=getattr(result, "evaluations", None),
            seconds=round(seconds, 6),
            message="" if is_accepted else reason_of(result),
            file=_relative(frame.f_code.co_filename, self.item.config.rootpath),
            line=frame.f_lineno,
            passed=is_accepted,
        )
        checks = self.item.stash[CHECKS]
        checks.append(check._asdict())
        for name in ("kind", "verdict", "digits", "runs", "seconds"):
            value = getattr(check, name)
            if value is not None:
                self.item.user_properties.append((f"gradient_{len(checks)}_{name}", value))


def _relative(file: str, root: Path) -> str:
    """Return a path relative to the root of the project, with slashes; unchanged if it lies elsewhere."""
    try:
        return Path(file).resolve().relative_to(root).as_posix()
    except ValueError:
        return file


@pytest.fixture
def assert_gradient(request: pytest.FixtureRequest) -> Callable[..., Any]:
    """Return `sparsedp.testing.assert_gradient`, whose checks appear in the reports of pytest."""
    return GradientChecks(request.node).assert_gradient


@pytest.fixture
def assert_transpose(request: pytest.FixtureRequest) -> Callable[..., Any]:
    """Return `sparsedp.testing.assert_transpose`, whose checks appear in the reports of pytest."""
    return GradientChecks(request.node).assert_transpose


# ------------------------------------------------------------ reports


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: Any) -> Generator[None, Any, None]:
    """Attach the checks of a test to its report, which pytest-xdist sends to the process that prints the summary."""
    outcome = yield
    if call.when == "call":
        outcome.get_result().gradient_checks = item.stash.get(CHECKS, [])


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    """Print the table of all checks with ``--gradients``, and the annotations of failed ones."""
    reports = [report for group in terminalreporter.stats.values() for report in group]
    checks = [GradientCheck(**data) for report in reports for data in getattr(report, "gradient_checks", [])]
    checks.sort(key=lambda check: check.test)
    if config.getoption("--gradients") and checks:
        terminalreporter.section("gradients")
        for line in _summary(checks):
            terminalreporter.write_line(line)
    if _is_on_github(config):
        for check in checks:
            if not check.passed:
                terminalreporter.write_line(annotation(check))


def _is_on_github(config: pytest.Config) -> bool:
    """Return whether failed checks are printed as annotations of GitHub Actions."""
    chosen = config.getoption("--gradients-annotations")
    return chosen == "github" or (chosen == "auto" and os.environ.get("GITHUB_ACTIONS") == "true")


def _summary(checks: list[GradientCheck]) -> list[str]:
    """Return one line for each check: verdict, digits, runs, seconds, kind and test; and a line with the totals."""
    lines = [f"{'verdict':<12} {'digits':>6} {'runs':>6} {'seconds':>8}  check"]
    for check in checks:
        digits = "-" if check.digits is None else check.digits
        runs = "-" if check.runs is None else check.runs
        line = f"{check.verdict:<12} {digits:>6} {runs:>6} {check.seconds:>8.2f}  {check.kind} in {check.test}"
        lines.append(line if len(line) <= LONGEST_LINE else f"{line[: LONGEST_LINE - 3]}...")
    failed = sum(not check.passed for check in checks)
    lines.append(f"{len(checks)} checks, {failed} failed, {sum(check.seconds for check in checks):.2f} s")
    return lines


def annotation(check: GradientCheck) -> str:
    """Return a failed check as a workflow command of GitHub Actions, which shows it beside the line of the test."""
    return (
        f"::error file={_escaped(check.file, property=True)},line={check.line},"
        f"title={_escaped(f'{check.kind} {check.verdict}', property=True)}::{_escaped(check.message)}"
    )


def _escaped(text: str, property: bool = False) -> str:
    """Escape the characters that end a message, or a property, of a workflow command."""
    text = text.replace("%", "%25").replace("\r", "%0D").replace("\n", "%0A")
    if property:
        text = text.replace(":", "%3A").replace(",", "%2C")
    return text
