"""Write a report on a scene: gradient check, run times, error estimates, work and stress test, in one folder.

The folder gets files in Markdown, CSV and PNG format for each of them, and a summary in two formats: report.md, which
links to these files, and report.html, which contains all results.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from sparsedp import check
from sparsedp.check.summary import Result, error_text
from sparsedp.errors import DerivativeError
from sparsedp.io.atomic_files import write_file
from sparsedp.report import plots
from sparsedp.report.certificate import certify
from sparsedp.report.explain import explain
from sparsedp.report.html_page import page, section
from sparsedp.report.scene_file import SceneFile, claim_folder, errors_as_value_error
from sparsedp.report.stress_table import stress
from sparsedp.report.work_precision import work_precision

__all__ = ["PAGES", "write_report"]

PAGES = ("report.md", "report.html")
NO_PROBLEM = "the file gives no work_precision_options (problem, methods, over)"
MEANINGS = {  # from worst to best; the report has the worst verdict of its parts
    "disagrees": "Something is wrong: the gradient is not what differences of the loss say, or a case below FAILED.",
    "inconclusive": "Nothing is proved: the reason stands below. This is no pass.",
    "agrees": "The gradient is what differences of the loss say, and no stiff or extreme case failed.",
}


def write_report(scene: SceneFile, folder: Path, force: bool = False) -> tuple[str, list[str]]:
    """Write the report on a scene.

    Parameters
    ----------
    scene : SceneFile
    folder : pathlib.Path
    force : bool
        Whether an existing report may be replaced.

    Returns
    -------
    verdict : "agrees", "disagrees" or "inconclusive"
    sentences : list of str
        The sentences of the report.

    Raises
    ------
    ValueError
        If the scene has no function, if a report exists already and `force` is not set, if the folder cannot be
        written, or if the loss ends the program.
    OSError
        If a file cannot be written.
    """
    if not callable(scene.loss):
        raise ValueError(
            f"a report is on a function that returns one number, got an object of the class {type(scene.loss).__name__}"
            "; write python -m sparsedp check for its derivative"
        )
    claim_folder(folder, PAGES, force)
    with errors_as_value_error(scene.name):
        results = [_attempt(chapter, scene) for chapter in CHAPTERS]
    verdict = _verdict_of(results)
    meaning = MEANINGS[verdict]
    degraded = getattr(results[-1], "counts", {}).get("degraded")
    if degraded:
        cases = "case is" if degraded == 1 else "cases are"
        meaning += f" {degraded} stiff or extreme {cases} degraded, see below."
    text = [f"# {scene.name}: {verdict}", "", meaning]
    lines = []
    sections = []
    missing = []
    for chapter, result in zip(CHAPTERS, results):
        files: list[Path] = []
        if isinstance(result, Result):
            sentences = [part.strip() for part in result.parts() if isinstance(part, str)]
            stem = getattr(result, "stem", chapter.stem)
            files = plots.write_result(result, folder, stem, chapter.draw(result), f"# {chapter.title}\n\n")
            sections.append(section(chapter.title, result, files, chapter.caption))
        else:
            sentences = [f"{chapter.failed}, {result}"]
            missing += sentences
        text += _chapter_in_markdown(chapter, sentences, files)
        lines += sentences
    write_file(folder / PAGES[0], "\n".join([*text, ""]))
    write_file(folder / PAGES[1], page(scene.name, verdict, meaning, sections, missing))
    return verdict, lines


def _verdict_of(results: list[Any]) -> str:
    """Return the worse verdict of the audit (the first result) and of the stress cases (the last result)."""
    verdicts = [getattr(result, "verdict", "inconclusive") for result in (results[0], results[-1])]
    return next(verdict for verdict in MEANINGS if verdict in verdicts)


def _chapter_in_markdown(chapter: Chapter, sentences: list[str], files: list[Path]) -> list[str]:
    """Return the lines of a chapter of report.md."""
    lines = ["", f"## {chapter.title}", "", *(f"- {sentence}" for sentence in sentences), ""]
    has_picture = False
    for path in files:
        link = f"[{path.name}]({path.name})"
        if path.suffix == ".png":
            has_picture = True
            link = f"!{link}"
        lines.append(link)
    if has_picture:
        lines += ["", chapter.caption]
    return lines


def _attempt(chapter: Chapter, scene: SceneFile) -> Any:
    """Return the result of a chapter, or the error as text, so that a failed chapter does not stop the others.

    Raises
    ------
    ValueError
        If the loss cannot be differentiated by reverse mode.
    """
    try:
        return chapter.run(scene.loss, scene.x, **scene.options.get(chapter.stem, {}))
    except Exception as error:  # the user's loss may raise any exception
        if isinstance(error, DerivativeError) and "traced value" in str(error):
            raise ValueError(
                "its code is for NumPy arrays only, and a report is on gradients by reverse mode; write it with "
                "autograd.numpy, or write python -m sparsedp check with --gradient NAME"
            ) from error
        return error_text(error)


def _measure_work_precision(loss: Any, x: Any, **options: Any) -> Any:
    """Return the result of `work_precision`, or a sentence if the file defines no options for it."""
    if not options:
        return NO_PROBLEM
    return work_precision(**options)


def _draw_nothing(result: Any) -> None:
    """Return None: the chapter has no plot."""


def _draw_v_curve(audit: Any) -> Callable[[Any], Any]:
    """Return the function that plots the V-curve of an audit on axes."""
    return partial(plots.v_curve, audit)


def _draw_stability_map(stress_result: Any) -> Callable[[Any], Any] | None:
    """Return the function that plots the stability map; None if there is no map."""
    if stress_result.map:
        return stress_result.plot
    return None


def _draw_rows(rows: Any) -> Callable[[Any], Any]:
    """Return the function that plots error against run time on axes."""
    return rows.plot


class Chapter(NamedTuple):
    """A chapter of the report.

    Attributes
    ----------
    stem : str
        Name of its files, without suffix.
    title : str
    failed : str
        Beginning of the sentence that is written if there is no result.
    run : callable
        ``run(loss, x, **options)`` returns a Result, or a sentence that says why there is none.
    draw : callable
        ``draw(result)`` returns a function that plots the result on axes, or None.
    caption : str
        How to read the plot.
    """

    stem: str
    title: str
    failed: str
    run: Callable[..., Any]
    draw: Callable[[Any], Any] = _draw_nothing
    caption: str = ""


CHAPTERS = (
    Chapter(
        "audit",
        "Is the gradient right?",
        "gradient: not audited",
        check.gradient,
        _draw_v_curve,
        "Each curve is a direction. For a right gradient it falls with the step, from the right to the left, until "
        "rounding lifts it: a V. For a wrong one it stays up: a plateau.",
    ),
    Chapter(
        "work_precision",
        "Which method for which error?",
        "error against run time: not measured",
        _measure_work_precision,
        _draw_rows,
        "Further to the left is faster, further down is more accurate. The grey band joins the best runs: no other "
        "one is both faster and more accurate.",
    ),
    Chapter(
        "certificate",
        "How exact is the gradient, and how exact need the solves be?",
        "certificate: not computed",
        certify,
    ),
    Chapter("plan", "Work of one gradient", "plan: not computed", explain),
    Chapter(
        "stress",
        "Stiff and extreme cases",
        "stress: not run",
        stress,
        _draw_stability_map,
        "How much a small change grows in one step, over viscosity (across) and time step (up): above 1 the step "
        "is unstable, grey ones are refused, the star is where the scene is.",
    ),
)
