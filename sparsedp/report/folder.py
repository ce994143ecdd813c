"""All instruments on one scene, in one folder: Markdown, CSV and pictures, and a page that says what they say."""

import os
from functools import partial

from sparsedp.check.audit import gradient
from sparsedp.files import write_file
from sparsedp.report.certificate import certify
from sparsedp.report.extremes import stress
from sparsedp.report.plan import explain
from sparsedp.report.precision import workprec
from sparsedp.report.rows import Rows, cell, csv_text, settings_of
from sparsedp.report.source import audited

__all__ = ["write_report"]

PAGE = "report.md"
GOAL = 0.01  # the error that the page recommends a method for, in a sentence
GOALS = 0.1, GOAL, 1e-3, 1e-4, 1e-6  # and in a table
LEFT = "left out"  # in every sentence about it
MEANING = {
    "agrees": "The gradient is what differences of the loss say, and no stiff or extreme case failed.",
    "disagrees": "Something is wrong: the gradient is not what differences of the loss say, or a case below FAILED.",
    "inconclusive": "Nothing is proved: the reason stands below. This is no pass.",
}


def write_report(source, folder, force=False):
    """Scene and folder -> (verdict, sentences): "agrees", "disagrees" or "inconclusive", and what stands on the page.

    Parameters
    ----------
    source : Source
    folder : pathlib.Path
    force : bool
        Whether a report that is there may be replaced.

    Raises
    ------
    ValueError
        If there is a report already, the folder cannot be written, or the loss ends the program.
    OSError
        If a file cannot be written.
    """
    _claim(folder, force)
    with audited(source.name):
        audit = _attempt(lambda: gradient(source.loss, source.x))
        trial = _attempt(lambda: stress(source.loss, source.x, **source.stress))
        plan = _attempt(lambda: explain(source.loss, source.x))
        certificate = _attempt(lambda: certify(source.loss, source.x))
        found = _attempt(lambda: workprec(**source.workprec)) if source.workprec else None
    chapters = {
        "Is the gradient right?": _audit(audit, folder),
        "Which method for which error?": _workprec(found, folder),
        "How exact is the gradient, and how exact need the solves be?": _certificate(certificate, folder),
        "What one gradient computes": _plan(plan, folder),
        "Stiff and extreme cases": _stress(trial, folder),
    }
    verdict = _verdict(audit, trial)
    lines = [sentence for sentences in chapters.values() for sentence in sentences]
    page = "\n".join(
        [f"# {source.name}: {verdict}", "", MEANING[verdict], *_chapters(chapters, found), *_details(folder)]
    )
    write_file(folder / PAGE, page)
    return verdict, lines


def _chapters(chapters, found):
    """The page: one chapter for each question, and what was left out, from all of them, at the end."""
    left = [sentence for sentences in chapters.values() for sentence in sentences if LEFT in sentence]
    for title, sentences in chapters.items():
        yield from ("", f"## {title}", "", *(f"- {one}" for one in sentences if one not in left))
        if sentences is chapters["Which method for which error?"] and isinstance(found, Rows):
            yield from ("", *_goals(found))
    yield from ("", "## What was left out, and why", "", *(f"- {one}" for one in left), "")


def _judged_by(found):
    """The error that methods are compared by, as a column and in words: that of the gradient, where there is one."""
    errors = "gradient_error" if found.pareto() else "forward_error"
    return errors, errors.replace("_", " ")


def _goals(found):
    """The fastest method for each error, as a Markdown table."""
    errors, what = _judged_by(found)
    yield from (f"| {what} at most | fastest method | its settings | its {what} | seconds |", "|---|---|---|---|---|")
    for goal in GOALS:
        row = found.best(goal, errors)
        cells = ["none here", "", "", ""] if row is None else [
            row["method"], settings_of(row), f"{100 * row[errors]:.2g} %", f"{found.seconds(row, errors):.1e}"
        ]  # fmt: skip
        yield f"| {100 * goal:g} % | {' | '.join(map(cell, cells))} |"


def _claim(folder, force):
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"{folder} cannot be made a folder: {error.strerror}; name another with --out") from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise ValueError(f"{folder} cannot be written to; name another with --out")
    if (folder / PAGE).exists() and not force:
        raise ValueError(f"{folder / PAGE} is there already; name another folder with --out, or write --force")


def _attempt(make):
    """What an instrument gives, or the error in words: one that fails does not take the others with it."""
    try:
        return make()
    except Exception as error:  # the loss is the user's: it may raise anything
        return " ".join(f"{type(error).__name__}: {error}".split())


def _verdict(audit, trial):
    """Wrong beats open: a gradient that disagrees or a case that FAILED, then anything that was not decided."""
    if not isinstance(audit, str) and audit.verdict == "disagrees":
        return "disagrees"
    if not isinstance(trial, str) and not trial:
        return "disagrees"
    return "inconclusive" if isinstance(audit, str) or isinstance(trial, str) else audit.verdict


def _audit(audit, folder):
    if isinstance(audit, str):
        return [f"gradient: not audited, {audit}"]
    _text(folder / "audit.md", "Audit of the gradient", str(audit))
    write_file(folder / "audit.csv", _table(audit.rows))
    _picture(folder / "audit.png", lambda ax: _drawn(audit, ax))
    proved = f", {audit.digits} digits" if audit.digits is not None else ""
    words = [f"gradient: {audit.verdict}{proved}{': ' if audit.reason else ''}{audit.reason}"]
    return words + ([f"at fault: {audit.culprit}"] if audit.culprit else [])


def _drawn(audit, ax):
    from sparsedp.report.charts import v_curve

    return v_curve(audit, ax)


def _stress(trial, folder):
    if isinstance(trial, str):
        return [f"stress: not run, {trial}"]
    write_file(folder / "stress.md", f"# Stiff and extreme cases\n\n{trial.markdown()}")
    write_file(folder / "stress.csv", trial.csv())
    if trial.map is not None:
        _picture(folder / "stress.png", trial.plot)
    failed = [f"FAILED: {row['parameter']} {row['case']}: {row['note']}".replace(":  ", ": ") for row in trial.failures]
    return [trial.summary, *failed, *(f"stress left out {sentence}" for sentence in trial.left_out)]


def _plan(plan, folder):
    if isinstance(plan, str):
        return [f"plan: not made, {plan}"]
    _text(folder / "plan.md", "What was computed, and what was left out", str(plan))
    write_file(folder / "plan.csv", _table(plan.rows))
    sums = ", ".join(f"{many} {word}" for word, many in plan.totals.items() if many)
    return [f"one gradient: {sums or 'nothing was called'}", *(f"left out: {sentence}" for sentence in plan.left_out)]


def _certificate(found, folder):
    if isinstance(found, str):
        return [f"certificate: not made, {found}"]
    _text(folder / "certificate.md", "Error that solves leave", str(found))
    write_file(folder / "certificate.csv", _table(found.solves))
    return [f"error of the gradient from its solves: about {found.gradient_error:.1e}; {found.advice}"]


def _workprec(found, folder):
    if found is None:
        return [
            "error against run time: left out; the file gives no workprec_options (problem, methods, over, reference)"
        ]
    if isinstance(found, str):
        return [f"error against run time: not measured, {found}"]
    found.save(folder)
    errors, what = _judged_by(found)
    best = found.best(GOAL, errors)
    left = [f"error against run time left out {sentence}" for sentence in found.left_out]
    if best is None:
        return [f"error against run time: no method reaches a {what} of {GOAL:g}, see {found.stem}.md", *left]
    named = f"{best['method']} ({settings_of(best)}), {found.seconds(best, errors):.1e} s"
    return [f"fastest at a {what} of {100 * GOAL:g} %: {named}", *left]


def _details(folder):
    names = sorted(
        path.name for path in folder.iterdir() if path.suffix in (".md", ".csv", ".png") and path.name != PAGE
    )
    pictures = [f"![{name}]({name})" for name in names if name.endswith(".png")]
    return [
        "## Details",
        "",
        "Tables and numbers: " + ", ".join(f"[{name}]({name})" for name in names),
        "",
        *pictures,
        "",
    ]


def _text(path, title, text):
    write_file(path, f"# {title}\n\n```text\n{text}\n```\n")


def _table(rows):
    return csv_text(rows, list(rows[0]) if rows else ["nothing"])


def _picture(path, draw):
    """A picture, where matplotlib is installed."""
    try:
        from sparsedp.report import plots

        ax = draw(plots.figure().add_subplot())
        write_file(path, partial(plots.save, ax.figure))
    except ImportError:
        return
