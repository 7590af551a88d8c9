"""Time left, with a clock that does not tick by itself."""

from __future__ import annotations

import logging

import pytest

from robo_manip_baselines.benchmark.scheduler import GridProgress
from robo_manip_baselines.benchmark.work_item import WorkItem
from robo_manip_baselines.runs.progress import duration


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


def item(kind: str, name: str, seconds: float) -> WorkItem:
    return WorkItem(kind, name, "m:f", {}, seconds=seconds)


def test_time_left_follows_what_units_of_a_kind_have_taken() -> None:
    clock = Clock()
    trainings = [item("training", str(n), 100.0) for n in range(4)]
    evaluations = [item("evaluation", str(n), 10.0) for n in range(4)]
    progress = GridProgress([*trainings, *evaluations], 2, clock=clock, bar=False)
    assert (progress.fraction, progress.seconds_left) == (0.0, 220.0)
    progress.start(trainings[0])
    progress.start(trainings[1])
    clock.now += 50.0
    assert progress.seconds_left == pytest.approx((440.0 - 100.0) / 2)
    assert progress.fraction == pytest.approx(100.0 / 440.0)
    progress.end(trainings[0], 50.0)  # twice as fast as expected: the others will be, too
    assert progress.cost(trainings[2]) == 50.0
    assert progress.cost(evaluations[0]) == 10.0
    # Two trainings to come, and the one that has run for 50 s is as good as done.
    assert progress.seconds_left == pytest.approx((2 * 50.0 + 4 * 10.0) / 2)
    assert progress.fraction == pytest.approx(1.0 - 140.0 / 240.0)


def test_one_long_unit_is_waited_for_by_many_workers() -> None:
    progress = GridProgress([item("training", "a", 100.0)], 8, clock=Clock(), bar=False)
    assert progress.seconds_left == 100.0


def test_what_is_planned_later_counts_from_the_start() -> None:
    progress = GridProgress([item("training", "a", 60.0)], 2, later=40.0, clock=Clock(), bar=False)
    done = item("training", "a", 60.0)
    progress.end(done, 60.0)
    assert progress.fraction == pytest.approx(0.6)
    videos = [item("video", str(n), 10.0) for n in range(2)]
    progress.add(videos)
    assert progress.seconds_left == 10.0
    for video in videos:
        progress.end(video, None)  # failed: it is over all the same
    assert (progress.fraction, progress.seconds_left) == (1.0, 0.0)


def test_a_log_gets_few_lines_which_say_one_thing(caplog: pytest.LogCaptureFixture) -> None:
    """The share of the work and the time left; no count of items that would say another."""
    clock = Clock()
    items = [item("training", str(n), 100.0) for n in range(40)]
    with caplog.at_level(logging.INFO):
        progress = GridProgress(items, 2, later=1000.0, clock=clock)
        for first, second in zip(items[::2], items[1::2], strict=True):
            progress.start(first)
            progress.start(second)
            for _ in range(200):  # twice a second, as an executor waits
                clock.now += 0.5
                progress.show()
            progress.end(first, 100.0)
            progress.end(second, 100.0)
        progress.close()
    lines = caplog.messages
    assert 8 <= len(lines) <= 20
    assert not any("items" in line or " of " in line for line in lines)
    assert lines[0] == "0 %, 10 s, about 42 min left, training 0 and 1 more"
    assert lines[-1].startswith("80 %, 33 min, about 8 min left")
    shares = [int(line.partition(" %")[0]) for line in lines]
    assert shares == sorted(shares)


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.4, "0 s"), (89.4, "89 s"), (90.0, "2 min"), (5369.0, "89 min"), (5400.0, "1 h 30 min")],
)
def test_durations_have_a_readable_unit(seconds: float, words: str) -> None:
    assert duration(seconds) == words
