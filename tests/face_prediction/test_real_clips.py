"""MediaPipe on real footage (needs the development clips and the detector)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from face_prediction.commands.cli import main
from face_prediction.motion.motion import step_tremor
from face_prediction.tracking.detector import DetectorSettings, FaceDetector
from face_prediction.tracking.geometry import (
    CANONICAL_MOUTH,
    LIPS,
    head_pose_from_landmarks,
    mouth_centres,
    read_canonical_face,
    rigid_face,
)
from face_prediction.tracking.tracks import FaceTrack, load_track
from face_prediction.tracking.video import VideoReader

pytestmark = [pytest.mark.shared, pytest.mark.long]

pytest.importorskip(
    "mediapipe", reason="MediaPipe is not installed (extra face_prediction)", exc_type=ImportError
)


@pytest.fixture(scope="module")
def model(shared_dir: Path) -> Path:
    return shared_dir / "faces" / "face_landmarker.task"


@pytest.fixture(scope="module")
def clips(shared_dir: Path) -> Path:
    return shared_dir / "faces" / "clips"


@pytest.fixture(scope="module")
def extract(clips: Path, model: Path, tmp_path_factory):
    def run(name: str, *options: str) -> FaceTrack:
        out = tmp_path_factory.mktemp("tracks")
        words = ["extract", str(clips / f"{name}.mp4"), "--model", str(model), "--out", str(out)]
        assert main([*words, "--no_progress", *options]) == 0
        return load_track(out / f"{name}.npz")

    return run


def test_a_talking_face(extract, capfd) -> None:
    track = extract("pyfeat_single_face")
    assert track.valid.all()
    assert track.fps == 30.0
    assert track.detector["smoothed"] is False
    assert capfd.readouterr().err == ""  # MediaPipe's native messages are kept off the terminal
    # landmarks in the image, a head in front of the camera and the right way up
    assert np.all((track.landmarks[..., :2] > 0) & (track.landmarks[..., :2] < 1))
    assert np.all(track.head_pose[:, 2, 3] < -0.1)
    assert np.all(track.head_pose[:, 1, 1] > 0.9)
    # the pose and the lips agree to 8 % of the distance between the eyes (63 mm)
    mouth = mouth_centres(track.landmarks.astype(float), track.head_pose, track.image_size)
    rigid = track.head_pose[:, :3, :3] @ CANONICAL_MOUTH + track.head_pose[:, :3, 3]
    assert np.linalg.norm(mouth - rigid, axis=1).max() < 0.08 * 0.063 * 2
    assert 0 <= track.jaw.min() < track.jaw.max() < 0.06


def test_a_width_that_is_no_multiple_of_32(extract) -> None:
    assert extract("grid10_bbaf2n").valid.all()  # 360 pixels


def test_a_variable_rate(extract) -> None:
    track = extract("vrt_1")
    assert track.source["variable_rate"]
    assert len(track) == 183  # 6.1 s, from 135 decoded frames
    assert track.valid.all()
    np.testing.assert_allclose(np.diff(track.timestamps), 1 / 30)


def test_a_face_of_a_twentieth_of_the_frame(extract) -> None:
    whole = extract("intel_asl_yes", "--no_zoom")
    track = extract("intel_asl_yes")
    assert track.valid.mean() >= whole.valid.mean()
    assert track.source["frames_zoomed"] > 0.9 * track.source["frames"]
    both = track.valid & whole.valid
    centres = [
        mouth_centres(t.landmarks[both].astype(float), t.head_pose[both], t.image_size)
        for t in (track, whole)
    ]
    # the same place in the same camera, to 4 % of the distance; and a steadier one
    assert np.median(np.abs(centres[0] - centres[1])) < 0.04 * -np.median(centres[1][:, 2])
    assert step_tremor(centres[0][:, 2]) < step_tremor(centres[1][:, 2])


def test_video_mode_smooths_and_image_mode_does_not(extract) -> None:
    image = extract("carphone")
    video = extract("carphone", "--running_mode", "video", "--no_zoom")
    assert video.detector["smoothed"] is True
    lips = [track.landmarks[:, list(LIPS), 1].mean(axis=1) for track in (image, video)]
    assert step_tremor(lips[1]) < 0.8 * step_tremor(lips[0])


def test_our_pose_is_mediapipes(clips: Path, model: Path) -> None:
    face = read_canonical_face(model)
    np.testing.assert_allclose(face.vertices[list(LIPS)].mean(axis=0), CANONICAL_MOUTH, atol=1e-6)
    rigid = rigid_face()
    kept = rigid.weights > 0
    np.testing.assert_allclose(rigid.vertices[kept], face.vertices[kept], atol=1e-7)
    np.testing.assert_allclose(rigid.weights[kept], face.weights[kept], atol=1e-6)
    with (
        VideoReader(clips / "lp_s18.mp4") as video,
        FaceDetector(model, DetectorSettings()) as detector,
    ):
        for frame, _ in zip(video.frames(), range(10), strict=False):
            height, width = frame.image.shape[:2]
            (found,) = detector.detect(frame.image, frame.time)
            pose = head_pose_from_landmarks(found.landmarks, (width, height), face)
            # MediaPipe computes in single precision: 5 micrometres at a metre
            np.testing.assert_allclose(pose, found.head_pose, atol=2e-5)


def test_a_model_of_another_kind_is_refused(clips: Path, tmp_path: Path, caplog, exit_code) -> None:
    path = tmp_path / "face_landmarker.task"
    path.write_bytes(b"no model")
    words = ["extract", str(clips / "carphone.mp4"), "--model", str(path), "--out", str(tmp_path)]
    assert exit_code(words) == 2
    assert "cannot load it as a face landmarker model" in caplog.text
