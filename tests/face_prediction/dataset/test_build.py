"""``build-dataset`` from the command line: drawn videos and tracks in, sequences out."""

from __future__ import annotations

import csv
import pickle
from dataclasses import replace

import numpy as np
import pytest

from face_prediction.commands.cli import main
from face_prediction.dataset.build import cut_images
from face_prediction.dataset.manifest import read_manifest
from face_prediction.dataset.reader import FaceDataset
from face_prediction.dataset.sequences import SequenceSettings, clip_frames, find_sequences
from face_prediction.dataset.split import split_dataset
from face_prediction.tracking.geometry import LIPS
from face_prediction.tracking.tracks import save_track
from face_prediction.tracking.video import VideoReader
from robo_manip_baselines.runs.files import file_digest

pytestmark = pytest.mark.long

SIZE = (320, 240)


def test_help_shows_defaults_and_an_example(capsys) -> None:
    with pytest.raises(SystemExit) as exited:
        main(["build-dataset", "--help"])
    assert exited.value.code == 0
    shown = " ".join(capsys.readouterr().out.split())
    for word in ("Example: face-prediction build-dataset", "(default: 70)", "(default: 0.1)"):
        assert word in shown


def test_the_whole_way(folder, capsys) -> None:
    assert folder.run() == 0
    with FaceDataset(folder.root / "dataset") as dataset:
        # starts 0, 4, ... of clips of 20, 24, 28 and 32 frames, in the order of their names
        assert [(c.clip, c.sequences) for c in dataset.manifest.clips] == [
            ("grid_a", 6), ("one", 3), ("three", 5), ("two", 4),
        ]  # fmt: skip
        assert len(dataset) == 18
        kinds = {c.clip: c.kind for c in dataset.manifest.clips}
        assert kinds == {
            "one": "natural", "two": "natural", "three": "head_motion", "grid_a": "grid",
        }  # fmt: skip
        for index in (0, 7, 17):
            sequence = dataset.read(index)
            assert sequence.images.shape == (10, 64, 64, 3)
            assert sequence.images.dtype == np.uint8
            assert sequence.landmarks.shape == (10, 468, 3)
            assert sequence.landmarks.dtype == np.float32
            np.testing.assert_array_equal(sequence.landmarks, dataset.landmarks(index))
            # the picture shows the mouth where the landmarks say it is, in every frame
            red = np.clip(
                sequence.images[..., 0].astype(float) - sequence.images[..., 1] - 30, 0, None
            )
            grid = np.arange(64) + 0.5
            total = red.sum(axis=(1, 2))
            seen = np.stack([red.sum(1) @ grid, red.sum(2) @ grid], axis=-1) / total[:, None] / 64
            centre = sequence.landmarks[:, list(LIPS), :2].mean(axis=1)
            np.testing.assert_allclose(centre, seen, atol=0.8 / 64)  # chroma is at half size
        with (folder.root / "dataset" / "sequences.csv").open() as stream:
            table = list(csv.DictReader(stream))
        rows = dataset.rows()
    assert len(table) == len(rows) == 18
    assert [row["clip"] for row in table] == [row.clip for row in rows]
    assert float(table[8]["mouth_range_x"]) == pytest.approx(
        rows[8].statistics["mouth_range_x"], 1e-5
    )
    shown = capsys.readouterr().out
    assert "| natural | 1 | 2 | 0 | 7 | 0 | 0 | 0 |" in shown
    assert "| head_motion | 1 | 1 | 0 | 5 |" in shown
    assert "| all | 3 | 4 | 0 | 18 |" in shown


def test_a_person_is_in_one_fold(folder) -> None:
    assert folder.run() == 0
    with FaceDataset(folder.root / "dataset") as dataset:
        folds = {clip.subject: clip.fold for clip in dataset.manifest.clips}
        assert sorted(str(fold) for fold in folds.values()) == ["0", "1", "2"]
        parts = [set(dataset.indices(folds={fold}).tolist()) for fold in range(3)]
        assert sorted(set.union(*parts)) == list(range(18))
        assert sum(map(len, parts)) == 18
        subjects = [{dataset.entry(i).subject for i in part} for part in parts]
        assert sorted(map(sorted, subjects)) == [["ann"], ["bob"], ["cat"]]
        assert {dataset.entry(int(i)).clip for i in dataset.indices(kinds={"grid"})} == {"grid_a"}
        split = split_dataset(dataset)
        assert [split.members({fold}).tolist() for fold in range(3)] == list(map(sorted, parts))
        assert split.training({0}).tolist() == sorted(parts[1] | parts[2])
        use = split.uses(0)
        assert (use.train, use.validation, use.test) == ((2,), (1,), (0,))


def test_a_second_run_makes_nothing_and_a_third_only_what_is_missing(folder, caplog) -> None:
    assert folder.run() == 0
    paths = [folder.clip(name) for name in ("one", "two", "three", "grid_a")]
    times = [path.stat().st_mtime_ns for path in paths]
    before = [path.read_bytes() for path in paths]
    manifest = (folder.root / "dataset" / "dataset.json").read_bytes()
    assert folder.run() == 0
    assert "0 made, 4 already up to date, 0 refused" in caplog.text
    assert [path.stat().st_mtime_ns for path in paths] == times
    paths[1].unlink()
    (folder.root / "dataset" / "dataset.json").unlink()  # as a killed run leaves it
    left = paths[1].with_name(".two.h5.99999999.partial")
    left.write_bytes(b"half a clip")
    assert folder.run() == 0
    assert not left.exists()
    assert "1 made, 3 already up to date, 0 refused" in caplog.text
    assert [path.read_bytes() for path in paths] == before  # the same bytes, too
    assert (folder.root / "dataset" / "dataset.json").read_bytes() == manifest
    assert folder.run("--margin", 0.2) == 0
    assert "4 made, 0 already up to date, 0 refused" in caplog.text


def test_only_some_frames_and_smaller_pictures(folder) -> None:
    assert folder.run() == 0
    dataset = FaceDataset(folder.root / "dataset")
    whole = dataset.images(3)
    np.testing.assert_array_equal(dataset.images(3, slice(8, None)), whole[8:])
    np.testing.assert_array_equal(dataset.images(3, slice(4, 5)), whole[4:5])
    half = dataset.images(3, reduce=2)
    assert half.shape == (10, 32, 32, 3)
    mean = whole.reshape(10, 32, 2, 32, 2, 3).mean(axis=(2, 4))
    assert np.abs(half - mean).mean() < 4.0
    with pytest.raises(ValueError, match="reduce 3: one of 1, 2, 4, 8"):
        dataset.images(3, reduce=3)
    for index in (-1, 18):
        with pytest.raises(IndexError, match="has 18"):
            dataset.images(index)
    again = pickle.loads(pickle.dumps(dataset))  # as a worker process is given it
    np.testing.assert_array_equal(again.images(3), whole)
    again.close()
    dataset.close()
    np.testing.assert_array_equal(dataset.images(3), whole)  # opened again
    dataset.close()


def test_frames_of_one_decoded_picture_share_it(tmp_path, make_track, write_video) -> None:
    mouth = np.tile([0.0, 0.0, -0.5], (21, 1))
    track = make_track(mouth, fps=20.0, image_size=SIZE)
    images = [np.full((SIZE[1], SIZE[0], 3), 20 + 10 * i, dtype=np.uint8) for i in range(21)]
    path = write_video(tmp_path / "slow.mp4", images, times=[i / 20 for i in range(21)])
    with VideoReader(path) as video:
        times = np.array([frame.time for frame in video.frames()])
    track = replace(track, source_timestamps=times)
    settings = SequenceSettings(history=8, future=2, stride=4, crop_size=32)
    frames = clip_frames(track, settings)
    sequences = find_sequences(frames, settings)
    pictures = cut_images(path, track, frames, sequences, settings)
    # thirty a second of twenty: 0, 1/2 -> 0, 1, 2, 2, 3, 4, 4, 5, 6
    assert frames.source_frame[:10].tolist() == [0, 1, 1, 2, 3, 3, 4, 5, 5, 6]
    assert pictures.index[0].tolist() == [0, 1, 1, 2, 3, 3, 4, 5, 5, 6]
    assert pictures.index[1][0] == 7
    assert len(pictures.encoded) == pictures.index.max() + 1


def test_a_video_of_another_track_is_refused_by_name(folder, caplog) -> None:
    videos = folder.root / "videos"
    (videos / "one.mp4").write_bytes((videos / "two.mp4").read_bytes())
    assert folder.run("--folds", 2) == 2
    assert "one.npz: was not made from" in caplog.text
    assert "3 made, 0 already up to date, 1 refused" in caplog.text
    assert not folder.clip("one").exists()
    assert len(read_manifest(folder.root / "dataset").clips) == 3


def test_a_truncated_video_is_refused_as_that(folder, caplog) -> None:
    video = folder.root / "videos" / "one.mp4"
    video.write_bytes(video.read_bytes()[:-2000])
    assert folder.run() == 2
    (message,) = [text for text in caplog.messages if "one.mp4" in text]
    assert "truncated" in message


@pytest.mark.parametrize("change", ["frames", "size", "clock"])
def test_a_track_that_does_not_fit_its_video(folder, make_track, caplog, change) -> None:
    """The hash agrees, the content does not: the track was written by another program."""
    video = folder.root / "videos" / "one.mp4"
    frames = 21 if change == "frames" else 20
    size = (640, 480) if change == "size" else SIZE
    track = make_track(np.tile([0.0, 0.0, -0.5], (frames, 1)), image_size=size)
    times = track.source_timestamps + (0.01 if change == "clock" else 0.0)
    source = {"name": "one.mp4", "sha256": file_digest(video)}
    track = replace(track, source=source, source_timestamps=times)
    save_track(folder.root / "tracks" / "one.npz", track)
    assert folder.run() == 2
    words = {
        "frames": "20 frames, its track says 21",
        "size": "320x240 pixels, its track says 640x480",
        "clock": "frame 0 is at 0.0000 s, its track says 0.0100 s",
    }
    assert words[change] in caplog.text
    assert not folder.clip("one").exists()
    assert [path.name for path in folder.clip("one").parent.glob(".*")] == []


def test_a_track_without_faces_and_a_missing_video(folder, make_track, caplog) -> None:
    video = folder.root / "videos" / "one.mp4"
    mouth = np.tile([0.0, 0.0, -0.5], (20, 1))
    track = make_track(mouth, valid=np.zeros(20, dtype=bool), image_size=SIZE)
    source = {"name": "one.mp4", "sha256": file_digest(video)}
    save_track(folder.root / "tracks" / "one.npz", replace(track, source=source))
    (folder.root / "videos" / "two.mp4").unlink()
    assert folder.run("--folds", 2) == 2
    assert "one.mp4: its track holds no frame with a face" in caplog.text
    assert "two.npz: its video 'two.mp4' is in no folder of --videos" in caplog.text
    assert "2 made, 0 already up to date, 2 refused" in caplog.text


def test_a_clip_without_a_row_is_a_person_of_its_own(folder, caplog) -> None:
    (folder.root / "clips.csv").write_text(folder.table.replace("two.mp4", "other.mp4"))
    assert folder.run() == 0
    assert "1 clips have no row in --attribution (two)" in caplog.text
    entry = next(c for c in read_manifest(folder.root / "dataset").clips if c.clip == "two")
    assert (entry.subject, entry.kind, entry.ship) == ("two", "natural", False)


def test_one_video_of_two_people_is_refused(folder, caplog) -> None:
    for part, suffix in (("tracks", "npz"), ("videos", "mp4")):
        whole = (folder.root / part / f"one.{suffix}").read_bytes()
        (folder.root / part / f"copy.{suffix}").write_bytes(whole)
    row = "copy.mp4,dan,yes,MIT,here,talk\n"
    (folder.root / "clips.csv").write_text(folder.table + row)
    assert folder.run() == 2
    assert "clips 'copy' and 'one' are one video, of subjects 'dan' and 'ann'" in caplog.text
    assert not (folder.root / "dataset" / "dataset.json").exists()
    (folder.root / "clips.csv").write_text(folder.table + row.replace("dan", "ann"))
    assert folder.run() == 0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--folds", 4), "--folds 4: only 3 subjects have sequences"),
        (("--folds", 0), "--folds 0: must be 1 to 1000"),
        (("--history", 100), "no sequence of 102 frames in 4 clips"),
        (("--margin", -1), "--margin -1.0: must be 0 to 2"),
        (("--videos", "absent"), "--videos absent: no such folder"),
        (("--attribution", "absent.csv"), "absent.csv: cannot be read"),
    ],
)
def test_bad_requests(folder, caplog, options, message) -> None:
    assert folder.run(*options) == 2
    assert message in caplog.text
    assert not (folder.root / "dataset" / "dataset.json").exists()


def test_other_folders_are_left_alone(folder, caplog) -> None:
    out = folder.root / "dataset"
    out.mkdir()
    (out / "precious.txt").write_text("precious")
    assert folder.run() == 2
    assert "holds precious.txt and no dataset" in caplog.text
    assert not (out / "clips").exists()
    (out / "precious.txt").unlink()
    (out / "dataset.json").write_text('{"schema": "other", "version": 1}')
    assert folder.run() == 2
    assert "schema 'other' version 1, this release reads 'face_dataset' 1" in caplog.text
