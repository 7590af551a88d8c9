"""Face tracks and motion libraries on disk: what is read back, and what is refused by name."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from face_prediction.motion.library import join_runs, load_motion, save_motion
from face_prediction.motion.motion import MotionSettings, lift
from face_prediction.tracking.tracks import load_track, save_track
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.npz import write_npz


def mouth(frames: int) -> np.ndarray:
    time = np.arange(frames)[:, None] / 30
    return np.array([0.0, 0.0, -0.5]) + 0.02 * np.sin(time * [1.0, 2.0, 3.0])


@pytest.fixture
def track_file(tmp_path: Path, make_track) -> Path:
    path = tmp_path / "person.npz"
    valid = np.ones(40, dtype=bool)
    valid[5:8] = False
    save_track(path, make_track(mouth(40), valid=valid))
    return path


@pytest.fixture
def library_file(tmp_path: Path, make_track) -> Path:
    path = tmp_path / "face_motion.npz"
    settings = MotionSettings(min_run=1.0)
    first, second = (lift(make_track(mouth(n)), settings) for n in (50, 70))
    library = join_runs([("a", "ann", first), ("b", "bob", second)], {"note": "test"})
    save_motion(path, library)
    return path


def test_a_track_comes_back(track_file: Path, make_track) -> None:
    track = load_track(track_file)
    original = make_track(mouth(40))
    assert len(track) == 40
    assert np.flatnonzero(~track.valid).tolist() == [5, 6, 7]
    np.testing.assert_allclose(
        track.landmarks[track.valid], original.landmarks[track.valid], atol=1e-7
    )
    np.testing.assert_array_equal(track.head_pose[track.valid], original.head_pose[track.valid])
    assert np.isnan(track.landmarks[5:8]).all()
    assert track.image_size == (640, 480)
    assert track.source["name"] == "synthetic.mp4"


def test_a_library_comes_back(library_file: Path) -> None:
    library = load_motion(library_file)
    assert library.run_length.tolist() == [50, 70]
    assert library.run_start.tolist() == [0, 50]
    assert library.run_subject.tolist() == ["ann", "bob"]
    assert library.seconds == pytest.approx((49 + 69) / 30)
    np.testing.assert_allclose(library.mouth[library.run(1)], mouth(70), atol=1e-6)
    np.testing.assert_allclose(library.time[library.run(1)], np.arange(70) / 30)
    assert library.metadata == {"note": "test"}


def edited(path: Path, change: Callable[[dict[str, np.ndarray]], None]) -> None:
    with np.load(path) as stored:
        arrays = dict(stored)
    change(arrays)
    write_npz(path, arrays)


def without(key: str) -> Callable[[dict[str, np.ndarray]], None]:
    return lambda arrays: arrays.__delitem__(key)


def with_value(key: str, value) -> Callable[[dict[str, np.ndarray]], None]:
    return lambda arrays: arrays.__setitem__(key, np.asarray(value))


def without_rows(arrays: dict[str, np.ndarray]) -> None:
    arrays |= {key: arrays[key][:0] for key in ("source_timestamps", "source_valid")}


def with_nan(key: str, index: int = 0) -> Callable[[dict[str, np.ndarray]], None]:
    def change(arrays: dict[str, np.ndarray]) -> None:
        arrays[key] = arrays[key].copy()
        arrays[key][index] = np.nan

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (without("schema"), "schema 'none'"),
        (with_value("schema", "recorded_face_motion"), "expected 'face_track'"),
        (with_value("version", 99), "version 99"),
        *[
            (without(key), f"'{key}' is missing")
            for key in ("landmarks", "valid", "timestamps", "head_pose", "jaw", "detector", "fps")
        ],
        (with_value("landmarks", np.zeros((40, 478, 3))), "'landmarks' is float64"),
        (with_value("valid", np.ones(40)), "'valid' is float64"),
        (with_value("source", "not json"), "'source' is damaged"),
        (with_value("fps", 0.0), "must be positive"),
        (with_value("timestamps", np.zeros(40)), "'timestamps' does not increase at row 1"),
        (with_nan("landmarks", 3), "'landmarks' holds NaN"),
        (with_nan("head_pose", 39), "'head_pose' holds NaN"),
        (with_value("jaw", np.full(40, -0.01, "f4")), "'jaw' holds distances that are negative"),
        (with_value("image_size", [0, 480]), "'image_size' must be positive"),
        (with_value("extra", np.zeros(3)), "unknown array 'extra.npy'"),
        (with_value("fps", np.inf), "'fps' holds NaN or infinity"),
        (without_rows, "'source_timestamps' is empty"),
    ],
)
def test_a_damaged_track_is_refused_by_name(track_file: Path, change, message: str) -> None:
    edited(track_file, change)
    with pytest.raises(RequestError, match=message) as caught:
        load_track(track_file)
    assert str(track_file) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (with_value("schema", "face_track"), "expected 'recorded_face_motion'"),
        *[
            (without(key), f"'{key}' is missing")
            for key in ("time", "mouth", "orientation", "jaw", "run_start", "run_subject", "fps")
        ],
        (with_value("mouth", np.zeros((120, 2))), r"'mouth' is float64 \(120, 2\)"),
        (with_nan("mouth"), "'mouth' holds NaN"),
        (with_nan("jaw", 100), "'jaw' holds NaN"),
        (with_value("orientation", np.full((120, 4), 0.6)), "not of unit length"),
        (with_value("run_start", np.array([0, 40])), "do not divide the frames"),
        (with_value("run_length", np.array([50, 71])), "do not divide the frames"),
        (with_value("metadata", "{"), "'metadata' is damaged"),
        (with_value("jaw", np.full(120, -0.01, "f4")), "'jaw' is negative at row 0"),
        (with_value("time", np.zeros(120)), "'time' does not increase in the run from frame 0"),
        (with_value("run_start", np.array([0, 2**63 - 1])), "do not divide the frames"),
    ],
)
def test_a_damaged_library_is_refused_by_name(library_file: Path, change, message: str) -> None:
    edited(library_file, change)
    with pytest.raises(RequestError, match=message) as caught:
        load_motion(library_file)
    assert str(library_file) in str(caught.value)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.9, 0.99])
def test_a_truncated_file_is_refused(track_file: Path, share: float) -> None:
    data = track_file.read_bytes()
    track_file.write_bytes(data[: int(len(data) * share)])
    with pytest.raises(RequestError, match="damaged"):
        load_track(track_file)


def test_a_flipped_byte_is_refused(track_file: Path) -> None:
    data = bytearray(track_file.read_bytes())
    data[len(data) // 3] ^= 0xFF
    track_file.write_bytes(data)
    with pytest.raises(RequestError, match="damaged"):
        load_track(track_file)


def test_pickled_objects_are_never_loaded(track_file: Path) -> None:
    with np.load(track_file) as stored:
        arrays = dict(stored)
    arrays["source"] = np.array({"a": 1}, dtype=object)
    np.savez(track_file, allow_pickle=True, **arrays)
    with pytest.raises(RequestError, match="damaged or not"):
        load_track(track_file)


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(RequestError, match="no such file"):
        load_track(tmp_path / "nothing.npz")


def test_writing_is_whole_or_not_at_all(tmp_path: Path, monkeypatch) -> None:
    path = tmp_path / "file.npz"
    write_npz(path, {"a": np.zeros(3)})
    before = path.read_bytes()

    def killed(*_args, **_kwargs) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(np, "savez_compressed", killed)
    with pytest.raises(KeyboardInterrupt):
        write_npz(path, {"a": np.ones(3)})
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_an_unwritable_folder(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(RequestError, match="cannot write to"):
        write_npz(tmp_path / "file" / "out.npz", {"a": np.zeros(3)})


def test_mixed_rates_are_refused(make_track) -> None:
    settings = MotionSettings(min_run=1.0)
    clips = [
        (name, name, lift(make_track(mouth(100), fps=fps), settings))
        for name, fps in (("a", 30.0), ("b", 25.0))
    ]
    with pytest.raises(RequestError, match=r"\[25.0, 30.0\]"):
        join_runs(clips, {})


def test_nothing_to_write(make_track) -> None:
    short = lift(make_track(mouth(10)), MotionSettings())
    with pytest.raises(RequestError, match="no run is long enough"):
        join_runs([("a", "a", short)], {})


def test_metadata_is_plain_json(library_file: Path) -> None:
    with np.load(library_file) as stored:
        assert json.loads(str(stored["metadata"])) == {"note": "test"}
