"""``predict``: a motion library whose every frame knows where the mouth was forecast to be."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from face_prediction.commands import predict as predict_command
from face_prediction.commands.cli import main
from face_prediction.commands.predict import PredictOptions, run_predict
from face_prediction.dataset.histories import find_origins, history_images
from face_prediction.dataset.reader import FaceDataset
from face_prediction.dataset.sequences import clip_frames
from face_prediction.evaluation.predictors import EvaluatedPredictor, FittedPredictor
from face_prediction.forecast import mouth_centre
from face_prediction.motion.library import load_motion, save_motion
from face_prediction.prediction.interface import Forecast, ImageNeeds
from face_prediction.tracking.geometry import LIPS
from face_prediction.tracking.tracks import FaceTrack, load_track, save_track
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import file_digest

pytestmark = pytest.mark.long

SIZE = (320, 240)
PEOPLE = ("ann", "bob", "eve")
TABLE = """clip,subject,ship,licence,source
ann.mp4,ann,yes,MIT,here
bob.mp4,bob,yes,MIT,there
eve.mp4,eve,no,unknown,elsewhere
"""
FRAMES = 48
HISTORY = 8


def path_of(number: int, frames: int = FRAMES) -> np.ndarray:
    """A steady way across the view, (frames, 3) m."""
    velocity = np.array([0.03 - 0.02 * number, 0.01 * number, 0.0]) / 30
    return np.array([-0.01, 0.0, -0.5]) + np.arange(frames)[:, None] * velocity


def draw(track: FaceTrack, times: np.ndarray) -> list[np.ndarray]:
    """A red dot on grey where the mouth is at each of ``times``."""
    centres = track.landmarks[:, list(LIPS), :2].mean(axis=1) * SIZE
    images = []
    for time in times:
        u, v = (np.interp(time, track.timestamps, axis) for axis in centres.T)
        image = np.full((SIZE[1], SIZE[0], 3), 60, dtype=np.uint8)
        middle = (round(u * 16 - 8), round(v * 16 - 8))  # OpenCV counts from the middle of a pixel
        cv2.circle(image, middle, 5 * 16, (255, 20, 20), -1, shift=4)
        images.append(image)
    return images


@dataclass
class Folder:
    root: Path

    def options(self, **changes) -> PredictOptions:
        options = PredictOptions(
            tracks=(self.root / "tracks",),
            attribution=self.root / "clips.csv",
            dataset=self.root / "data",
            videos=(self.root / "videos",),
            baseline="persistence",
            horizon=5,
            library=self.root / "motion.npz",
            out=self.root / "predicted.npz",
            progress=False,
        )
        return replace(options, **changes)


@pytest.fixture(scope="module")
def made(tmp_path_factory, make_track, write_video) -> Path:
    """Tracks at 30 frames a second of videos of 25, a library and a dataset of them."""
    root = tmp_path_factory.mktemp("faces")
    (root / "videos").mkdir()
    (root / "clips.csv").write_text(TABLE)
    times = np.arange(FRAMES * 25 // 30) / 25
    for number, name in enumerate(PEOPLE):
        track = make_track(path_of(number), image_size=SIZE, name=f"{name}.mp4")
        video = root / "videos" / f"{name}.mp4"
        write_video(video, draw(track, times), times=times.tolist())
        save_track(
            root / "tracks" / f"{name}.npz",
            replace(
                track,
                source={"name": video.name, "sha256": file_digest(video)},
                source_timestamps=times,
                source_valid=np.ones(len(times), dtype=bool),
            ),
        )
    clips = ["--attribution", root / "clips.csv"]
    words = ["build-dataset", root / "tracks", "--videos", root / "videos", "--out", root / "data"]
    words += [*clips, "--history", HISTORY, "--future", 2, "--crop_size", 64, "--folds", 3]
    assert main([*map(str, [*words, "--stride", 5, "--no_progress"])]) == 0
    words = ["export-motion", root / "tracks", *clips, "--out", root / "motion.npz"]
    assert main([*map(str, [*words, "--min_run", 1])]) == 0
    return root


@pytest.fixture
def folder(made: Path, tmp_path: Path) -> Folder:
    for path in made.iterdir():
        (tmp_path / path.name).symlink_to(path)
    return Folder(tmp_path)


class DotFollower:
    """Reads where the red dot is in the last two images, and lets the face go on like it."""

    name = "dot"
    memory = None
    needs = ImageNeeds(7, 64)

    def predict(self, landmarks, images, horizon: int) -> Forecast:
        red = np.clip(images[..., 0].astype(float) - images[..., 1] - 40, 0, None)
        grid = (np.arange(64) + 0.5) / 64
        total = red.sum(axis=(2, 3))
        dot = np.stack([red.sum(2) @ grid, red.sum(3) @ grid], axis=-1) / total[..., None]
        step = (dot[:, -1] - dot[:, 0]) / (dot.shape[1] - 1)  # six frames are five images apart
        ahead = dot[:, -1:] + step[:, None] * np.arange(1, horizon + 1)[:, None]
        moved = ahead - mouth_centre(landmarks[:, -1:])
        return Forecast((landmarks[:, -1:] + moved[:, :, None]).astype(np.float32))


def use(monkeypatch, predictor, subjects=frozenset()) -> None:
    fits = EvaluatedPredictor(
        predictor.name, dict.fromkeys(range(3), FittedPredictor(predictor, subjects))
    )
    monkeypatch.setattr(predict_command, "cross_fit", lambda *_: fits)


def test_persistence_is_the_mouth_itself(folder: Folder, capsys) -> None:
    assert run_predict(folder.options()) == 0
    library = load_motion(folder.root / "predicted.npz")
    assert library.predicted_mouth is not None
    assert library.predicted_mouth.shape == (2 * FRAMES, 5, 3)
    assert library.predicted_mouth.dtype == np.float32
    # to the landmarks' float32 and back: a few micrometres
    for h in range(5):
        np.testing.assert_allclose(library.predicted_mouth[:, h], library.mouth, atol=2e-6)
    shown = capsys.readouterr().out
    assert "| ann | 1.00 / 1.00 | 2.00 / 2.00 | 3.00 / 3.00 | 4.00 / 4.00 | 5.00 / 5.00 |" in shown


def test_a_steady_face_is_forecast_where_it_will_be(folder: Folder) -> None:
    assert run_predict(folder.options(baseline="constant_velocity")) == 0
    library = load_motion(folder.root / "predicted.npz")
    assert library.predicted_mouth is not None
    for index in range(2):
        run = library.run(index)
        mouth, ahead = library.mouth[run], library.predicted_mouth[run]
        for h in range(1, 6):
            np.testing.assert_allclose(ahead[1:-h, h - 1], mouth[1 + h :], atol=2e-5)
        np.testing.assert_allclose(ahead[0], np.repeat(mouth[:1], 5, axis=0), atol=2e-6)
    record = library.metadata["prediction"]
    assert record["predictor"] == "constant_velocity"
    assert record["frames_with_short_history"] == {"ann": HISTORY - 1, "bob": HISTORY - 1}
    assert record["mean_error_across_mm"]["all"]["forecast"][4] < 0.2  # of the first frame alone
    assert record["mean_error_across_mm"]["ann"]["persistence"][4] == pytest.approx(5.0, abs=0.01)
    assert record["history"] == HISTORY
    assert record["dataset_sha256"] == file_digest(folder.root / "data" / "dataset.json")
    assert record["checkpoint_sha256"] == {}


def test_what_export_motion_wrote_stays_as_it_was(folder: Folder) -> None:
    assert run_predict(folder.options()) == 0
    with (
        np.load(folder.root / "motion.npz") as before,
        np.load(folder.root / "predicted.npz") as after,
    ):
        assert set(after.files) - set(before.files) == {"predicted_mouth"}
        for key in set(before.files) - {"metadata"}:
            assert before[key].dtype == after[key].dtype
            np.testing.assert_array_equal(before[key], after[key])
    metadata = load_motion(folder.root / "predicted.npz").metadata
    del metadata["prediction"]
    assert metadata == load_motion(folder.root / "motion.npz").metadata


def test_a_horizon_that_no_run_lasts_has_no_error(folder: Folder, capsys) -> None:
    """Runs of 16 and 11 frames: the errors of frames ahead that only one of them has, or none."""
    library = load_motion(folder.root / "motion.npz")
    keep = np.r_[0:16, FRAMES : FRAMES + 11]
    short = replace(
        library,
        **{key: getattr(library, key)[keep] for key in ("time", "mouth", "orientation", "jaw")},
        run_start=np.array([0, 16]),
        run_length=np.array([16, 11]),
        predicted_mouth=np.repeat(library.mouth[keep, None], 20, axis=1),
    )
    errors = predict_command.errors_by_clip(short)
    for side in ("forecast", "persistence"):
        known = {name: [value is not None for value in row[side]] for name, row in errors.items()}
        assert {name: sum(row) for name, row in known.items()} == {"ann": 15, "bob": 10, "all": 15}
        assert known["ann"] == [True] * 15 + [False] * 5
    assert errors["ann"]["forecast"][:2] == pytest.approx([1.0, 2.0], abs=0.01)
    assert "| – / – |" in predict_command.error_table(errors, "still")
    recorded = replace(short, metadata={**short.metadata, "errors": errors})
    save_motion(folder.root / "short.npz", recorded)
    assert load_motion(folder.root / "short.npz").metadata["errors"] == errors


def test_only_clips_that_may_ship_are_written(folder: Folder) -> None:
    assert run_predict(folder.options()) == 0
    library = load_motion(folder.root / "predicted.npz")
    assert library.run_clip.tolist() == ["ann", "bob"]
    assert "eve" not in str(library.metadata)


def test_without_a_library_one_is_made(folder: Folder, make_track) -> None:
    for name in ("ann", "eve"):
        track = make_track(path_of(0, 380) * [0.1, 1.0, 1.0], image_size=SIZE, name=f"{name}.mp4")
        save_track(folder.root / "long" / f"{name}.npz", track)
    assert run_predict(folder.options(tracks=(folder.root / "long",), library=None)) == 0
    library = load_motion(folder.root / "predicted.npz")
    assert library.run_clip.tolist() == ["ann"]  # eve's numbers may not be given away
    assert library.metadata["withheld_clips"] == 1
    assert library.run_length.tolist() == [380]
    assert library.metadata["settings"]["min_run"] == 12.0
    assert library.predicted_mouth is not None
    np.testing.assert_allclose(library.predicted_mouth[:, 4], library.mouth, atol=2e-6)


def test_pictures_are_read_from_the_video(folder: Folder, monkeypatch) -> None:
    use(monkeypatch, DotFollower())
    assert run_predict(folder.options()) == 0
    library = load_motion(folder.root / "predicted.npz")
    assert library.predicted_mouth is not None
    run = library.run(0)
    mouth, ahead = library.mouth[run], library.predicted_mouth[run]
    # a picture is at most 20 ms off, in which this mouth moves 0.6 mm; a pixel of it is 3 mm
    for h in (1, 5):
        np.testing.assert_allclose(ahead[8:-h, h - 1], mouth[8 + h :], atol=1.6e-3)
    still = np.abs(ahead[8:, 4] - mouth[8:]).max()
    assert still > 3e-3  # it does forecast motion


def test_histories_are_those_of_the_dataset(folder: Folder) -> None:
    with FaceDataset(folder.root / "data") as dataset:
        settings = dataset.manifest.settings
        rows = dataset.rows()
        indices = [i for i, row in enumerate(rows) if row.clip == "bob"]
        track = load_track(folder.root / "tracks" / "bob.npz")
        frames = clip_frames(track, settings)
        last = [rows[i].start + HISTORY - 1 for i in indices]
        origins = find_origins(
            last, frames.landmarks, SIZE, frames.quality, HISTORY, settings.margin
        )
        seen = history_images(
            folder.root / "videos" / "bob.mp4",
            track,
            frames.source_frame,
            origins,
            ImageNeeds(HISTORY, 32),
            settings,
        )
        for index, origin, images in zip(indices, origins, seen, strict=True):
            np.testing.assert_array_equal(images, dataset.images(index, slice(HISTORY), 2))
            points = origin.crop.normalise(frames.landmarks[origin.history], SIZE)
            np.testing.assert_array_equal(
                points.astype(np.float32), dataset.landmarks(index)[:HISTORY]
            )
    assert len(indices) == 8


def test_nobody_is_forecast_by_what_knows_them(folder: Folder, monkeypatch) -> None:
    use(monkeypatch, DotFollower(), frozenset({"bob"}))
    with pytest.raises(RequestError, match="trained on subject 'bob'"):
        run_predict(folder.options())
    assert not (folder.root / "predicted.npz").exists()


def table(folder: Folder, text: str) -> Path:
    path = folder.root / "other.csv"
    path.write_text(text)
    return path


def test_one_video_under_two_names_is_refused(folder: Folder) -> None:
    other = table(folder, TABLE.replace("bob.mp4,bob", "bob.mp4,robert"))
    with pytest.raises(RequestError, match="is of 'robert' in --attribution and of 'bob'"):
        run_predict(folder.options(attribution=other))


def test_somebody_in_no_fold_is_refused(folder: Folder, make_track) -> None:
    save_track(folder.root / "zoe.npz", make_track(path_of(0, 380) * [0.1, 1, 1], image_size=SIZE))
    other = table(folder, TABLE + "zoe.mp4,zoe,yes,MIT,here\n")
    options = folder.options(tracks=(folder.root / "zoe.npz",), attribution=other, library=None)
    with pytest.raises(RequestError, match="subject 'zoe' is in no fold"):
        run_predict(options)


def test_a_library_of_other_tracks_is_refused(folder: Folder, make_track) -> None:
    library = load_motion(folder.root / "motion.npz")
    moved = replace(library, mouth=library.mouth + np.float32(1e-4))
    save_motion(folder.root / "moved.npz", moved)
    with pytest.raises(RequestError, match="its 'mouth' is not what these tracks give"):
        run_predict(folder.options(library=folder.root / "moved.npz"))
    only = (folder.root / "tracks" / "ann.npz",)
    with pytest.raises(RequestError, match="no track with ship=yes of its clips bob"):
        run_predict(folder.options(tracks=only))
    save_motion(folder.root / "blank.npz", replace(library, metadata={}))
    with pytest.raises(RequestError, match="no settings of export-motion"):
        run_predict(folder.options(library=folder.root / "blank.npz"))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"videos": ()}, "its video 'ann.mp4' is in no folder of --videos"),
        ({"tracks": ()}, "no track given"),
        ({"attribution": Path("/nowhere.csv")}, "cannot be read"),
        ({"library": Path("/nowhere.npz")}, "no such file"),
    ],
)
def test_what_cannot_be_done_is_refused(folder: Folder, monkeypatch, changes, message) -> None:
    use(monkeypatch, DotFollower())
    with pytest.raises(RequestError, match=message) as caught:
        run_predict(folder.options(**changes))
    assert "\n" not in str(caught.value)
    assert not (folder.root / "predicted.npz").exists()


def test_a_video_of_something_else_is_refused(folder: Folder, made: Path, monkeypatch) -> None:
    use(monkeypatch, DotFollower())
    other = folder.root / "swapped"
    other.mkdir()
    (other / "ann.mp4").symlink_to(made / "videos" / "bob.mp4")
    (other / "bob.mp4").symlink_to(made / "videos" / "bob.mp4")
    with pytest.raises(RequestError, match="was not made from"):
        run_predict(folder.options(videos=(other,)))


def test_a_track_at_another_rate_is_refused(folder: Folder, make_track) -> None:
    track = make_track(path_of(0, 800) * [0.1, 1.0, 1.0], image_size=SIZE, fps=60.0)
    save_track(folder.root / "ann.npz", track)
    with pytest.raises(RequestError, match="at 60 frames a second, the dataset at 30"):
        run_predict(folder.options(tracks=(folder.root / "ann.npz",), library=None))


def test_a_predictor_without_a_forecast_is_refused(folder: Folder, monkeypatch) -> None:
    class Blind(DotFollower):
        needs = ImageNeeds(0, 0)

        def predict(self, landmarks, images, horizon: int) -> Forecast:
            return Forecast(np.full((len(landmarks), horizon, 468, 2), np.nan, dtype=np.float32))

    use(monkeypatch, Blind())
    with pytest.raises(RequestError, match="has no forecast for some frames of 'ann'"):
        run_predict(folder.options())


def test_a_library_with_damaged_forecasts_is_refused(folder: Folder, caplog) -> None:
    caplog.set_level(logging.INFO)
    assert run_predict(folder.options()) == 0
    path = folder.root / "predicted.npz"
    library = load_motion(path)
    assert library.predicted_mouth is not None
    library.predicted_mouth[3, 1, 2] = np.nan
    save_motion(path, library)
    with pytest.raises(RequestError, match="'predicted_mouth' holds NaN"):
        load_motion(path)
    save_motion(path, replace(library, predicted_mouth=np.zeros((7, 5, 3), dtype=np.float32)))
    with pytest.raises(RequestError, match=r"'predicted_mouth' is float32 \(7, 5, 3\)"):
        load_motion(path)
