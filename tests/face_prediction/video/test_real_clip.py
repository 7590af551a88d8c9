"""Real footage stored turned, mirrored and squeezed gives the motion of the footage itself."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
import pytest

from face_prediction.commands.cli import main
from face_prediction.tracking.detector import DetectorSettings, FaceDetector
from face_prediction.tracking.display import turned
from face_prediction.tracking.extract import ExtractSettings, extract_track
from face_prediction.tracking.geometry import mouth_centres
from face_prediction.tracking.tracks import FaceTrack, load_track
from face_prediction.tracking.video import VideoReader

pytestmark = [pytest.mark.shared, pytest.mark.long]

pytest.importorskip(
    "mediapipe", reason="MediaPipe is not installed (extra face_prediction)", exc_type=ImportError
)

FRAMES = 8


@pytest.fixture(scope="module")
def model(shared_dir: Path) -> Path:
    return shared_dir / "faces" / "face_landmarker.task"


@pytest.fixture(scope="module")
def images(shared_dir: Path) -> list[np.ndarray]:
    with VideoReader(shared_dir / "faces" / "clips" / "pyfeat_single_face.mp4") as video:
        return [frame.image for frame, _ in zip(video.frames(), range(FRAMES), strict=False)]


def mouth(path: Path, model: Path) -> np.ndarray:
    """Mouth centres (T, 3) in metres of the track of a video."""
    with FaceDetector(model, DetectorSettings()) as detector:
        track: FaceTrack = extract_track(path, detector, ExtractSettings())
    assert track.valid.all()
    return mouth_centres(track.landmarks.astype(float), track.head_pose, track.image_size)


def test_every_way_of_storing_a_clip(tmp_path, images, model, encode, set_matrix) -> None:
    reference = mouth(encode(tmp_path / "reference.mp4", images), model)
    # x, y and z to 4 mm at 0.3 m: each variant is compressed on its own, and its pixels are others
    for number, matrix in enumerate([(-1, 0, 0, 1), (1, 0, 0, -1), (0, 1, 1, 0), (0, 1, -1, 0)]):
        undone = np.linalg.inv(np.array(matrix, dtype=float).reshape(2, 2).T).astype(int)
        path = encode(tmp_path / f"{number}.mp4", [turned(image, undone) for image in images])
        set_matrix(path, matrix)
        np.testing.assert_allclose(mouth(path, model), reference, atol=4e-3)
    height, width = images[0].shape[:2]
    squeezed = [
        cv2.resize(image, (width // 2, height), interpolation=cv2.INTER_AREA) for image in images
    ]
    path = encode(tmp_path / "squeezed.mp4", squeezed, sar=Fraction(2))
    np.testing.assert_allclose(mouth(path, model), reference, atol=8e-3)


def test_damage_in_real_footage_is_not_measured(shared_dir, model, tmp_path, caplog) -> None:
    """Two bytes flipped, as on a bad disk: what is still valid is what it was."""
    import av

    clip = shared_dir / "faces" / "clips" / "carphone.mp4"
    with av.open(str(clip)) as container:
        packets = [packet for packet in container.demux(video=0) if packet.size]
        places = [(packet.pos or 0, packet.size) for packet in packets]
    data = bytearray(clip.read_bytes())
    for number in (len(places) // 4, len(places) // 2):
        place, size = places[number]
        data[place + max(60, size // 2)] ^= 0x55
    (tmp_path / "flipped.mp4").write_bytes(data)
    caplog.set_level("INFO")
    for path in (clip, tmp_path / "flipped.mp4"):
        words = ["extract", str(path), "--model", str(model), "--out", str(tmp_path)]
        assert main([*words, "--no_progress", "--no_zoom", "--fps", "None"]) == 0
    assert "2 damaged of the video's 120 frames left out" in caplog.text
    whole, flipped = (load_track(tmp_path / f"{name}.npz") for name in ("carphone", "flipped"))
    assert np.sum(whole.valid & ~flipped.valid) == 2
    np.testing.assert_array_equal(flipped.landmarks[flipped.valid], whole.landmarks[flipped.valid])


def test_two_frames_in_one_millisecond(tmp_path, images, model, encode) -> None:
    times = [index / 30 for index in range(FRAMES)]
    times[6] = times[5] + 0.0004
    close = encode(tmp_path / "close.mp4", images, times=times, options={"bf": "0"})
    plain = encode(tmp_path / "plain.mp4", images)
    words = ["extract", str(close), str(plain), "--model", str(model), "--out", str(tmp_path)]
    assert main([*words, "--no_progress", "--running_mode", "video", "--no_zoom"]) == 0
    assert load_track(tmp_path / "close.npz").valid.any()
