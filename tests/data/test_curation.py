"""Merging and splitting: bytes and origin are kept, mixtures refused, sources left alone."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from robo_manip_baselines.data import curation, episode_path, write_episode
from robo_manip_baselines.data.curation import (
    PROVENANCE,
    SplitRequest,
    choose_split,
    merge_datasets,
    split_dataset,
)
from robo_manip_baselines.data.demonstrations import split_episodes
from robo_manip_baselines.data.example import make_arrays, make_attributes, make_images
from robo_manip_baselines.data.verify import verify_dataset
from robo_manip_baselines.runs.errors import RequestError

SCRIPT = Path(__file__).parents[2] / "bin" / "Dataset.py"


def record(folder: Path, seeds: range, failed: int | None = None, **changes: Any) -> Path:
    for seed in seeds:
        facts = {"is_success": seed != failed, "motion_subject": f"person {seed % 3}", **changes}
        path = episode_path(folder, seed, seed != failed)
        write_episode(path, make_arrays(seed=seed), make_images(), make_attributes(seed) | facts)
    return folder


def content(folder: Path) -> dict[str, str]:
    """Relative path -> digest of every file below a folder."""
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.fixture
def sources(tmp_path: Path) -> list[Path]:
    """Seeds 0 to 3, of which 2 failed, and seeds 10 to 12."""
    return [record(tmp_path / "a", range(4), failed=2), record(tmp_path / "b", range(10, 13))]


def test_a_merge_keeps_bytes_and_says_where_from(sources: list[Path], tmp_path: Path) -> None:
    before = [content(source) for source in sources]
    copied = merge_datasets(sources, tmp_path / "out")
    assert copied.demonstrations == {tmp_path / "out": 6}
    assert copied.failures == {tmp_path / "out": 1}
    assert (copied.new, copied.duplicates) == (7, 0)
    assert [content(source) for source in sources] == before
    merged = content(tmp_path / "out")
    del merged[PROVENANCE]
    assert merged == before[0] | before[1]
    assert "failed/episode_000002.hdf5" in merged
    assert verify_dataset(tmp_path / "out") == []
    record = json.loads((tmp_path / "out" / PROVENANCE).read_text())
    assert record["operation"] == "merge"
    entry = record["episodes"]["episode_000010.hdf5"]
    assert entry["source"] == str(sources[1] / "episode_000010.hdf5")


def test_what_was_merged_before_keeps_its_history(sources: list[Path], tmp_path: Path) -> None:
    merge_datasets(sources, tmp_path / "out")
    third = record(tmp_path / "c", range(20, 21))
    merge_datasets([tmp_path / "out", third], tmp_path / "more")
    record_ = json.loads((tmp_path / "more" / PROVENANCE).read_text())
    first, second = record_["sources"]
    assert first["provenance"]["sources"][0]["folder"] == str(sources[0])
    assert second["provenance"] is None


def test_the_same_episode_is_taken_once(sources: list[Path], tmp_path: Path) -> None:
    again = record(tmp_path / "again", range(1, 2))
    copied = merge_datasets([*sources, again], tmp_path / "out")
    assert (copied.duplicates, copied.new) == (1, 7)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"control_period": 0.04}, r"control_period is 0\.04, but 0\.02 in \d other files"),
        ({"xml_hash": "1" * 64}, "xml_hash is "),
        ({"env_kwargs": {"obs": "current"}}, "env_kwargs is "),
        ({"image_codec": "jpeg"}, "two episodes of seed 1"),
    ],
)
def test_a_mixture_is_refused_before_anything_is_made(
    sources: list[Path], tmp_path: Path, changes: dict[str, Any], problem: str
) -> None:
    seeds = range(1, 2) if "image_codec" in changes else range(30, 31)
    other = record(tmp_path / "other", seeds, expert="other", **changes)
    with pytest.raises(RequestError, match=problem):
        merge_datasets([*sources, other], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_damage_is_refused(sources: list[Path], tmp_path: Path) -> None:
    os.truncate(sources[0] / "episode_000001.hdf5", 1000)
    with pytest.raises(RequestError, match=r"episode_000001\.hdf5: .*Dataset\.py verify lists all"):
        merge_datasets(sources, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("place", ["a", "a/merged", "used", "a_file"])
def test_nothing_is_written_over(sources: list[Path], tmp_path: Path, place: str) -> None:
    (tmp_path / "used").mkdir()
    (tmp_path / "used" / "thesis.txt").touch()
    (tmp_path / "a_file").touch()
    before = content(tmp_path)
    with pytest.raises(RequestError, match="--out"):
        merge_datasets(sources, tmp_path / place)
    assert content(tmp_path) == before


def test_a_folder_named_twice_and_a_single_one(sources: list[Path], tmp_path: Path) -> None:
    with pytest.raises(RequestError, match="is named twice"):
        merge_datasets([sources[0], sources[1], sources[0]], tmp_path / "out")
    with pytest.raises(RequestError, match="needs two folders"):
        merge_datasets(sources[:1], tmp_path / "out")


def test_a_stopped_merge_goes_on(
    sources: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    copy, calls = curation.shutil.copyfile, []

    def stopped(source: Path, target: Path) -> None:
        calls.append(source)
        if len(calls) == 4:
            Path(target).write_bytes(b"half of a fi")
            raise KeyboardInterrupt
        copy(source, target)

    monkeypatch.setattr(curation.shutil, "copyfile", stopped)
    with pytest.raises(KeyboardInterrupt):
        merge_datasets(sources, tmp_path / "out")
    monkeypatch.undo()
    assert verify_dataset(tmp_path / "out") == []  # three whole files
    assert merge_datasets(sources, tmp_path / "out").new == 4
    assert merge_datasets(sources, tmp_path / "out").new == 0
    whole = content(tmp_path / "out")
    record(sources[1], range(13, 14))
    with pytest.raises(RequestError, match=r"episodes of another request \(episodes differ\)"):
        merge_datasets(sources, tmp_path / "out")
    assert content(tmp_path / "out") == whole


def test_a_split_by_episode_is_that_of_training(tmp_path: Path) -> None:
    source = record(tmp_path / "a", range(10), failed=4)
    before = content(source)
    request = SplitRequest(fraction=0.3, seed=5)
    copied = split_dataset(source, tmp_path / "out", request)
    train, validation = (tmp_path / "out" / part for part in ("train", "validation"))
    assert copied.demonstrations == {train: 6, validation: 3}
    expected = split_episodes([s for s in range(10) if s != 4], 0.3, 5)
    found = json.loads((tmp_path / "out" / PROVENANCE).read_text())["split"]
    assert found == expected.to_json()
    files = content(train) | content(validation)
    assert files == {name: digest for name, digest in before.items() if "failed" not in name}
    assert sorted(content(validation)) == [f"episode_{s:06d}.hdf5" for s in expected.validation]
    assert content(source) == before
    assert split_dataset(source, tmp_path / "out", request).new == 0
    with pytest.raises(RequestError, match="another request"):
        split_dataset(source, tmp_path / "out", SplitRequest(fraction=0.3, seed=6))


def test_a_split_by_person_keeps_people_apart() -> None:
    people = {seed: f"person {seed % 7}" for seed in range(70)}
    for seed in range(5):
        split = choose_split(people, SplitRequest(0.3, seed, "person"))
        held_out = {people[s] for s in split.validation}
        assert held_out.isdisjoint({people[s] for s in split.train})
        assert len(held_out) == 2  # of seven people: two are nearer to 30 % than one or three
        assert sorted((*split.train, *split.validation)) == list(range(70))
    chosen = {choose_split(people, SplitRequest(0.3, s, "person")).validation for s in range(5)}
    assert len(chosen) > 1
    with pytest.raises(RequestError, match=r"one person \(x\) cannot be split"):
        choose_split({0: "x", 1: "x"}, SplitRequest(by="person"))
    with pytest.raises(RequestError, match="1 demonstrations cannot be split"):
        choose_split({0: "x"}, SplitRequest())


def test_a_person_with_most_episodes_leaves_some_to_train_on() -> None:
    people = dict.fromkeys(range(9), "often") | {9: "once"}
    for seed in range(10):
        split = choose_split(people, SplitRequest(0.9, seed, "person"))
        assert split.train


@pytest.mark.parametrize("change", [{"fraction": 0.0}, {"fraction": 1.0}, {"by": "clip"}])
def test_a_wrong_split_is_named(change: dict[str, Any]) -> None:
    with pytest.raises(RequestError):
        SplitRequest(**change)


def test_the_commands(sources: list[Path], tmp_path: Path) -> None:
    def run(*words: object) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, str(SCRIPT), *map(str, words)]
        return subprocess.run(command, capture_output=True, text=True, check=False)

    done = run("merge", *sources, "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert "6 demonstrations and 1 failures" in done.stdout
    done = run("split", tmp_path / "out", "--out", tmp_path / "parts", "--by", "person")
    assert done.returncode == 0, done.stderr
    assert "validation" in done.stdout
    done = run("split", tmp_path / "out", "--out", tmp_path / "out" / "parts")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
