"""Audits of slow losses: fewer directions and what they leave open, and what a terminal shows on the way."""

import io
import sys
import time

import autograd.numpy as np
import pytest

import sparsedp as dp
from sparsedp.__main__ import main
from sparsedp.autodiff.tape import isbox


def counted(loss):
    """The loss, and a list that grows by one with each evaluation on plain values."""
    calls = []

    def told(x):
        if not isbox(x):
            calls.append(None)
        return loss(x)

    return told, calls


def test_a_quick_audit_needs_a_third_and_lists_what_it_did_not_examine():
    x = {"a": np.linspace(1.0, 2.0, 5), "b": np.linspace(-1.0, 1.0, 4)}

    def loss(x):
        return np.sum(np.sin(x["a"])) ** 2 + np.sum(np.exp(x["b"])) * np.sum(x["a"])

    whole = dp.check.gradient(loss, x)
    quick = dp.check.gradient(loss, x, quick=True)
    assert whole.verdict == quick.verdict == "agrees"
    assert 3 * quick.evaluations <= whole.evaluations + 10
    assert [one.direction for one in quick.lines] == ["random 1", "gradient"]
    limits = (
        "quick: looked at along random 1 and gradient; other directions, single leaves and entries, complex steps and "
        "the Hessian product were not looked at"
    )
    assert quick.reason == limits
    assert str(quick).endswith(f"verdict: agrees to {quick.digits} digits: {limits}")
    assert str(quick).count(limits) == 1
    assert whole.reason == "" and "quick" not in str(whole)


def test_a_quick_audit_finds_a_wrong_gradient_and_misses_what_it_says():
    x = np.linspace(1.0, 2.0, 50)
    wrong = dp.check.gradient(lambda u: np.sum(u**3), x, gradient=lambda u: 3.003 * u**2, quick=True)
    assert wrong.verdict == "disagrees" and "quick: looked at along" in str(wrong)
    bare = dp.check.gradient(lambda u: np.sum(u**3), x, quick=True, directions=0)
    assert "quick: looked at along gradient; other directions" in bare.reason


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.mark.parametrize("quick", [False, True])
def test_a_terminal_shows_the_expected_number_of_evaluations(quick, monkeypatch):
    told, calls = counted(lambda x: np.sum(np.sin(x)))
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    result = dp.check.gradient(told, np.linspace(1.0, 2.0, 5), quick=quick)
    first = screen.getvalue().splitlines()[0]
    named = int(first.removeprefix("check.gradient: about ").removesuffix(" evaluations of the loss to come"))
    assert 0.9 * result.evaluations <= named <= 1.3 * result.evaluations
    assert abs(len(calls) - result.evaluations) <= 3  # complex steps come on top


def test_a_terminal_without_tqdm_gets_the_first_line_only(monkeypatch):
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    monkeypatch.setitem(sys.modules, "tqdm.auto", None)
    dp.check.gradient(lambda x: np.sum(np.sin(x)), np.linspace(1.0, 2.0, 5))
    assert len(screen.getvalue().splitlines()) == 1


def test_with_tqdm_there_is_a_bar(monkeypatch):
    """It is closed at the end, also if the loss raises: a later bar is not pushed down a line."""
    tqdm = pytest.importorskip("tqdm").tqdm
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    result = dp.check.gradient(lambda x: time.sleep(0.002) or np.sum(np.sin(x)), np.linspace(1.0, 2.0, 5))
    assert "evaluation/s" in screen.getvalue()
    with tqdm(total=1) as later:
        assert result and later.pos == 0
    with pytest.raises(LookupError, match="no such key"):
        dp.check.gradient(lambda x: fails(), np.linspace(1.0, 2.0, 5))
    with tqdm(total=1) as later:
        assert later.pos == 0


def fails():
    raise LookupError("no such key")


def test_nothing_is_shown_without_a_terminal(capsys):
    dp.check.gradient(lambda x: np.sum(np.sin(x)), np.linspace(1.0, 2.0, 5))
    assert capsys.readouterr() == ("", "")


def test_quick_from_the_shell(tmp_path, capsys):
    (tmp_path / "scene.py").write_text(
        "import autograd.numpy as np\nx = np.linspace(1.0, 2.0, 5)\n\ndef loss(x):\n    return np.sum(np.sin(x))\n"
    )
    assert main(["check", f"{tmp_path / 'scene.py'}:loss", "--quick"]) == 0
    assert "quick: looked at along random 1 and gradient" in capsys.readouterr().out
