"""The same sequence, turned left to right, moved, or in other light: all its frames alike.

What is drawn is one truth value and four numbers for each sequence, so that nothing about the
future is in them. Legend: B batch, N frames, L = 468 landmarks, S side of the pictures.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from face_prediction.models.interface import Future, History
from face_prediction.tracks import NUM_LANDMARKS
from face_prediction.training.windows import Batch

#: Landmarks on the line that halves a face.
MIDLINE = (
    *(0, 1, 2, 4, 5, 6, *range(8, 20)),
    *(94, 151, 152, 164, 168, 175, 195, 197, 199, 200),
)
#: From here on landmarks are on the subject's left, in the order of those on the right.
_FIRST_LEFT = 248

#: Brightness is multiplied by up to 1 more or less this, and that much of it is added (ours).
GAIN, LIGHT = 0.2, 0.1
#: A face is moved by up to this, in crops: the room that `build-dataset` leaves around it (ours).
MOVE = 0.08


def mirror_indices() -> np.ndarray:
    """(L,) int: the landmark that each becomes when a face is turned left to right.

    Measured on MediaPipe's canonical face, which is its own mirror image to the last digit.
    """
    right = [i for i in range(_FIRST_LEFT) if i not in MIDLINE]
    left = range(_FIRST_LEFT, NUM_LANDMARKS)
    mirror = np.arange(NUM_LANDMARKS)
    mirror[right], mirror[left] = left, right
    return mirror


_MIRROR = torch.from_numpy(mirror_indices())


def augment(batch: Batch, rng: np.random.Generator) -> Batch:
    """Turn about half of the sequences; move each and change its light."""
    rows, size = len(batch.history.landmarks), batch.history.pictures.shape[2]
    is_turned = torch.from_numpy(rng.random(rows) < 0.5)
    pixels = torch.from_numpy(np.rint(rng.uniform(-MOVE, MOVE, (rows, 2)) * size).astype(np.int64))
    gain = torch.from_numpy(rng.uniform(1 - GAIN, 1 + GAIN, rows).astype(np.float32))
    light = torch.from_numpy(rng.uniform(-LIGHT, LIGHT, rows).astype(np.float32))

    def landmarks(values: Tensor) -> Tensor:
        step = (pixels / size).to(values)[:, None, None]
        return mirrored_landmarks(values, is_turned) + step

    def pictures(values: Tensor) -> Tensor:
        return moved_pictures(relit(mirrored_pictures(values, is_turned), gain, light), pixels)

    return Batch(
        History(landmarks(batch.history.landmarks), pictures(batch.history.pictures)),
        Future(landmarks(batch.future.landmarks), pictures(batch.future.pictures)),
    )


def mirrored_landmarks(landmarks: Tensor, is_turned: Tensor) -> Tensor:
    """Landmarks (B, N, L, 2), the rows of ``is_turned`` (B,) in the mirror: u becomes 1 - u."""
    turned = landmarks[:, :, _MIRROR.to(landmarks.device)]
    turned = torch.stack([1 - turned[..., 0], turned[..., 1]], dim=-1)
    return torch.where(is_turned.to(landmarks.device)[:, None, None, None], turned, landmarks)


def mirrored_pictures(pictures: Tensor, is_turned: Tensor) -> Tensor:
    """Pictures (B, N, S, S, 3), the rows of ``is_turned`` (B,) in the mirror."""
    result = pictures.clone()
    rows = is_turned.nonzero()[:, 0].to(pictures.device)
    result[rows] = pictures[rows].flip(3)
    return result


def moved_pictures(pictures: Tensor, pixels: Tensor) -> Tensor:
    """Pictures (B, N, S, S, 3), each row moved by ``pixels`` (B, 2) to the right and down.

    Black comes in, as where a crop reaches beyond the video's picture.
    """
    size = pictures.shape[2]
    result = torch.zeros_like(pictures)
    for row, (x, y) in enumerate(pixels.tolist()):
        to_y, to_x = (slice(max(d, 0), size + min(d, 0)) for d in (y, x))
        from_y, from_x = (slice(max(-d, 0), size + min(-d, 0)) for d in (y, x))
        result[row, :, to_y, to_x] = pictures[row, :, from_y, from_x]
    return result


def relit(pictures: Tensor, gain: Tensor, light: Tensor) -> Tensor:
    """Pictures (B, N, S, S, 3) uint8 in other light: ``gain`` (B,) x + ``light`` (B,) of 255."""
    at = (slice(None), None, None, None, None)
    gain, light = gain.to(pictures.device)[at], light.to(pictures.device)[at]
    return (pictures * gain).add_(255 * light).round_().clamp_(0, 255).to(torch.uint8)
