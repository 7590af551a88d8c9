"""The progress bar of a video that is read frame by frame."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from tqdm import tqdm

from face_prediction.video import VideoFrame


@dataclass(frozen=True)
class FrameBar:
    """Shows how far a video has been read, while its frames are passed on.

    Attributes:
        prefix: stands before the name of the video.
        shown: whether there is a bar at all.
    """

    prefix: str
    shown: bool

    def __call__(
        self, frames: Iterable[VideoFrame], total: int | None, name: str
    ) -> Iterable[VideoFrame]:
        """Pass on the frames of the video called ``name``; ``total`` is None where not known."""
        return tqdm(
            frames,
            total=total,
            desc=self.prefix + name,
            unit="frame",
            leave=False,
            disable=not self.shown,
        )
