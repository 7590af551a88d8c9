"""``evaluate`` from a dataset of drawn faces to its files, with toy networks."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import tyro

import face_prediction.evaluate_command as command
from face_prediction.cli import main
from face_prediction.dataset.clip_file import open_clip, read_array
from face_prediction.dataset.reader import FaceDataset
from face_prediction.detector import FaceDetection
from face_prediction.errors import RequestError
from face_prediction.evaluate_command import EvaluateOptions, run_evaluate
from face_prediction.evaluation.clip_story import clip_story
from face_prediction.evaluation.clip_video import FORECASTS, PAUSE, draw_story
from face_prediction.evaluation.provenance import Checkpoint, load_checkpoint
from face_prediction.forecast.mouth import mouth_centre
from face_prediction.lifting import LIPS
from face_prediction.predictor import Forecast, PictureNeeds
from face_prediction.tracks import FaceTrack, save_track
from face_prediction.video import sha256_of

pytestmark = pytest.mark.long

SIZE = (320, 240)
TABLE = """clip,subject,ship,licence,source,what
one.mp4,ann,yes,MIT,here,talk
two.mp4,bob,yes,MIT,here,talk
three.mp4,cat,yes,MIT,here,talk
nod_a.mp4,dan,yes,MIT,here,"talk,nod"
nod_b.mp4,eve,yes,MIT,here,"talk,nod"
"""
CLIPS = ("one", "two", "three", "nod_a", "nod_b")


def draw(track: FaceTrack) -> list[np.ndarray]:
    """A red dot at the mouth of every frame, on a grey pattern that does not move."""
    rng = np.random.default_rng(0)
    ground = cv2.resize(rng.integers(60, 120, (12, 16, 3), dtype=np.uint8), SIZE)
    images = []
    for u, v in track.landmarks[:, list(LIPS), :2].mean(axis=1) * SIZE:
        image = np.asarray(ground).copy()
        cv2.circle(image, (round(u * 16), round(v * 16)), 4 * 16, (255, 20, 20), -1, shift=4)
        images.append(image)
    return images


@pytest.fixture(scope="module")
def dataset(make_track, write_video, tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("faces")
    (root / "videos").mkdir()
    (root / "clips.csv").write_text(TABLE)
    for number, name in enumerate(CLIPS):
        rng = np.random.default_rng(number)
        frames = 33
        mouth = np.tile([0.0, 0.0, -0.5], (frames, 1))
        step = rng.normal(0, 6e-4, (frames, 2))
        mouth[:, :2] = np.cumsum(0.002 * np.cos(np.arange(frames) / 4 + number)[:, None] + step, 0)
        track = make_track(mouth, image_size=SIZE, name=f"{name}.mp4")
        video = write_video(root / "videos" / f"{name}.mp4", draw(track))
        source = {"name": video.name, "sha256": sha256_of(video)}
        save_track(root / "tracks" / f"{name}.npz", replace(track, source=source))
    words = ["build-dataset", root / "tracks", "--videos", root / "videos"]
    words += ["--attribution", root / "clips.csv", "--out", root / "dataset", "--no_progress"]
    words += ["--history", 8, "--future", 5, "--stride", 4, "--crop_size", 64, "--folds", 2]
    assert main([*map(str, words)]) == 0
    return root / "dataset"


def red_dots(pictures: np.ndarray) -> np.ndarray:
    """Where (..., 2) the dot is in pictures (..., S, S, 3)."""
    red = np.clip(pictures[..., 0].astype(float) - pictures[..., 1] - 60, 0, None)
    grid = (np.arange(red.shape[-1]) + 0.5) / red.shape[-1]
    total = red.sum(axis=(-1, -2))
    return np.stack([red.sum(-2) @ grid, red.sum(-1) @ grid], axis=-1) / total[..., None]


@dataclass
class Toy:
    """A network that puts the mouth where the last picture shows it, or where it last was."""

    name: str
    test_fold: int
    train_subjects: tuple[str, ...]
    size: int = 64
    reads: bool = True
    preset: str = "cpu"
    memory: int | None = 1

    @property
    def needs(self) -> PictureNeeds:
        return PictureNeeds(2, self.size)

    def predict(self, landmarks, pictures, horizon: int) -> Forecast:
        last = landmarks[:, -1:]
        shift = red_dots(pictures[:, -1:]) - mouth_centre(last) if self.reads else np.zeros((1, 2))
        ahead = (last + np.reshape(shift, (-1, 1, 1, 2))).repeat(horizon, axis=1)
        if self.name == "blind":
            ahead = np.full_like(ahead, np.nan)
        scale = np.full((len(last), horizon, 2), 0.05, dtype=np.float32)
        copies = pictures[:, -1:].repeat(horizon, axis=1)
        freedom = np.full((horizon, 2), 4.0)
        if self.name == "careless":
            return Forecast(ahead.astype(np.float32))
        return Forecast(ahead.astype(np.float32), copies, scale, freedom)


class DotDetector:
    """All landmarks at the red dot."""

    def __enter__(self) -> DotDetector:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def detect(self, image: np.ndarray, time: float) -> list[FaceDetection]:
        face = np.zeros((468, 3))
        face[:, :2] = red_dots(image)
        return [FaceDetection(face, np.eye(4))]


@pytest.fixture
def toys(dataset: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Toy]:
    """Folder names of checkpoints, and what is loaded from them."""
    with FaceDataset(dataset) as opened:
        people = [
            tuple(sorted({c.subject for c in opened.manifest.clips if c.fold != fold}))
            for fold in range(2)
        ]
    found = {}
    for fold in range(2):
        found[f"reader_{fold}"] = Toy("reader", fold, people[fold])
        found[f"idler_{fold}"] = Toy("idler", fold, people[fold], size=32, reads=False)
        found[f"blind_{fold}"] = Toy("blind", fold, people[fold])
        found[f"careless_{fold}"] = Toy("careless", fold, people[fold], reads=False)

    def load(folder: Path, dataset_sha256: str) -> Checkpoint:
        assert dataset_sha256 == sha256_of(dataset / "dataset.json")
        return Checkpoint(folder, found[folder.name], "0" * 64)

    monkeypatch.setattr(command, "load_checkpoint", load)
    monkeypatch.setattr(command, "open_detector", lambda model: DotDetector())
    return found


def run(dataset: Path, out: Path, *checkpoints: str, **options) -> dict:
    words = {"baselines": ("line",), "resamples": 20, "progress": False, "figures": False}
    folders = tuple(map(Path, checkpoints))
    given = EvaluateOptions(dataset, folders, out=out, **{**words, **options})
    assert run_evaluate(given) == 0
    return json.loads((out / "results.json").read_text())


def rows_of(record: dict, kind: str = "natural") -> dict[str, dict]:
    return {row["name"]: row for row in record["kinds"][kind]["rows"]}


def test_baselines_alone(dataset: Path, tmp_path: Path, capsys) -> None:
    record = run(dataset, tmp_path, baselines=("constant_velocity",))
    # 33 frames: starts 0, 4, ... 20
    assert {k: v["sequences"] for k, v in record["kinds"].items()} == {
        "natural": 18, "head_motion": 12,
    }  # fmt: skip
    rows = rows_of(record)
    assert list(rows) == ["persistence", "constant_velocity"]
    with FaceDataset(dataset) as opened:
        frames = [opened.landmarks(int(i))[:, :, :2] for i in opened.indices(kinds={"natural"})]
    mouth = mouth_centre(np.stack(frames))
    expected = np.abs(mouth[:, 8:] - mouth[:, 7:8]).mean(axis=0)
    found = rows["persistence"]["numbers"]["mean"]["value"]
    np.testing.assert_allclose(found, expected, rtol=1e-6)
    expected = np.linalg.norm(
        mouth[:, 8:] - mouth[:, 7:8] - (mouth[:, 7] - mouth[:, 6])[:, None] * np.c_[1:6], axis=-1
    )
    found = rows["constant_velocity"]["numbers"]["distance"]["value"]
    np.testing.assert_allclose(found, expected.mean(axis=0), rtol=1e-4)
    assert 0.5 < rows["persistence"]["numbers"]["pooled_ssim"]["value"] < 0.999
    assert "ssim" not in rows["constant_velocity"]["numbers"]
    assert record["kinds"]["natural"]["ssim_size"] == 64
    assert "| persistence | 0.0" in capsys.readouterr().out


def test_networks_beside_baselines(dataset: Path, tmp_path: Path, toys) -> None:
    names = ("reader_0", "idler_1", "idler_0", "reader_1")
    record = run(dataset, tmp_path, *names, shuffle_pictures=True)
    rows = rows_of(record)
    assert list(rows) == ["persistence", "line", "reader", "idler"]
    assert record["folds"] == [0, 1]
    assert [c["folder"] for c in record["checkpoints"]] == list(names)
    # the idler is persistence, at half the size: the same pictures, the same numbers
    for key in ("mean", "pooled_ssim"):
        assert rows["idler"]["numbers"][key] == rows["persistence"]["numbers"][key]
    assert record["kinds"]["natural"]["ssim_size"] == 32
    assert "ssim_own_size" not in rows["idler"]["numbers"]
    # the reader copies the last picture, too: what is beside it at its own size is the same
    numbers = rows["reader"]["numbers"]
    assert numbers["ssim_own_size"] == numbers["ssim_copy_own_size"]
    assert numbers["pooled_ssim"]["value"] == pytest.approx(
        rows["persistence"]["numbers"]["pooled_ssim"]["value"], abs=0.02
    )
    # planted information: who reads the pictures gets worse, who does not is not touched
    assert numbers["exchanged"]["value"][0] > 100.0
    assert rows["idler"]["numbers"]["exchanged"] == {
        "value": [0.0] * 3, "low": [0.0] * 3, "high": [0.0] * 3,
    }  # fmt: skip
    assert "exchanged" not in rows["line"]["numbers"]
    # a scale of 0.05 crops around errors of 0.02 or so
    assert numbers["pooled_coverage"]["value"][-1] > 0.9


def test_the_same_command_gives_the_same_bytes(dataset: Path, tmp_path: Path, toys) -> None:
    for name in ("a", "b"):
        run(dataset, tmp_path / name, "reader_0", max_sequences=5, shuffle_pictures=True)
    for path in (tmp_path / "a").iterdir():
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes()
    record = run(dataset, tmp_path / "c", "reader_0", max_sequences=5, seed=1)
    assert record["kinds"]["natural"]["sequences"] == 5
    assert "Of each kind at most 5 sequences" in (tmp_path / "c" / "tables.md").read_text()


def test_a_network_of_pictures_only_is_looked_at_by_the_detector(
    dataset: Path, tmp_path: Path, toys
) -> None:
    rows = rows_of(run(dataset, tmp_path, "blind_0", "blind_1"))
    assert list(rows)[-2:] == ["blind", "detector on the true pictures"]
    blind, reader = rows["blind"], rows_of(run(dataset, tmp_path, "reader_0", "reader_1"))["reader"]
    assert sum(blind["missing"]) == 0
    np.testing.assert_allclose(
        blind["numbers"]["mean"]["value"], reader["numbers"]["mean"]["value"], atol=0.003
    )
    # the truth shows every dot where it is
    truth = rows["detector on the true pictures"]
    assert truth["role"] == "reference"
    assert truth["numbers"]["pooled_distance"]["value"] < 0.02


def test_only_common_folds_are_compared(dataset: Path, tmp_path: Path, toys) -> None:
    record = run(dataset, tmp_path, "reader_0", "idler_0", "idler_1", kinds=("natural",))
    assert record["folds"] == [0]
    with FaceDataset(dataset) as opened:
        count = len(opened.indices(folds={0}, kinds={"natural"}))
    assert record["kinds"]["natural"]["sequences"] == count < 18
    notes = " ".join(record["notes"])
    assert "1 of the dataset's 2 folds" in notes
    assert "idler also has fold 1" in notes


@pytest.mark.parametrize(
    ("checkpoints", "options", "message"),
    [
        (("reader_0", "idler_1"), {}, "no fold is covered by all checkpoints"),
        ((), {"kinds": ("nodding",)}, "--kinds nodding; there are natural, head_motion, grid"),
        ((), {"kinds": ("grid",)}, "no sequence of kind grid"),
        ((), {"baselines": ("best",)}, "baseline 'best'; there are persistence"),
        ((), {"seed": -1}, "--seed -1: 0 or more"),
        ((), {"max_sequences": 1}, "--max_sequences 1: 2 or more"),
        ((), {"detector_model": Path("absent.task")}, "--detector_model absent.task: no such"),
    ],
)
def test_bad_requests(dataset: Path, tmp_path: Path, toys, checkpoints, options, message) -> None:
    with pytest.raises(RequestError, match=message):
        run(dataset, tmp_path / "out", *checkpoints, **options)
    assert not (tmp_path / "out").exists()


def test_who_was_trained_on_is_not_judged_on(
    dataset: Path, tmp_path: Path, toys, monkeypatch
) -> None:
    monkeypatch.setattr(command, "baselines", None)  # refused before anything takes time
    toys["reader_0"].train_subjects += ("ann", "bob", "cat", "dan", "eve")
    with pytest.raises(RequestError, match=r"reader: what forecasts fold 0 was trained on subject"):
        run(dataset, tmp_path, "reader_0")
    toys["idler_0"].test_fold = 7
    with pytest.raises(RequestError, match=r"idler is for fold 7; .* has folds 0 to 1"):
        run(dataset, tmp_path, "idler_0")


def test_every_single_forecast_is_checked(dataset, tmp_path: Path, toys, monkeypatch) -> None:
    """Even where the check before all others has been forgotten."""
    monkeypatch.setattr(command, "require_unseen", lambda *_: None)
    toys["idler_1"].train_subjects += ("ann", "bob", "cat", "dan", "eve")
    with pytest.raises(RequestError, match="idler: what forecasts fold 1 was trained on subject"):
        run(dataset, tmp_path, "idler_1", max_sequences=2)


def test_a_network_for_other_pictures_is_refused(dataset: Path, tmp_path: Path, toys) -> None:
    toys["reader_0"].size = 256
    with pytest.raises(RequestError, match="pictures of 256 pixels: this dataset can give 64, 32"):
        run(dataset, tmp_path, "reader_0")


def test_a_dataset_with_one_fold_has_nobody_to_fit_to(dataset: Path, tmp_path: Path) -> None:
    root = dataset.parent
    words = ["build-dataset", root / "tracks", "--videos", root / "videos", "--folds", 1]
    words += ["--history", 8, "--future", 5, "--stride", 4, "--crop_size", 64, "--no_progress"]
    assert main([*map(str, words), "--out", str(tmp_path / "one")]) == 0
    with pytest.raises(RequestError, match="nobody is left to fit"):
        run(tmp_path / "one", tmp_path / "out")


def test_a_checkpoint_of_another_dataset_is_refused(tmp_path: Path, monkeypatch) -> None:
    learned = pytest.importorskip("face_prediction.models.learned")

    @dataclass
    class Record:
        dataset_sha256: str

    @dataclass
    class Loaded:
        record: Record

    monkeypatch.setattr(
        learned.LearnedPredictor, "load", classmethod(lambda cls, folder: Loaded(Record("a" * 64)))
    )
    with pytest.raises(
        RequestError, match=r"net: was trained with another dataset .*aaaa, not bbb"
    ):
        load_checkpoint(Path("net"), "b" * 64)


def shown(path: Path) -> np.ndarray:
    image = cv2.imread(str(path))
    assert image is not None
    return np.asarray(image)


def test_figures_and_video(dataset: Path, tmp_path: Path, toys) -> None:
    options = {"figures": True, "kinds": ("natural",)}
    run(dataset, tmp_path, "reader_0", "reader_1", "careless_0", "careless_1", **options)
    drawn = sorted(path.name for path in tmp_path.iterdir() if path.suffix in (".png", ".mp4"))
    assert drawn == [
        "calibration.png", "errors.png", "forecast.mp4", "forecast_natural_persistence.png",
        "forecast_natural_reader.png",
    ]  # fmt: skip
    for name in drawn[:2] + drawn[3:]:
        assert shown(tmp_path / name).std() > 10
    # mouth landmarks are drawn in green
    image = shown(tmp_path / "forecast_natural_reader.png")
    assert np.sum((image[..., 1] > 200) & (image[..., 0] < 60) & (image[..., 2] < 60)) > 100
    with av.open(str(tmp_path / "forecast.mp4")) as video:
        assert video.streams.video[0].codec_context.name == "h264"
        frames = sum(1 for _ in video.decode(video=0))
    # six sequences four frames apart: eight frames, four each, the five forecast at the end
    assert frames == 8 + 5 * 4 + 5


def test_the_story_of_a_clip_is_told_in_its_own_pixels(dataset: Path) -> None:
    with FaceDataset(dataset) as opened:
        indices = [i for i in range(len(opened)) if opened.entry(i).clip == "two"]
        path = dataset / "clips" / "two.h5"
        with open_clip(path) as file:
            landmarks = read_array(path, file, "frames/landmarks")
        true = mouth_centre(landmarks) * SIZE
        exact, off = np.zeros((len(indices), 5, 2)), np.array([0.1, -0.2])
        story = clip_story(opened, indices, [("exact", exact), ("off", exact + off)])
    np.testing.assert_allclose(story.mouth, true[story.frames], atol=1e-3)
    assert story.frames.tolist() == list(range(33))
    assert story.origins.tolist() == [7, 11, 15, 19, 23, 27]
    forecasts = story.forecasts[0][1]
    for origin, ahead in zip(story.origins, forecasts, strict=True):
        np.testing.assert_allclose(ahead, true[origin + 1 : origin + 6], atol=1e-3)
    for crop, apart in zip(story.crops[7::4], story.forecasts[1][1] - forecasts, strict=False):
        np.testing.assert_allclose(apart, np.tile(crop.side * off, (5, 1)))
    # and the pictures lie where they were cut: the dot is at the mouth
    for frame, picture, crop in zip(story.frames, story.pictures, story.crops, strict=True):
        dot = red_dots(picture) * crop.side + (crop.left, crop.top)
        np.testing.assert_allclose(dot, true[frame], atol=1.5)
    story = replace(story, forecasts=story.forecasts[:1])
    images = list(draw_story(story))
    assert [image.shape for image in images] == [(560, 1280, 3)] * 33
    # a forecast appears in the plots at the frame it is made at, not before; the truth then comes
    # to lie on it, since this one is exact
    orange = [np.all(image[:, 560:] == FORECASTS[0], axis=-1).sum() for image in images]
    assert orange[0] == orange[6] < orange[8] < orange[7]
    assert orange[-1] == orange[0]
    # and where there is time, the video stops at each
    sparse = [(name, forecast[::2]) for name, forecast in story.forecasts]
    slow = replace(story, origins=story.origins[::2], forecasts=sparse)
    assert sum(1 for _ in draw_story(slow)) == 33 + 3 * PAUSE


def test_the_command_line(capsys) -> None:
    given = tyro.cli(
        EvaluateOptions,
        args=["--dataset", "d", "--checkpoints", "a", "b", "--no-figures",
              "--max_sequences", "9"],
    )  # fmt: skip
    assert given == EvaluateOptions(
        Path("d"), (Path("a"), Path("b")), figures=False, max_sequences=9
    )
