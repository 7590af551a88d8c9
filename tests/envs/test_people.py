"""Different people in demonstrations and evaluation: the split of a library, and draws from it."""

from __future__ import annotations

import json
from collections import Counter
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from robo_manip_baselines.envs.mujoco.face.motion import MotionLibrary, MotionSegment
from robo_manip_baselines.envs.mujoco.face.motions import parse_motion
from robo_manip_baselines.envs.mujoco.face.people import PeopleSplit, alternate, split_runs
from robo_manip_baselines.envs.mujoco.tasks.face_env import world_of
from robo_manip_baselines.envs.mujoco.tasks.registry import make_env
from robo_manip_baselines.runs.errors import RequestError

from .test_motion import content, save

SHIPPED = {
    "train": {"latentsync_demo2", "pexels_3063838", "us_gov_whitehouse2021"},
    "test": {"clm", "obama", "pexels_8090198"},
}


@pytest.fixture(scope="module")
def library() -> MotionLibrary:
    return MotionLibrary.load()


def draw(name: str, library: MotionLibrary, seed: int, people: str = "all") -> MotionSegment:
    rng = np.random.default_rng(seed)
    return parse_motion(name).draw(rng, library, seed=seed, people=people)


def write(folder: Path, lengths: tuple[int, ...], clips: list[str], **changes: Any) -> Path:
    """A library of one person."""
    own = {"run_clip": np.array(clips), "run_subject": np.array(["me"] * len(lengths))}
    return save(folder, **{**content(lengths), **own, **changes})


def test_all_people_are_drawn_as_before(library: MotionLibrary) -> None:
    """Segments of the release before people were split."""
    drawn = [draw("recorded", library, seed).index for seed in range(6)]
    assert drawn == [int(i) for i in OLD_INDICES]
    assert library.part("all") is library


OLD_INDICES = (4716, 3381, 4682, 4615, 4395, 4251)


def test_the_shipped_library_is_split_into_different_people(library: MotionLibrary) -> None:
    for people, wanted in SHIPPED.items():
        assert set(library.part(people).run_subject) == wanted
        assert {draw("recorded", library, seed, people).subject for seed in range(60)} == wanted


def test_a_person_is_drawn_before_a_start(library: MotionLibrary) -> None:
    """Obama has half of the starts of his part; a third of the episodes are his."""
    count = Counter(draw("recorded", library, seed, "test").subject for seed in range(1500))
    # Four standard deviations of a share of 1/3 in 1500 draws are 73.
    assert all(abs(number - 500) < 73 for number in count.values())
    starts = {
        (s.index, s.subject) for s in (draw("recorded", library, n, "test") for n in range(300))
    }
    assert len(starts) > 250


@pytest.mark.parametrize("name", ["recorded", "recorded:speed=3", "sway", "recorded+tremor"])
def test_a_seed_has_the_same_world_whoever_moves(name: str, library: MotionLibrary) -> None:
    later = []
    for people in ("all", "train", "test"):
        rng = np.random.default_rng(5)
        parse_motion(name).draw(rng, library, seed=5, people=people)
        later.append(rng.random(3).tolist())
    assert later[0] == later[1] == later[2]


@pytest.mark.parametrize("name", ["sway", "dyskinetic", "tremor", "spasm", "turn_away", "nod"])
def test_synthetic_people_of_a_seed_differ_between_the_parts(
    name: str, library: MotionLibrary
) -> None:
    segments = [draw(name, library, 3, people) for people in ("all", "train", "test")]
    again = draw(name, library, 3, "test")
    np.testing.assert_array_equal(segments[2].orientation, again.orientation)
    for one, other in ((0, 1), (0, 2), (1, 2)):
        a, b = segments[one], segments[other]
        assert not np.allclose(a.displacement, b.displacement, atol=1e-5) or not np.allclose(
            a.orientation, b.orientation, atol=1e-5
        )


def test_a_fast_replay_stays_in_its_part(tmp_path: Path) -> None:
    """One run of one person, cut in the middle: four times as fast, no frame of the other half."""
    mouth = 0.2 * content((900,))["mouth"]  # moves evenly, so that a displacement names its frame
    library = MotionLibrary.load(write(tmp_path, (900,), ["clip"], mouth=mouth))
    for people, (first, last) in {"train": (0, 449), "test": (450, 899)}.items():
        for seed in range(5):
            segment = draw("recorded:speed=4", library, seed, people)
            frames = segment.index + segment.displacement[:, 1] / 2e-5
            assert first <= frames.min() + 0.5
            assert frames.max() - 0.5 <= last


@pytest.mark.parametrize(
    ("lengths", "clips", "train", "test"),
    [
        # Clips by their SHA-256 (c: 2e7d…, a: ca97…, b: 3e23…), so c, b, a.
        ((400, 400, 400), ["a", "b", "c"], [(0, 400), (800, 400)], [(400, 400)]),
        ((400, 300, 400, 400), ["a"] * 4, [(0, 400), (1100, 400)], [(700, 400)]),
        ((900, 360), ["a", "b"], [(0, 450)], [(450, 450)]),
    ],
)
def test_somebody_alone_is_split_by_clip_run_or_time(
    tmp_path: Path,
    lengths: tuple[int, ...],
    clips: list[str],
    train: list[tuple[int, int]],
    test: list[tuple[int, int]],
) -> None:
    library = MotionLibrary.load(write(tmp_path, lengths, clips))
    for people, wanted in (("train", train), ("test", test)):
        part = library.part(people)
        assert list(zip(part.run_start, part.run_length, strict=True)) == wanted
        assert draw("recorded", library, 0, people).subject == "me"


def test_what_cannot_be_split_is_refused_when_an_environment_is_made(tmp_path: Path) -> None:
    path = write(tmp_path, (700,), ["a"])
    kwargs: dict[str, Any] = {"cameras": (), "motion_library": str(path)}
    with pytest.raises(RequestError, match="one run of one person, and its halves are too short"):
        make_env("FeedingEnv", people="train", **kwargs)
    make_env("FeedingEnv", people="train", motion="sway", **kwargs).close()
    with pytest.raises(RequestError, match=r"unknown people 'tset'.*valid: all, test, train"):
        make_env("FeedingEnv", people="tset", cameras=())
    with pytest.raises(RequestError, match="unknown clip 'us_gov_obama_lia'"):
        make_env("FeedingEnv", people="train", clips="us_gov_obama_lia", cameras=())


def stored(train: Any, test: Any) -> np.ndarray:
    return np.array(json.dumps({"people": {"train": train, "test": test}}))


def test_a_stored_split_counts_and_belongs_to_the_digest(tmp_path: Path) -> None:
    lengths = (500, 500, 500)
    plain = MotionLibrary.load(save(tmp_path, **content(lengths)))
    digests = {plain.sha256}
    for train, test in ((["subject0"], ["subject2"]), (["subject2"], ["subject0", "subject1"])):
        own = {**content(lengths), "metadata": stored(train, test)}
        library = MotionLibrary.load(save(tmp_path, **own))
        assert set(library.part("train").run_subject) == set(train)
        assert set(library.part("test").run_subject) == set(test)
        digests.add(library.sha256)
    assert len(digests) == 3


@pytest.mark.parametrize(
    ("train", "test", "message"),
    [
        (["subject0"], ["subject0"], "people: 'subject0' is in train and in test; leave one out"),
        ([], ["subject0"], "people.*train"),
        ("subject0", ["subject1"], "people.*train"),
        (["nobody"], ["subject0"], "people 'train': no run of nobody is long enough"),
        (["subject1"], ["subject0"], "people 'train': no run of subject1 is long enough"),
    ],
)
def test_a_stored_split_that_cannot_be_used_is_refused_in_one_line(
    tmp_path: Path, train: Any, test: Any, message: str
) -> None:
    path = save(tmp_path, metadata=stored(train, test))  # of three runs, the second is too short
    with pytest.raises(RequestError, match=f"library.npz': {message}") as caught:
        MotionLibrary.load(path).part("train")
    assert "\n" not in str(caught.value)


def test_the_rule_depends_on_names_alone() -> None:
    names = ["d", "a", "c", "b", "a"]
    assert alternate(names) == alternate(sorted(names)) == alternate(names[::-1])
    found = alternate(names)
    assert sorted([*found.train, *found.test]) == ["a", "b", "c", "d"]
    none = np.zeros(0, np.int64)
    with pytest.raises(RequestError, match="no run is long enough"):
        split_runs([], [], none, none, least=361)
    assert PeopleSplit.of({}, "library") is None


def test_the_people_of_an_episode_are_recorded(tmp_path: Path) -> None:
    from robo_manip_baselines.rollout.demonstrate import demonstrate

    with closing(make_env("FeedingEnv", cameras=(), people="test", max_episode_steps=3)) as env:
        attributes = demonstrate(env, "reactive", 0, codec="jpeg", quality=90).attributes
        assert attributes["env_kwargs"]["people"] == "test"
        assert attributes["motion_subject"] in SHIPPED["test"]
        assert world_of(env).people == "test"
