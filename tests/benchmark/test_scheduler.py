"""The order in which items are done, and what happens when one fails; nothing is run."""

from __future__ import annotations

import random
from collections.abc import Iterable
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robo_manip_baselines.benchmark.scheduler import (
    GridProgress,
    ItemsFailedError,
    WorkResult,
    run_items,
)
from robo_manip_baselines.benchmark.work_item import ArtifactStore, WorkItem
from robo_manip_baselines.runs.errors import RequestError


def item(name: str, *needs: WorkItem, kind: str = "training") -> WorkItem:
    return WorkItem(kind, name, "m:f", {}, needs=needs)


def grid() -> list[WorkItem]:
    data = [item(f"d{n}", kind="demonstrations") for n in range(2)]
    runs = [item(f"t{n}", *data) for n in range(3)]
    return [*data, *runs, *(item(f"e{n}", run) for n, run in enumerate(runs) for _ in range(1))]


class Fake:
    """Ends items in a random order; each of them makes one file."""

    def __init__(
        self, store: ArtifactStore, room: int, seed: int, fails: Iterable[str] = ()
    ) -> None:
        self.store, self.room, self.rng = store, room, random.Random(seed)
        self.fails, self.code = set(fails), 1
        self.running: list[WorkItem] = []
        self.started: list[str] = []

    def has_room(self, item: WorkItem) -> bool:
        return len(self.running) < self.room

    def start(self, item: WorkItem) -> None:
        assert all(self.store.is_done(need) for need in item.needs)
        assert len(self.running) < self.room
        self.running.append(item)
        self.started.append(item.name)

    def wait(self) -> Iterable[WorkResult]:
        ended = self.running.pop(self.rng.randrange(len(self.running)))
        if ended.name in self.fails:
            return [WorkResult(ended, "it broke", self.code)]
        self.store.commit(ended, {"made": b"x"}, 1.0, "log")
        return [WorkResult(ended)]

    def close(self) -> None:
        self.running = []


def run(items: list[WorkItem], fake: Fake) -> None:
    run_items(items, fake.store, fake, GridProgress(items, fake.room, bar=False))


@settings(max_examples=12)  # each of them waits for the disk some twenty times
@given(st.integers(1, 5), st.integers(0, 1000))
def test_every_unit_is_done_once_after_what_it_needs(
    tmp_path_factory: pytest.TempPathFactory, room: int, seed: int
) -> None:
    items, store = grid(), ArtifactStore(tmp_path_factory.mktemp("items"))
    fake = Fake(store, room, seed)
    run(items, fake)
    assert sorted(fake.started) == sorted(u.name for u in items)
    again = Fake(store, room, seed)
    run(items, again)
    assert again.started == []


def test_a_failure_keeps_only_from_being_done_what_needs_it(tmp_path: Path) -> None:
    items, store = grid(), ArtifactStore(tmp_path)
    with pytest.raises(ItemsFailedError, match=r"1 work items failed.*training t1"):
        run(items, Fake(store, 2, 0, fails=["t1"]))
    missing = [u.name for u in items if not store.is_done(u)]
    assert missing == ["t1", "e1"]
    again = Fake(store, 2, 0)
    run(items, again)
    assert again.started == ["t1", "e1"]


def test_nothing_is_done_without_what_failed_however_far_it_is_away(tmp_path: Path) -> None:
    fake = Fake(ArtifactStore(tmp_path), 1, 0, fails=["d0"])
    with pytest.raises(ItemsFailedError, match="demonstrations d0"):
        run(grid(), fake)
    assert fake.started == ["d0", "d1"]


def test_a_wrong_request_ends_everything_with_its_own_words(tmp_path: Path) -> None:
    fake = Fake(ArtifactStore(tmp_path), 1, 0, fails=["d0"])
    fake.code = 2
    with pytest.raises(RequestError, match="demonstrations d0: it broke"):
        run(grid(), fake)
    assert fake.started == ["d0"]


def test_a_need_that_nobody_does_is_an_error_not_a_wait(tmp_path: Path) -> None:
    data = item("d", kind="demonstrations")
    with pytest.raises(ValueError, match="neither done nor given"):
        run([item("t", data)], Fake(ArtifactStore(tmp_path), 1, 0))


def test_a_need_that_was_done_before_need_not_be_given(tmp_path: Path) -> None:
    store, data = ArtifactStore(tmp_path), item("d", kind="demonstrations")
    run([data], Fake(store, 1, 0))
    run([item("t", data)], Fake(store, 1, 0))


def test_what_is_done_is_not_written_again(tmp_path: Path) -> None:
    store, one = ArtifactStore(tmp_path), item("a")
    store.commit(one, {"made": b"x"}, 1.0, "")
    store.commit(one, {"made": b"y"}, 2.0, "")
    assert store.outputs(one)["made"].read_bytes() == b"x"


def test_a_unit_whose_file_is_gone_is_not_done(tmp_path: Path) -> None:
    store, one = ArtifactStore(tmp_path), item("a")
    store.commit(one, {"deep/made": b"x"}, 1.0, "")
    assert store.outputs(one)["deep/made"].read_bytes() == b"x"
    store.outputs(one)["deep/made"].unlink()
    assert not store.is_done(one)


@pytest.mark.parametrize("damage", ["", "{", "[]", '{"key": "other", "files": []}'])
def test_a_damaged_note_means_that_the_unit_is_not_done(damage: str, tmp_path: Path) -> None:
    store, one = ArtifactStore(tmp_path), item("a")
    store.commit(one, {"made": b"x"}, 1.0, "")
    (store.folder(one) / "item.json").write_text(damage)
    assert not store.is_done(one)
