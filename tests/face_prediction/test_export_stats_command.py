"""``export-stats``: drawn faces in, error statistics out, of predictors that never saw them."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from face_prediction.commands import export_stats as export_stats_command
from face_prediction.commands.cli import main
from face_prediction.commands.export_stats import (
    ExportStatsOptions,
    library_residuals,
    median_crop_span,
    run_export_stats,
)
from face_prediction.dataset.reader import FaceDataset
from face_prediction.evaluation import predictors
from face_prediction.evaluation.error_stats import Camera, load_predictor_error_stats
from face_prediction.evaluation.predictors import (
    EvaluatedPredictor,
    FittedPredictor,
    batch_size,
    cross_fit,
)
from face_prediction.motion.library import RecordedMotion, load_motion, save_motion
from face_prediction.prediction.interface import Forecast, ImageNeeds
from face_prediction.tracking.geometry import crop_around
from face_prediction.tracking.tracks import save_track
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import file_digest

pytestmark = pytest.mark.long

SIZE = (320, 240)
HISTORY, FUTURE, MARGIN = 8, 5, 0.1
DEPTH = 0.5
FOCAL = SIZE[1] / 2 / math.tan(math.radians(63 / 2))  # pixels
TABLE = """clip,subject,ship,licence,source,kind
ann.mp4,ann,yes,MIT,here,natural
bob.mp4,bob,no,unknown,there,natural
cat.mp4,cat,yes,MIT,here,natural
nod.mp4,nod,yes,MIT,here,head_motion
"""


@pytest.fixture(scope="module")
def dataset(tmp_path_factory, make_track, write_video) -> Path:
    """Faces that stand still for 8 frames and then, at once, 0.015 and 0.017 crops further."""
    root = tmp_path_factory.mktemp("faces")
    (root / "videos").mkdir()
    (root / "clips.csv").write_text(TABLE)
    images = [
        np.full((SIZE[1], SIZE[0], 3), 40 + 12 * number, dtype=np.uint8)
        for number in range(HISTORY + FUTURE)
    ]
    for name in ("ann", "bob", "cat", "nod"):
        mouth = np.tile([0.0, 0.0, -DEPTH], (HISTORY + FUTURE, 1))
        if name == "nod":  # comes nearer before, up to the last frame that is seen
            mouth[:HISTORY, 2] -= np.linspace(0.07, 0.0, HISTORY)
        before = make_track(mouth, image_size=SIZE)
        crop = crop_around(before.landmarks[:HISTORY], SIZE, MARGIN)
        step = np.array([0.015, -0.017, 0.0]) * crop.side / FOCAL * DEPTH
        mouth[HISTORY:] += step if name != "nod" else 2 * step
        track = make_track(mouth, image_size=SIZE, name=f"{name}.mp4")
        video = write_video(root / "videos" / f"{name}.mp4", images)
        # four videos of one content would be refused as one person under four names
        video.write_bytes(video.read_bytes() + name.encode())
        source = {"name": video.name, "sha256": file_digest(video)}
        save_track(root / "tracks" / f"{name}.npz", replace(track, source=source))
    words = ["build-dataset", root / "tracks", "--videos", root / "videos", "--out", root / "data"]
    words += ["--attribution", root / "clips.csv", "--history", HISTORY, "--future", FUTURE]
    words += ["--crop_size", 64, "--folds", 3, "--stride", 1, "--no_progress"]
    assert main([*map(str, words)]) == 0
    return root / "data"


@pytest.fixture
def options(dataset: Path, tmp_path: Path) -> ExportStatsOptions:
    out = tmp_path / "error_stats.json"
    return ExportStatsOptions(dataset, baseline="persistence", out=out, progress=False)


class Watched:
    """Adds ``offset`` to the last frame, and remembers what it was shown."""

    name = "watched"
    memory = None

    def __init__(self, offset=(0.0, 0.0), needs: ImageNeeds | None = None) -> None:
        self.offset = np.array(offset)
        self.needs = needs or ImageNeeds(0, 0)
        self.shown: list[tuple[np.ndarray, np.ndarray | None]] = []

    def predict(self, landmarks, images, horizon: int) -> Forecast:
        self.shown.append((landmarks, images))
        ahead = np.repeat(landmarks[:, -1:], horizon, axis=1) + self.offset
        return Forecast(ahead.astype(np.float32))


def use(monkeypatch, by_fold: dict[int, Watched], trained_on=frozenset()) -> None:
    fitted = {fold: FittedPredictor(watched, trained_on) for fold, watched in by_fold.items()}
    fits = EvaluatedPredictor("watched", fitted)
    monkeypatch.setattr(export_stats_command, "cross_fit", lambda *_: fits)


def test_the_papers_numbers_give_its_metres(options, capsys) -> None:
    # section IV.C: dU 0.015, dV 0.017, 75 x 47 degrees, 0.5 m, the crop taken for the image
    assert run_export_stats(replace(options, crop_width=1.0, crop_height=1.0)) == 0
    stats = load_predictor_error_stats(options.out)
    for horizon in stats.horizons:
        assert horizon.mean_abs == pytest.approx((0.015, 0.017), abs=2e-6)  # float32 landmarks
        assert horizon.bias == pytest.approx((-0.015, -0.017), abs=2e-6)  # v is down
        assert horizon.mean_abs_m == pytest.approx((0.01151, 0.00739), abs=1e-5)
    assert "| 1 | 0.0150 | 0.0170 | 11.51 | 7.39 |" in capsys.readouterr().out


def test_metres_are_those_of_the_face(options, caplog) -> None:
    caplog.set_level(logging.INFO)
    assert run_export_stats(options) == 0
    stats = load_predictor_error_stats(options.out)
    with FaceDataset(options.dataset) as dataset:
        span = median_crop_span(dataset, ["ann", "cat"])
    # what the mouth really moved, whatever camera is asked about
    assert stats.horizons[4].mean_abs_m == pytest.approx((0.015 * span, 0.017 * span), abs=1e-6)
    assert stats.camera.crop_width == pytest.approx(span / (2 * 0.5 * math.tan(math.radians(37.5))))
    assert f"crops span {span:.3f} m" in caplog.text
    assert run_export_stats(replace(options, depth_m=0.8, fov_x_deg=60.0)) == 0
    other = load_predictor_error_stats(options.out)
    assert other.horizons[4].mean_abs_m == pytest.approx(stats.horizons[4].mean_abs_m)


@pytest.mark.parametrize(("number", "clip"), [(1, "bob"), (3, "nod")])
def test_a_crop_spans_what_its_edges_see(dataset: Path, project, number: int, clip: str) -> None:
    with FaceDataset(dataset) as opened:
        span = median_crop_span(opened, [clip])
        row = opened.rows()[number]
    assert row.clip == clip
    side = row.statistics["crop_side"]
    ends = np.array([[-span / 2, 0.0, -DEPTH], [span / 2, 0.0, -DEPTH]])
    left, right = project(ends, SIZE)[:, 0] * SIZE[0]
    assert right - left == pytest.approx(side, rel=1e-4)  # the depth is lifted, from float32


def test_a_crop_as_large_as_the_view_is_the_image() -> None:
    across, up = Camera().metres(np.ones(2))
    assert Camera().with_crop(across).crop_width == pytest.approx(1.0)
    assert Camera().with_crop(up).crop_height == pytest.approx(1.0)
    assert Camera().with_crop(0.2, 0.3, 0.4) == Camera(crop_width=0.3, crop_height=0.4)
    narrow = Camera(crop_width=0.1, crop_height=0.1)
    assert narrow.with_crop(0.2) == Camera().with_crop(0.2)


def test_what_the_file_says(options) -> None:
    assert run_export_stats(options) == 0
    stats = load_predictor_error_stats(options.out)
    assert (stats.predictor, stats.footage, stats.fps) == ("persistence", "natural", 30.0)
    assert (stats.sequences, stats.subjects, stats.stride_frames) == (3, 3, 1)
    assert [run.subject for run in stats.residuals] == ["ann", "bob", "cat"]
    assert run_export_stats(replace(options, keep_runs=False)) == 0
    assert load_predictor_error_stats(options.out).residuals == ()
    assert run_export_stats(replace(options, kind="head_motion")) == 0
    assert load_predictor_error_stats(options.out).horizons[0].mean_abs == pytest.approx(
        (0.03, 0.034), abs=1e-5
    )


def test_the_same_command_gives_the_same_bytes(options) -> None:
    files = []
    for _ in range(2):
        assert run_export_stats(options) == 0
        files.append(options.out.read_bytes())
    assert files[0] == files[1]


def test_each_fold_is_forecast_by_its_own_predictor(options, monkeypatch) -> None:
    with FaceDataset(options.dataset) as dataset:
        fold_of = {clip.subject: clip.fold or 0 for clip in dataset.manifest.clips}
    watched = {fold: Watched((0.1 * fold, 0.0)) for fold in range(3)}
    use(monkeypatch, watched)
    assert run_export_stats(options) == 0
    for run in load_predictor_error_stats(options.out).residuals:
        expected = 0.1 * fold_of[run.subject] - 0.015
        assert run.values[0][2][0] == pytest.approx(expected, abs=2e-6)
    for predictor in watched.values():
        for landmarks, images in predictor.shown:
            assert landmarks.shape[1:] == (HISTORY, 468, 2)  # the future is not in it
            assert images is None


def test_pictures_are_the_last_of_the_history(options, monkeypatch) -> None:
    watched = Watched(needs=ImageNeeds(3, 32))
    use(monkeypatch, dict.fromkeys(range(3), watched))
    assert run_export_stats(replace(options, kind="head_motion")) == 0
    ((_, images),) = watched.shown
    with FaceDataset(options.dataset) as dataset:
        (index,) = dataset.indices(kinds={"head_motion"}).tolist()
        expected = dataset.images(index, slice(5, 8), 2)
    assert images is not None
    np.testing.assert_array_equal(images[0], expected)


def test_a_fold_without_a_checkpoint_is_left_out(options, monkeypatch) -> None:
    with FaceDataset(options.dataset) as dataset:
        fold_of = {clip.subject: clip.fold or 0 for clip in dataset.manifest.clips}
    fold = fold_of["bob"]
    use(monkeypatch, {fold: Watched()})
    assert run_export_stats(options) == 0
    stats = load_predictor_error_stats(options.out)
    assert [run.subject for run in stats.residuals] == [
        name for name in ("ann", "bob", "cat") if fold_of[name] == fold
    ]


def test_whoever_was_trained_on_is_not_judged(options, monkeypatch) -> None:
    use(monkeypatch, dict.fromkeys(range(3), Watched()), frozenset({"bob", "dora"}))
    with pytest.raises(RequestError, match="trained on subject 'bob'"):
        run_export_stats(options)
    assert not options.out.exists()


def test_baselines_are_fitted_to_the_others(dataset: Path, monkeypatch) -> None:
    fitted_to: list[set[str]] = []
    fit = predictors.fit_forecaster

    def spy(name, sequences):
        fitted_to.append(set(sequences.subjects))
        return fit(name, sequences)

    monkeypatch.setattr(predictors, "fit_forecaster", spy)
    with FaceDataset(dataset) as opened:
        fold_of = {clip.subject: clip.fold for clip in opened.manifest.clips}
        fits = cross_fit(opened, (), "ar_mouth")
    assert sorted(fits.by_fold) == [0, 1, 2]
    for fold, subjects in zip(sorted(fits.by_fold), fitted_to, strict=True):
        assert subjects == {name for name, own in fold_of.items() if own != fold}
        assert fits.by_fold[fold].subjects == subjects
    with pytest.raises(RequestError, match="subject 'new' is in no fold"):
        fits.predictor_for(None, "new")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"baseline": None}, "either --checkpoints .* or --baseline"),
        ({"checkpoints": (Path("a"),)}, "either --checkpoints .* or --baseline"),
        ({"baseline": "oracle"}, "unknown baseline 'oracle'; valid: "),
        ({"kind": "grid"}, "no sequence of kind grid in fold 0, 1, 2"),
        ({"crop_width": -1.0}, "crop_width -1.0: must be more than 0, 1000000 or less"),
        ({"depth_m": 0.0}, "depth_m 0.0: must be more than 0, 1000000 or less"),
        ({"dataset": Path("/nowhere")}, "no dataset"),
    ],
)
def test_what_cannot_be_done_is_refused(options, change, message: str) -> None:
    with pytest.raises(RequestError, match=message) as caught:
        run_export_stats(replace(options, **change))
    assert "\n" not in str(caught.value)
    assert not options.out.exists()


def test_a_picture_size_that_the_dataset_has_not_is_refused(options, monkeypatch) -> None:
    watched = Watched(needs=ImageNeeds(1, 48))
    use(monkeypatch, dict.fromkeys(range(3), watched))
    with pytest.raises(RequestError, match="images of 48 pixels: this dataset can give 64, 32, "):
        run_export_stats(options)


def test_other_files_are_not_overwritten(options, tmp_path: Path) -> None:
    options.out.write_text("a diary")
    with pytest.raises(RequestError, match="in the way of --out"):
        run_export_stats(options)
    assert options.out.read_text() == "a diary"
    with pytest.raises(RequestError, match="is a folder"):
        run_export_stats(replace(options, out=tmp_path))


def test_pictures_at_once_fit_in_memory() -> None:
    assert batch_size(ImageNeeds(0, 0)) == 64
    assert batch_size(ImageNeeds(70, 256)) == 4
    assert batch_size(ImageNeeds(1, 16)) == 64
    assert batch_size(ImageNeeds(1000, 256)) == 1


def predicted_library(tmp_path: Path) -> Path:
    """Two runs of ann and one of nod; forecasts h frames ahead are (h, -2 h, 0) mm off."""
    frames = (30, 20, 25)
    mouth = np.cumsum(np.random.default_rng(0).normal(0, 1e-3, (sum(frames), 3)), axis=0)
    mouth[:, 2] -= DEPTH
    starts = np.concatenate([[0], np.cumsum(frames)[:-1]])
    ahead = np.zeros((sum(frames), FUTURE, 3))
    for start, count in zip(starts, frames, strict=True):
        for h in range(1, FUTURE + 1):
            last = start + count - 1
            come = np.minimum(np.arange(start, start + count) + h, last)
            ahead[start : start + count, h - 1] = mouth[come] + 1e-3 * np.array([h, -2 * h, 0])
    library = RecordedMotion(
        time=np.concatenate([np.arange(n) / 30 for n in frames]),
        mouth=mouth.astype(np.float32),
        orientation=np.tile(np.array([1, 0, 0, 0], np.float32), (sum(frames), 1)),
        jaw=np.full(sum(frames), 0.01, np.float32),
        run_start=starts,
        run_length=np.array(frames),
        run_clip=np.array(["ann", "ann", "nod"]),
        run_subject=np.array(["ann", "ann", "nod"]),
        fps=30.0,
        metadata={"prediction": {"predictor": "made_up"}},
        predicted_mouth=ahead.astype(np.float32),
    )
    path = tmp_path / "library.npz"
    save_motion(path, library)
    return path


def test_a_library_is_measured_frame_by_frame(dataset: Path, tmp_path: Path) -> None:
    library, out = predicted_library(tmp_path), tmp_path / "stats.json"
    command = ["export-stats", "--dataset", str(dataset), "--library", str(library)]
    assert main([*command, "--out", str(out), "--no-progress"]) == 0
    stats = load_predictor_error_stats(out)
    assert (stats.predictor, stats.stride_frames, stats.subjects) == ("made_up", 1, 1)
    assert [len(run.values) for run in stats.residuals] == [30 - FUTURE, 20 - FUTURE]
    with FaceDataset(dataset) as opened:
        span = median_crop_span(opened, ["ann"])
    for h, horizon in enumerate(stats.horizons, start=1):
        # up in the world is up in the image: V, which counts down, is forecast too far down
        np.testing.assert_allclose(horizon.bias, np.array([h, 2 * h]) * 1e-3 / span, rtol=1e-3)
    assert main([*command, "--out", str(out), "--max_run_frames", "30"]) == 0
    assert [len(run.values) for run in load_predictor_error_stats(out).residuals] == [25, 5]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--baseline", "persistence"], "leave --checkpoints and --baseline out"),
        (["--kind", "grid"], "has no run of kind 'grid'"),
        (["--max_run_frames", "0"], "--max_run_frames 0: must be 1 to"),
    ],
)
def test_a_library_that_cannot_be_measured_is_refused(
    dataset: Path,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    exit_code: Callable[[list[str]], int],
    options: list[str],
    words: str,
) -> None:
    library, out = predicted_library(tmp_path), tmp_path / "stats.json"
    command = ["export-stats", "--dataset", str(dataset), "--library", str(library)]
    assert exit_code([*command, "--out", str(out), *options]) == 2
    assert words in caplog.text
    assert not out.exists()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"fps": 25.0}, "is at 25 frames a second, .* at 30; give the dataset"),
        ({"metadata": {}}, "holds no forecasts; make it with face-prediction predict"),
        ({"predicted_mouth": None}, "holds no forecasts; make it with face-prediction predict"),
    ],
)
def test_a_library_of_something_else_is_refused(
    dataset: Path, tmp_path: Path, changes: dict[str, object], words: str
) -> None:
    path = predicted_library(tmp_path)
    save_motion(path, replace(load_motion(path), **changes))
    with FaceDataset(dataset) as opened, pytest.raises(RequestError, match=words):
        library_residuals(opened, path, "natural")
