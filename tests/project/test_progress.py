"""Bars on a terminal, a bounded number of lines elsewhere."""

from __future__ import annotations

import io
import itertools
import logging
import re
import sys
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robo_manip_baselines.runs import progress
from robo_manip_baselines.runs.progress import EpisodeProgress, ProgressBar, StepProgress, track


class Clock:
    """Time that passes where a test says so."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def lines_of(step_seconds: float, steps: int, caplog: pytest.LogCaptureFixture) -> list[str]:
    clock = Clock()
    caplog.clear()
    with caplog.at_level(logging.INFO), ProgressBar(steps, "step", "x", clock=clock) as bar:
        for _ in range(steps):
            clock.now += step_seconds
            bar.advance()
    return caplog.messages


def test_a_log_gets_a_line_for_each_tenth(
    caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    lines = lines_of(1.0, 1000, caplog)
    assert lines[0] == "x: 1 % of 1000 steps, 10 s, about 16 min left"
    assert "x: 10 % of 1000 steps, 2 min, about 15 min left" in lines
    assert lines[-1] == "x: 100 % of 1000 steps, 17 min"
    assert capfd.readouterr() == ("", "")  # of the bar itself nothing


def test_a_short_task_says_nothing(caplog: pytest.LogCaptureFixture) -> None:
    assert lines_of(0.009, 1000, caplog) == []


@settings(max_examples=40, deadline=None)
@given(seconds=st.floats(1e-3, 1e6), steps=st.integers(1, 500))
def test_the_number_of_lines_is_bounded(seconds: float, steps: int) -> None:
    """Tenths, and doublings of the time from 10 s on: 26 of them are twenty years."""
    log = logging.getLogger("robo_manip_baselines.runs.progress")
    found: list[str] = []
    handler = logging.Handler()
    handler.emit = lambda record: found.append(record.getMessage())  # type: ignore[method-assign]
    log.addHandler(handler)
    before, _ = log.level, log.setLevel(logging.INFO)
    try:
        clock = Clock()
        with ProgressBar(steps, "step", clock=clock) as bar:
            for _ in range(steps):
                clock.now += seconds
                bar.advance()
    finally:
        log.removeHandler(handler)
        log.setLevel(before)
    assert len(found) <= progress.LINES + 2 + 26


def test_a_terminal_gets_a_bar_and_no_lines(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(sys, "stderr", terminal := Terminal())
    with caplog.at_level(logging.INFO):
        assert list(track(range(3), 3, "frame", "clip.mp4")) == [0, 1, 2]
    assert "3/3" in terminal.getvalue()
    assert "clip.mp4" in terminal.getvalue()
    assert caplog.messages == []


@pytest.mark.parametrize("is_terminal", [False, True])
def test_nothing_is_shown_where_nothing_was_asked_for(
    is_terminal: bool, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(progress, "FIRST_LINE", 0.0)
    monkeypatch.setattr(sys, "stderr", stream := Terminal() if is_terminal else io.StringIO())
    with caplog.at_level(logging.INFO):
        list(track(range(100), 100, "frame", shown=False))
    assert stream.getvalue() == ""
    assert caplog.messages == []


def test_the_loss_stands_beside_the_steps(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(progress, "FIRST_LINE", 0.0)
    with caplog.at_level(logging.INFO), StepProgress(20, 10, 5.0, shown=True) as steps:
        steps.report(0.25)
        for _ in range(10):
            steps.advance()
    assert steps.step == 20
    assert steps.seconds >= 5.0
    assert re.fullmatch(r"100 % of 20 steps, \d+ s, loss 0\.25", caplog.messages[-1])


def test_running_episodes_move_the_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", Terminal())
    shown: list[float] = []
    monkeypatch.setattr(ProgressBar, "move_to", lambda self, done: shown.append(done))
    with EpisodeProgress(4, 100, "reactive") as bar:
        for _ in range(2):  # two at once, then two at once
            for _ in range(50):
                bar.step(2)
            bar.end(50)
            bar.end(50)
    assert shown == sorted(shown)
    assert 0.0 < shown[0] < 0.05
    assert max(b - a for a, b in itertools.pairwise(shown)) <= 1.5
    assert shown.index(4) >= len(shown) - 1  # full when the last one has ended, not before


def test_only_one_module_draws_bars(repository: Path) -> None:
    users = [
        path.relative_to(repository).as_posix()
        for folder in ("robo_manip_baselines", "face_prediction")
        for path in (repository / folder).rglob("*.py")
        if re.search(r"^\s*(from tqdm import|import tqdm)", path.read_text("utf-8"), re.MULTILINE)
    ]
    assert users == ["robo_manip_baselines/runs/progress.py"]
