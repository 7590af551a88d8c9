"""The mouth in metres, now and in the next frames, from the images of a camera that is known.

The lips are found in each image, put back on the head where something hides them, forecast by the
shipped predictor, and lifted: across by the rays of their pixels, along by the size of the head,
that of MediaPipe's canonical face, or by a depth image. Camera frame: x right in the image, y up,
the camera looks along -z; metres.

Legend: H horizon, L = 468 landmarks.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from face_prediction.forecast import mouth_centre
from face_prediction.live.sources import FindFace, follow_face
from face_prediction.live.streaming import FollowingForecaster, LiveForecast, StreamingPredictor
from face_prediction.tracking.detector import DetectorSettings, FaceDetector, find_model
from face_prediction.tracking.extract import MAX_GAP
from face_prediction.tracking.geometry import (
    CANONICAL_MOUTH,
    CENTIMETRE,
    LIPS,
    RIGID_LANDMARKS,
    image_rays,
    read_canonical_face,
    view_size,
)
from face_prediction.tracking.tracks import Size
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.extras import install_command

Floats = NDArray[np.float64]

DEPTH_MEMORY = 0.3
"""s, time constant of the mean of distances. A pixel of a head 120 pixels wide is 5 mm at 0.6 m,
and a head comes nearer more slowly than it moves across."""

HEAD_DEPTH = 0.04
"""m by which measured distances of a head may be off from their median: what is farther off is a
hand before it or a wall behind it."""

HEAD_SHARE = 0.75
"""Quantile of the distances at the rigid landmarks that is taken for the head's: what hides some of
them, a gripper or the nose, is nearer. That the others are a little nearer, too, is made up for by
the lips' distance from it."""

LIP_CHANGE = 0.01
"""m by which the lips' distance from the head may change once it is known."""

LIP_DEPTH = 0.03
"""m, likewise of the outer lips: 5 cm wide, seen from the side, and tilted by an open jaw."""

LIP_IMAGES = 30
"""Images, a second of them, over which the distance of the lips from the head is averaged."""

LEAST_RIGID, LEAST_LIPS = 8, 19
"""Landmarks, of 25 and of 20, that must be within: the nose hides some of the former, and of the
latter, which lie at different depths, the mean must not lean to one side."""

ANCHOR = (6, 119, 121, 133, 348, 350, 362)
"""Rigid landmarks about the bridge of the nose. What hides the mouth draws the lips towards it, by
11 mm, and these by 4 (16 approaches of the gripper in ``front_close``)."""

LIP_SHIFT = 0.006
"""m by which the lips may move on the head in earnest, by speech and the jaw. Farther away they are
taken for hidden, from half of it on in part."""

LIP_MEMORY = 90
"""Images, 3 s of them, over which the place of the lips on the head is averaged."""

TURN_MEMORY = 0.3
"""s, time constant of the mean of the head's turn, which what hides the lips disturbs, too."""

# fmt: off
OUTER_LIPS = (
    0, 17, 37, 39, 40, 61, 84, 91, 146, 181, 185, 267, 269, 270, 291, 314, 321, 375, 405, 409,
)
# fmt: on
"""Landmarks on the outer edge of the lips: skin, whatever the mouth does."""

_RIGID = np.array(RIGID_LANDMARKS)
_INDEX = _RIGID[:, 0].astype(int)
_POINTS = _RIGID[:, 1:4] * CENTIMETRE
_TO_OPENCV = np.diag([1.0, -1.0, -1.0])  # OpenCV's camera: y down, looking along +z


def head_pose_of_points(points: NDArray[np.floating], image_size: Size, fov: float) -> Floats:
    """Pose (4, 4) in metres, camera from head, that projects the rigid landmarks onto ``points``.

    The relative depth that the detector gives is not used: with the field of view known, the
    pixels determine the pose of a head of known size.

    Args:
        points: (L, 2 or 3) normalised image coordinates.
        image_size: pixels.
        fov: degrees, vertical.
    """
    import cv2

    width, height = view_size(image_size, fov)
    pixels = np.asarray(points, dtype=np.float64)[_INDEX, :2]
    flat = np.ascontiguousarray((pixels - 0.5) * (width, height))  # one unit ahead, y down
    lens = np.eye(3)
    _, turn, move = cv2.solvePnP(_POINTS, flat, lens, None, flags=cv2.SOLVEPNP_SQPNP)
    turn, move = cv2.solvePnPRefineLM(_POINTS, flat, lens, None, turn, move)
    pose = np.eye(4)
    pose[:3, :3] = _TO_OPENCV @ cv2.Rodrigues(turn)[0]
    pose[:3, 3] = _TO_OPENCV @ move.ravel()
    return pose


def agreed_excess(
    points: NDArray[np.floating],
    expected: NDArray[np.floating] | float,
    depth: NDArray[np.floating],
    tolerance: float,
    least: int,
    share: float | None = None,
) -> float | None:
    """Distance in m by which points are farther away in a depth image than expected.

    Args:
        points: (P, 2) normalised image coordinates.
        expected: (P,) m along the view, or one for all.
        depth: (rows, columns) m along the view.
        tolerance: m from the median within which a point counts.
        least: points that must count; None is returned with fewer.
        share: quantile of those that count which is returned; their mean if None.
    """
    rows, columns = depth.shape
    pixels = np.floor(points * (columns, rows)).astype(int)
    inside = np.all((pixels >= 0) & (pixels < (columns, rows)), axis=1)
    across, down = pixels[inside].T
    excess = depth[down, across] - np.broadcast_to(expected, len(points))[inside]
    if len(excess) < least:
        return None
    ours = np.abs(excess - np.median(excess)) < tolerance
    if ours.sum() < least:
        return None
    return float(excess[ours].mean() if share is None else np.quantile(excess[ours], share))


class LipMemory:
    """Place of the lips on the head, which remains while something hides them.

    A detector that does not see lips makes them up, near the edge of what hides them. The
    upper part of the face it still sees, and the lips are where they have been on it. What
    lasts is believed after some seconds: a mouth may have opened wide.
    """

    def __init__(self) -> None:
        self._place = np.zeros(3)
        self._images = 0
        self._turn, self._seen = np.eye(3), -math.inf

    def restore(
        self,
        points: NDArray[np.floating],
        turn: Floats,
        distance: float,
        time: float,
        image_size: Size,
        fov: float,
    ) -> NDArray[np.floating]:
        """Return landmarks with the lips where they are on the head, if they seem to be elsewhere.

        Args:
            points: (L, 2 or 3) normalised image coordinates.
            turn: (3, 3) camera from head.
            distance: m along the view.
            time: s, later than that of the image before.
            image_size: pixels.
            fov: degrees, vertical.
        """
        turn = self._averaged(turn, time)
        anchor, lips = (
            image_rays(points[list(chosen), :2], image_size, fov).mean(axis=0) * distance
            for chosen in (ANCHOR, LIPS)
        )
        place = turn.T @ (lips - anchor)
        if self._images == 0:
            self._place = place
        shift = place - self._place
        size = math.sqrt(shift @ shift)
        if size < LIP_SHIFT:
            self._images = min(self._images + 1, LIP_MEMORY)
            self._place = self._place + shift / self._images
        else:
            self._place = self._place + shift * (LIP_SHIFT / size / LIP_MEMORY)
        doubt = min(max(2.0 * size / LIP_SHIFT - 1.0, 0.0), 1.0)
        if not doubt:
            return points
        restored = lips - doubt * (turn @ shift)
        across = restored[:2] / -restored[2] - lips[:2] / -lips[2]
        points = points.copy()
        points[list(LIPS), :2] += across * (1.0, -1.0) / view_size(image_size, fov)
        return points

    def _averaged(self, turn: Floats, time: float) -> Floats:
        """Mean of the turns so far, the later ones weighing more; afresh after a gap."""
        import cv2

        gap, self._seen = time - self._seen, time
        if gap > MAX_GAP:
            self._turn = turn
        else:
            step = cv2.Rodrigues(turn @ self._turn.T)[0]
            weight = 1.0 - math.exp(-gap / TURN_MEMORY)
            self._turn = cv2.Rodrigues(weight * step)[0] @ self._turn
        return self._turn


class Forecaster(Protocol):
    """Source of forecasts, a `StreamingPredictor`."""

    def update(
        self, time: float, landmarks: NDArray[np.floating] | None, image: NDArray[np.uint8]
    ) -> LiveForecast | None:
        """Take one frame in, and forecast the next ones; None: there is no face."""
        ...

    def reset(self) -> None:
        """Forget everything."""
        ...


class MouthTracker:
    """The mouth now and 1 ... H frames of 1/30 s ahead, from images one after another.

    Args:
        follow: begins to follow a face, see `follow_face`.
        forecaster: of the landmarks.
        fov: degrees, vertical field of view.
        close: frees the detector.
    """

    def __init__(
        self,
        follow: Callable[[], FindFace],
        forecaster: Forecaster,
        fov: float,
        close: Callable[[], None] = lambda: None,
    ) -> None:
        self._follow, self._forecaster, self._fov = follow, forecaster, fov
        self.close = close
        self.reset()

    def reset(self) -> None:
        """Forget everything: the next image is of another scene."""
        self._find = self._follow()
        self._forecaster.reset()
        self._distance: float | None = None
        self._seen, self._count = -math.inf, 0
        self._lips, self._lip_images = 0.0, 0
        self._memory = LipMemory()

    def update(
        self, image: NDArray[np.uint8], time: float, depth: NDArray[np.floating] | None = None
    ) -> Floats | None:
        """Take in an image.

        Args:
            image: (rows, columns, 3) uint8 RGB.
            time: s, later than that of the image before.
            depth: (rows, columns) m along the view; None for a camera without.

        Returns:
            (H + 1, 3) m, camera frame; None where no face was found.
        """
        landmarks = self._find(image, time)
        size, distance = (image.shape[1], image.shape[0]), 0.0
        if landmarks is not None:
            pose = head_pose_of_points(landmarks, size, self._fov)
            distance = -float((pose[:3, :3] @ CANONICAL_MOUTH + pose[:3, 3])[2])
            if depth is not None:
                distance = self._measured(landmarks[:, :2], pose, distance, depth)
            distance = self._smoothed(distance, time)
            turn = pose[:3, :3]
            landmarks = self._memory.restore(landmarks, turn, distance, time, size, self._fov)
        forecast = self._forecaster.update(time, landmarks, image)
        if landmarks is None or forecast is None:
            return None
        track = np.vstack([mouth_centre(landmarks)[None], mouth_centre(forecast.landmarks)])
        return image_rays(track, size, self._fov) * distance

    def _measured(
        self,
        points: NDArray[np.floating],
        pose: Floats,
        distance: float,
        depth: NDArray[np.floating],
    ) -> float:
        """Distance of the mouth by a depth image: of the head, and of the lips from the head.

        The lips' is the mean so far, the later ones weighing more: it is what remains while
        something hides the mouth.
        """
        expected = -(_POINTS @ pose[:3, :3].T + pose[:3, 3])[:, 2]
        farther = agreed_excess(
            points[_INDEX], expected, depth, HEAD_DEPTH, LEAST_RIGID, HEAD_SHARE
        )
        if farther is None:
            return distance + self._lips
        distance += farther
        lips = agreed_excess(points[list(OUTER_LIPS)], distance, depth, LIP_DEPTH, LEAST_LIPS)
        change = LIP_CHANGE if self._lip_images >= LIP_IMAGES else LIP_DEPTH
        if lips is not None and abs(lips - self._lips) < change:
            self._lip_images += 1
            self._lips += (lips - self._lips) / min(self._lip_images, LIP_IMAGES)
        return distance + self._lips

    def _smoothed(self, distance: float, time: float) -> float:
        """Mean of the distances so far, the later ones weighing more; afresh after a gap."""
        gap = time - self._seen
        if self._distance is None or gap > MAX_GAP:
            self._distance, self._count = distance, 0
        self._count += 1
        weight = max(1.0 - math.exp(-gap / DEPTH_MEMORY), 1.0 / self._count)
        self._distance += weight * (distance - self._distance)
        self._seen = time
        return self._distance


def open_tracker(fov: float, horizon: int) -> MouthTracker:
    """Make a tracker with MediaPipe's detector and the shipped predictor.

    The detector's model file is that of `find_model`: downloaded once, to the user's cache.

    Args:
        fov: degrees, vertical field of view of the camera.
        horizon: frames of 1/30 s ahead, at most 24.

    Raises:
        RequestError: the extra or the model file is missing.
    """
    from face_prediction.dataset.sequences import SequenceSettings
    from face_prediction.models.loading import SHIPPED, load_predictor
    from face_prediction.models.residual.predictor import ResidualPredictor

    model = find_model(None, option=None)
    try:
        predictor, record = load_predictor(SHIPPED)
    except ImportError as error:
        raise RequestError(
            f"the shipped predictor cannot be loaded ({error}); run: "
            f"{install_command('face-prediction')}"
        ) from None
    assert isinstance(predictor, ResidualPredictor)
    forecaster = FollowingForecaster(predictor, horizon)
    detector, canonical = FaceDetector(model, DetectorSettings()), read_canonical_face(model)
    return MouthTracker(
        lambda: follow_face(detector, canonical),
        StreamingPredictor(forecaster, SequenceSettings.from_json(record.dataset)),
        fov,
        detector.close,
    )
