"""Results on disk: whole lines, never twice the same seed, never of two settings."""

from __future__ import annotations

import contextlib
import json
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from robo_manip_baselines.observation import ObservationSpec
from robo_manip_baselines.rollout.results import (
    MANIFEST,
    RESULTS,
    EpisodeResult,
    ResultsFile,
    open_results,
    read_results,
)
from robo_manip_baselines.runs.errors import RequestError

SETTINGS = {"env": "a/FeedingEnv-v0", "acting": {"execute": 1}, "size": (480, 640)}
MISS = EpisodeResult(
    env="FeedingEnv",
    seed=1003,
    is_success=False,
    is_success_strict=False,
    completion_time=None,
    steps=600,
    failure="missed_low",
    motion_clip="clip",
    motion_subject="person",
    columns={
        "time_since_lift": 8.02,
        "closest_distance": 0.0123,
        "closest_offset": (0.001, -0.002, -0.012),
        "cube_offset": (-0.011, -0.003, -0.01),
        "face_force": 1.5,
        "force_time_1": 0.5,
        "force_time_10": 0.02,
        "force_time_30": 0.0,
        "dwell": 0.12,
    },
    policy="Act",
    condition="current_pred_h2",
    observation=ObservationSpec("current_pred").to_json() | {"cameras": [], "image_size": [48, 64]},
    train_seed=0,
    checkpoint="ab12",
    versions={"numpy": "2"},
)
NEVER = replace(
    MISS,
    seed=1001,
    failure="never_grasped",
    columns={**dict.fromkeys(MISS.columns), "face_force": 0.0},
)
HIT = replace(MISS, seed=1002, is_success=True, completion_time=4.0, failure="")


@pytest.mark.parametrize("result", [MISS, NEVER, HIT])
def test_a_line_gives_the_result_back(result: EpisodeResult) -> None:
    line = result.to_line()
    assert "\n" not in line
    assert EpisodeResult.from_line(line) == result


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seed": "3"}, "seed: must be a whole number, not '3'"),
        ({"seed": True}, "seed: must be a whole number, not true"),
        ({"is_success": 1}, "is_success: must be true or false, not 1"),
        ({"closest_offset": [0.0, 0.0]}, r"closest_offset\[2\]: is missing"),
        ({"cube_offset": 0.0}, "cube_offset: must be a list, not 0.0"),
        ({"failure": "bored"}, "failure 'bored': unknown; valid: "),
        ({"versions": {"numpy": 2}}, "versions.numpy: must be text, not 2"),
        ({"observation": 3}, "observation: must be an object, not 3"),
        ({"version": 4}, "version 4; this release reads 1 to 3"),
        ({"settings": 3}, "settings: must be an object, not 3"),
        ({"motion": None}, "motion: must be text, not null"),
        ({"mood": "good"}, "unknown name 'mood'"),
    ],
)
def test_a_line_of_another_form_is_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        EpisodeResult.from_line(json.dumps({**json.loads(MISS.to_line()), **changes}))


def test_a_line_without_a_field_is_refused() -> None:
    values = json.loads(MISS.to_line())
    del values["face_force"]
    with pytest.raises(ValueError, match="face_force: is missing"):
        EpisodeResult.from_line(json.dumps(values))


def test_a_line_of_an_earlier_release_lacks_what_was_not_measured() -> None:
    values = json.loads(MISS.to_line())
    added = ("force_time_1", "force_time_10", "force_time_30", "dwell")
    for name in added:
        del values[name]
    read = EpisodeResult.from_line(json.dumps(values))
    assert read == replace(MISS, columns={**MISS.columns, **dict.fromkeys(added)})
    assert EpisodeResult.from_line(read.to_line()) == read


def test_numbers_that_json_does_not_know_are_not_written() -> None:
    with pytest.raises(ValueError, match="JSON"):
        replace(MISS, columns={**MISS.columns, "face_force": float("nan")}).to_line()


def test_rows_of_version_1_and_2_are_read() -> None:
    moved = replace(MISS, motion="sway:amplitude=0.03")
    assert EpisodeResult.from_line(moved.to_line()) == moved
    values = json.loads(MISS.to_line())
    del values["settings"], values["motion"]
    values["version"] = 2
    assert EpisodeResult.from_line(json.dumps(values)) == MISS
    del values["version"], values["observation"]
    values["arm"] = values.pop("condition")
    assert EpisodeResult.from_line(json.dumps(values)) == replace(MISS, observation=None)


def open_file(folder: Path, **changes: Any) -> AbstractContextManager[ResultsFile]:
    return open_results(folder, {**SETTINGS, **changes}, {"condition": "current"})


def test_lines_are_there_at_once_and_by_seed_in_the_end(tmp_path: Path) -> None:
    with open_file(tmp_path) as file:
        file.append(MISS)
        assert (tmp_path / RESULTS).read_text() == MISS.to_line() + "\n"
        file.append(NEVER)
        assert file.of([1001, 1002, 1003]) == [NEVER, MISS]
    assert read_results(tmp_path) == [NEVER, MISS]
    lines = (tmp_path / RESULTS).read_text().splitlines()
    assert lines == [NEVER.to_line(), MISS.to_line()]
    manifest = json.loads((tmp_path / MANIFEST).read_text())
    assert manifest["condition"] == "current"


@pytest.mark.parametrize("cut", [1, 50, 10_000])
def test_a_killed_run_goes_on(tmp_path: Path, cut: int) -> None:
    with contextlib.suppress(KeyboardInterrupt), open_file(tmp_path) as file:
        file.append(MISS)
        raise KeyboardInterrupt
    torn = HIT.to_line()[:-1][:cut]
    with (tmp_path / RESULTS).open("a") as stream:
        stream.write(torn)
    assert read_results(tmp_path) == [MISS]
    with open_file(tmp_path) as file:
        assert file.done == {1003: MISS}
        file.append(HIT)
        # Whole at every moment, for it may be killed again.
        assert (tmp_path / RESULTS).read_text() == f"{MISS.to_line()}\n{HIT.to_line()}\n"
        file.append(NEVER)
    assert read_results(tmp_path) == [NEVER, HIT, MISS]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"acting": {"execute": 2}}, r"holds results with acting \{'execute': 1\}, not"),
        ({"checkpoint": "ff"}, "holds results with checkpoint None, not ff"),
        ({"size": (240, 320)}, "holds results with size"),
    ],
)
def test_results_of_other_settings_are_not_mixed(
    tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    with open_file(tmp_path) as file:
        file.append(MISS)
    before = (tmp_path / RESULTS).read_bytes()
    with pytest.raises(RequestError, match=message), open_file(tmp_path, **changes):
        pass
    with open_file(tmp_path):
        pass
    assert (tmp_path / RESULTS).read_bytes() == before


def test_damage_is_named_with_its_line(tmp_path: Path) -> None:
    with open_file(tmp_path) as file:
        file.append(MISS)
        file.append(HIT)
    path = tmp_path / RESULTS
    whole = path.read_text()
    path.write_text(whole.replace('"seed": 1003', '"seed": 10x3'))
    with pytest.raises(RequestError, match=r"results.jsonl', line 2 is damaged"):
        read_results(tmp_path)
    path.write_text(whole + HIT.to_line() + "\n")
    with pytest.raises(RequestError, match="two lines for seed 1002"), open_file(tmp_path):
        pass


def test_folders_that_are_not_ours_are_left_alone(tmp_path: Path) -> None:
    with pytest.raises(RequestError, match="cannot read"):
        read_results(tmp_path)
    (tmp_path / RESULTS).write_text("")
    with pytest.raises(RequestError, match=r"without evaluation\.json"), open_file(tmp_path):
        pass
    (tmp_path / MANIFEST).write_text("{}")
    with pytest.raises(RequestError, match="schema null version null"), open_file(tmp_path):
        pass
    (tmp_path / MANIFEST).write_text('{"schema": "x", "version": 9, "settings": {}}')
    with pytest.raises(RequestError, match="schema 'x' version 9"), open_file(tmp_path):
        pass
    (tmp_path / "file").write_text("")
    with pytest.raises(RequestError, match="cannot write"), open_file(tmp_path / "file" / "below"):
        pass


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        (MANIFEST, None, "evaluation.json': it is a folder, pipe or device"),
        (RESULTS, None, "results.jsonl': it is a folder, pipe or device"),
        (MANIFEST, "[" * 100_000, "nested more than 64 deep"),
        (MANIFEST, "NaN", "NaN is no finite number"),
        (MANIFEST, "[]", "must be an object, not a list of 0"),
        (MANIFEST, "\udcff", "no UTF-8 at byte 0"),
        (RESULTS, "NaN\n", "line 1: NaN is no finite number; remove that line"),
        (RESULTS, "3\n", "line 1: must be an object, not 3"),
        (RESULTS, "\n", "line 1 is damaged"),
        (RESULTS, "[" * 100_000 + "\n", "line 1 is damaged: nested more than 64 deep"),
        (RESULTS, '{"env": 3}\n', "line 1: env: must be text, not 3"),
        (RESULTS, "\udcff\n", "line 1 is damaged: no UTF-8"),
    ],
)
def test_documents_that_are_none_are_refused(
    tmp_path: Path, name: str, content: str | None, message: str
) -> None:
    with open_file(tmp_path) as file:
        file.append(MISS)
    (tmp_path / name).unlink()
    if content is None:
        (tmp_path / name).mkdir()
    else:
        (tmp_path / name).write_text(content, encoding="utf-8", errors="surrogateescape")
    with pytest.raises(RequestError) as caught, open_file(tmp_path):
        pass
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
