"""``evaluate`` from a dataset of drawn faces to its numbers, with toy networks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tyro

from face_prediction.commands import cli
from face_prediction.commands.evaluate import EvaluateOptions
from face_prediction.dataset.reader import FaceDataset
from face_prediction.dataset.split import split_dataset
from face_prediction.dataset.tracks import dataset_stretches
from face_prediction.evaluation import predictors
from face_prediction.forecast import Forecaster, LandmarkSequences
from face_prediction.forecast.interface import mouth_centre
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import write_json

from .conftest import rows_of, run

pytestmark = pytest.mark.long


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
    # whole tracks have the copy of the last frame, too, which copies no image there
    assert [row["name"] for row in record["tracks"]["natural"]["rows"]] == list(rows)


def test_a_shorter_warm_up_forecasts_from_more_frames(dataset: Path, tmp_path: Path) -> None:
    only = {"baselines": ("constant_velocity",), "max_sequences": 2, "resamples": 2}
    found = [
        run(dataset, tmp_path / str(warm_up), **only, warm_up=warm_up)["tracks"]
        for warm_up in (None, 7, 3, 20)
    ]
    assert [tracks["warm_up"] for tracks in found] == [7, 7, 3, 20]  # a history has 8 frames
    assert found[0] == found[1]
    with FaceDataset(dataset) as opened:
        clips = [s for s in dataset_stretches(opened) if s.kind == "natural"]
    more = found[2]["natural"]["forecasts"] - found[0]["natural"]["forecasts"]
    assert more == 4 * len(clips)
    for row in found[3]["natural"]["rows"]:  # of 33 frames none has an outcome 18 ahead
        for key in ("mean_abs", "difference"):
            assert [value is None for value in row[key]] == [False] * 4 + [True] * 2
    text = (tmp_path / "3" / "tracks.md").read_text()
    assert "Every frame of a face but the first 3 is forecast from" in text


def test_windows_of_people_who_were_trained_on(dataset: Path, tmp_path: Path, monkeypatch) -> None:
    """Ten windows of 13 frames, two a clip; a baseline is fitted to no frame that it forecasts."""
    fitted: list[set[bytes]] = []
    fit = predictors.fit_forecaster

    def watch(name: str, sequences: LandmarkSequences) -> Forecaster:
        if name == "ar_mouth":
            frames = sequences.landmarks.reshape(-1, 468, 2)
            centred = frames - frames[:, :1]  # one frame has other places in other crops
            fitted.append({np.round(frame, 4).tobytes() for frame in centred})
        return fit(name, sequences)

    monkeypatch.setattr(predictors, "fit_forecaster", watch)
    record = run(dataset, tmp_path, baselines=("ar_mouth",), split="sequence")
    assert record["split"]["by"] == "sequence"
    assert record["split"]["parts"] == len(fitted) == 10
    assert {k: v["sequences"] for k, v in record["kinds"].items()} == {
        "natural": 6, "head_motion": 4,
    }  # fmt: skip
    assert "tracks" not in record
    assert record["notes"] == ["Whole tracks hold frames that were trained on, and are left out."]
    text = (tmp_path / "tables.md").read_text()
    assert "trained on, too, in windows that share no frame" in text
    assert "Parts reported on: 0, 1" in text
    assert "never saw the person" not in text
    with FaceDataset(dataset) as opened:
        split = split_dataset(opened, "sequence")
        for part, frames in enumerate(fitted):
            assert len(frames) >= 13
            for index in split.members({part}).tolist():
                points = opened.landmarks(index)[..., :2]
                shapes = [np.round(frame - frame[:1], 4).tobytes() for frame in points]
                assert not frames & set(shapes)


def test_networks_beside_baselines(dataset: Path, tmp_path: Path, toys) -> None:
    names = ("reader_0", "idler_1", "idler_0", "reader_1")
    record = run(dataset, tmp_path, *names, shuffle_images=True)
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
    # shuffled images: a network that reads them gets worse, one that does not is not touched
    assert numbers["exchanged"]["value"][0] > 100.0
    assert rows["idler"]["numbers"]["exchanged"] == {
        "value": [0.0] * 3, "low": [0.0] * 3, "high": [0.0] * 3,
    }  # fmt: skip
    assert "exchanged" not in rows["line"]["numbers"]
    # a scale of 0.05 crops around errors of 0.02 or so
    assert numbers["pooled_coverage"]["value"][-1] > 0.9


def test_the_same_command_gives_the_same_bytes(dataset: Path, tmp_path: Path, toys) -> None:
    for name in ("a", "b"):
        run(dataset, tmp_path / name, "reader_0", max_sequences=5, shuffle_images=True)
    for path in (tmp_path / "a").iterdir():
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes()
    record = run(dataset, tmp_path / "c", "reader_0", max_sequences=5, seed=1)
    assert record["kinds"]["natural"]["sequences"] == 5
    assert "Of each kind at most 5 sequences" in (tmp_path / "c" / "tables.md").read_text()


def test_files_of_an_earlier_evaluation_are_removed(dataset: Path, tmp_path: Path, toys) -> None:
    tables = {"tables.md", "table1.csv", "table2.csv"}
    tracks = {"tracks.md", "people.csv"}
    pictures = {"errors.png", "forecast.mp4", "forecast_natural_persistence.png"}
    only = {"kinds": ("natural",), "max_sequences": 6}
    networks = "reader_0", "reader_1"
    of_network = {"calibration.png", "forecast_natural_reader.png"}
    for checkpoints, options, expected in (
        (networks, {"figures": True}, tables | tracks | pictures | of_network),
        ((), {"figures": True}, tables | tracks | pictures),
        ((), {"figures": True, "tracks": False}, tables | pictures),
        ((), {"tracks": False}, tables),
    ):
        record = run(dataset, tmp_path, *checkpoints, **only, **options)
        (tmp_path / "notes.txt").touch()
        assert record["files"] == sorted(expected)
        assert {p.name for p in tmp_path.iterdir()} == expected | {"results.json", "notes.txt"}


def test_files_that_no_evaluation_has_listed_are_kept(dataset: Path, tmp_path: Path) -> None:
    out, outside = tmp_path / "out", tmp_path / "mine.txt"
    quick = {"kinds": ("natural",), "max_sequences": 2, "tracks": False}
    record = run(dataset, out, **quick)
    outside.touch()
    (out / "gains.png").touch()
    (out / "folder").mkdir()
    del record["files"]  # as earlier releases wrote it
    write_json(out / "results.json", record)
    again = run(dataset, out, **quick)
    assert (out / "gains.png").exists()
    listed = [*again["files"], "../mine.txt", str(outside), "..", ".", "", "folder", "absent.png"]
    write_json(out / "results.json", {**record, "files": listed})
    assert run(dataset, out, **quick) == again
    assert outside.exists()
    assert (out / "folder").exists()
    write_json(out / "results.json", {**record, "files": "gains.png"})
    with pytest.raises(RequestError, match=r"results.json': files: must be a list"):
        run(dataset, out, **quick)


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


def test_the_command_line(capsys) -> None:
    given = tyro.cli(
        EvaluateOptions,
        args=["--dataset", "d", "--checkpoints", "a", "b", "--no-figures",
              "--max_sequences", "9"],
    )  # fmt: skip
    assert given == EvaluateOptions(
        Path("d"), (Path("a"), Path("b")), figures=False, max_sequences=9
    )


@pytest.mark.parametrize("option", ["--shuffle_images", "--shuffle-images", "--shuffle_pictures"])
def test_the_old_name_of_the_ablation_works(option: str, monkeypatch) -> None:
    given: list[EvaluateOptions] = []

    def note(options: EvaluateOptions) -> None:
        given.append(options)

    monkeypatch.setattr("face_prediction.commands.evaluate.run_evaluate", note)
    assert cli.main(["evaluate", "--dataset", "d", option]) == 0
    assert given[0].shuffle_images
