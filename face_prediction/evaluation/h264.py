"""H.264 files that browsers play."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path

import numpy as np

from face_prediction.whole_file import whole_file


def write_h264(path: Path, images: Iterable[np.ndarray], fps: float, crf: int = 20) -> None:
    """Write ``images`` (H, W, 3) uint8 RGB, all of one even height and width, to ``path``.

    The same images give the same bytes. ``crf`` is libx264's quality, 0 (lossless) to 51.

    Raises:
        RequestError: the folder cannot be written to.
        ValueError: there is no image.
    """
    import av  # not needed to make tables

    with (
        whole_file(path) as temporary,
        # the index goes to the front, so that a browser starts to play before all has arrived
        av.open(str(temporary), "w", format="mp4", options={"movflags": "+faststart"}) as container,
    ):
        stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001))
        stream.pix_fmt = "yuv420p"
        stream.options = {"crf": str(crf), "preset": "medium"}
        stream.codec_context.thread_count = 1  # the same bytes whatever the number of cores
        count = 0
        for image in images:
            if not count:
                stream.height, stream.width = image.shape[:2]
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
            container.mux(stream.encode(frame))
            count += 1
        if not count:
            raise ValueError(f"no image for '{path}'")
        container.mux(stream.encode(None))
