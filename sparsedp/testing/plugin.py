"""The plugin of pytest: fixtures `assert_gradient` and `assert_transpose`, and the reports of all checks of a test.

pytest loads this module in every project of an environment in which sparsedp is installed (entry point `pytest11`).
It therefore imports nothing but the standard library and pytest until a fixture is used.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from sparsedp.testing.observers import OBSERVERS

__all__ = ["GradientCheck", "GradientChecks", "annotation"]

CHECKS = pytest.StashKey["list[dict[str, Any]]"]()  # the checks of a test, in the order of the calls
ANNOTATIONS = ("auto", "github", "none")


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
    times : int
        Number of calls of this line in the test.
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
    times: int = 1


VERDICTS = ("agrees", "inconclusive", "disagrees")  # from best to worst
PROPERTIES = ("kind", "verdict", "digits", "runs", "seconds", "times")


class GradientChecks:
    """The observer of a test: it writes down each check, for the reports and as properties in a JUnit file.

    Checks of the same line are one entry, so that a loop, or a test with many examples of hypothesis, has one.

    Parameters
    ----------
    item : pytest.Item
        The test.
    """

    def __init__(self, item: pytest.Item) -> None:
        self.item = item
        self.is_complete = bool(item.config.getoption("--gradients"))
        self.checks: dict[tuple[str, str, int], GradientCheck] = {}

    def note(self, result: Any, seconds: float, is_accepted: bool, file: str, line: int) -> None:
        """Note the result of a check that the given line of a file has called."""
        from sparsedp.testing.assertions import kind_of, reason_of

        check = GradientCheck(
            test=self.item.nodeid,
            kind=kind_of(result),
            verdict=result.verdict,
            digits=getattr(result, "digits", None),
            runs=getattr(result, "evaluations", None),
            seconds=round(seconds, 6),
            message="" if is_accepted else reason_of(result),
            file=_relative(file, self.item.config.rootpath),
            line=line,
            passed=is_accepted,
        )
        key = check.kind, check.file, check.line
        if key in self.checks:
            check = _together(self.checks[key], check)
        self.checks[key] = check
        self.item.stash[CHECKS] = [entry._asdict() for entry in self.checks.values()]
        others = [entry for entry in self.item.user_properties if not entry[0].startswith("gradient_")]
        self.item.user_properties[:] = [*others, *self._properties()]

    def _properties(self) -> list[tuple[str, object]]:
        """Return the properties of the test for a JUnit file."""
        properties: list[tuple[str, object]] = []
        for number, check in enumerate(self.checks.values(), start=1):
            for name in PROPERTIES:
                value = getattr(check, name)
                if value is not None:
                    properties.append((f"gradient_{number}_{name}", value))
        return properties


def _together(first: GradientCheck, second: GradientCheck) -> GradientCheck:
    """Return one entry for two checks of the same line: the worse verdict, and the last message."""
    verdict = max(first.verdict, second.verdict, key=VERDICTS.index)
    digits = None
    if first.digits is not None and second.digits is not None:
        digits = min(first.digits, second.digits)
    runs = None
    if first.runs is not None and second.runs is not None:
        runs = first.runs + second.runs
    return second._replace(
        verdict=verdict,
        digits=digits,
        runs=runs,
        seconds=round(first.seconds + second.seconds, 6),
        message=second.message or first.message,
        passed=first.passed and second.passed,
        times=first.times + second.times,
    )


def _relative(file: str, root: Path) -> str:
    """Return a path relative to the root of the project, with slashes; unchanged if it lies elsewhere."""
    try:
        return Path(file).resolve().relative_to(root).as_posix()
    except ValueError:
        return file


@pytest.fixture
def assert_gradient() -> Callable[..., Any]:
    """Return `sparsedp.testing.assert_gradient`."""
    from sparsedp import testing

    return testing.assert_gradient


@pytest.fixture
def assert_transpose() -> Callable[..., Any]:
    """Return `sparsedp.testing.assert_transpose`."""
    from sparsedp import testing

    return testing.assert_transpose


# ------------------------------------------------------------ reports


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, Any, None]:
    """Observe the checks of a test, whether they are called by a fixture or as functions."""
    observer = GradientChecks(item)
    OBSERVERS.append(observer)
    try:
        yield
    finally:
        OBSERVERS.remove(observer)


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: Any) -> Generator[None, Any, None]:
    """Attach the checks of a test to its report, which pytest-xdist sends to the process that prints the summary."""
    outcome = yield
    if call.when == "call" or (call.when == "setup" and call.excinfo is not None):
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
        times = f", {check.times} times" if check.times > 1 else ""
        numbers = f"{check.verdict:<12} {digits:>6} {runs:>6} {check.seconds:>8.2f}"
        lines.append(f"{numbers}  {check.kind} in {check.test}{times}")
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
