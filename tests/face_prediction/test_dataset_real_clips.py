"""``build-dataset`` on real footage (needs the development clips and the detector)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from face_prediction.commands.cli import main
from face_prediction.dataset.reader import FaceDataset
from face_prediction.tracking.detector import DetectorSettings, FaceDetector
from face_prediction.tracking.geometry import LIPS

pytestmark = [pytest.mark.shared, pytest.mark.long]

pytest.importorskip(
    "mediapipe", reason="MediaPipe is not installed (extra face_prediction)", exc_type=ImportError
)

#: 29.97 frames a second and a moving head; 25 a second; a small face in 640x480
CLIPS = ("carphone", "grid10_bbaf2n", "intel_asl_book")


@pytest.fixture(scope="module")
def dataset(shared_dir: Path, tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("faces")
    faces = shared_dir / "faces"
    videos = [str(faces / "clips" / f"{name}.mp4") for name in CLIPS]
    words = ["--model", str(faces / "face_landmarker.task"), "--out", str(root / "tracks")]
    assert main(["extract", *videos, *words, "--no_progress"]) == 0
    words = ["--videos", str(faces / "clips"), "--attribution", str(faces / "CLIPS.md")]
    words += ["--out", str(root / "dataset"), "--folds", "3", "--no_progress"]
    assert main(["build-dataset", str(root / "tracks"), *words]) == 0
    return root / "dataset"


def test_the_detector_sees_in_the_pictures_what_the_landmarks_say(dataset, shared_dir) -> None:
    """A picture cut, shrunk, compressed and read again still shows the same face, to 1.5 %."""
    model = shared_dir / "faces" / "face_landmarker.task"
    with FaceDataset(dataset) as data, FaceDetector(model, DetectorSettings()) as detector:
        clips = {data.entry(i).clip: i for i in range(len(data))}
        assert set(clips) == set(CLIPS)
        for clip, index in clips.items():
            sequence = data.read(index)
            assert sequence.images.shape == (75, 256, 256, 3)
            # where a frame lies between two decoded ones the picture is up to 20 ms off
            frames = np.argsort(np.abs(sequence.image_lag))[:3]
            for frame in frames:
                (face,) = detector.detect(sequence.images[frame], float(frame))
                stored = sequence.landmarks[frame, list(LIPS), :2].mean(axis=0)
                seen = face.landmarks[list(LIPS), :2].mean(axis=0)
                assert np.abs(stored - seen).max() < 0.015, (clip, frame)
                far = np.abs(face.landmarks[:468, :2] - sequence.landmarks[frame, :, :2])
                assert np.median(far) < 0.015, (clip, frame)


def test_kinds_rates_and_size(dataset) -> None:
    with FaceDataset(dataset) as data:
        kinds = {clip.clip: clip.kind for clip in data.manifest.clips}
        assert kinds == {
            "carphone": "head_motion", "grid10_bbaf2n": "grid", "intel_asl_book": "natural",
        }  # fmt: skip
        rows = data.rows()
    found = {row.clip: row.statistics for row in rows}
    # of 25 frames a second five in six are made from two; the pictures are at most half a frame off
    assert found["grid10_bbaf2n"]["interpolated_share"] == pytest.approx(62 / 75, abs=0.02)
    assert found["grid10_bbaf2n"]["image_lag"] <= 0.0201
    # a reader of sentences hardly moves the head; the man in the car does
    assert found["grid10_bbaf2n"]["mouth_range_u"] < 0.05 < found["carphone"]["mouth_range_u"]
    # 1000 sequences in less than 2 GB
    size = sum(path.stat().st_size for path in dataset.rglob("*") if path.is_file())
    assert size / len(rows) < 2e6
