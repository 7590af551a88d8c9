"""Videos: the file that every command writes, and its recognition: no others are replaced."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any

from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import FileKind, atomic_file

METADATA = {"comment": "made by robo_manip_baselines"}
"""Metadata of every video that is written."""


@contextmanager
def h264_stream(
    path: Path, rate: Fraction, *, crf: int, preset: str, threads: int
) -> Iterator[tuple[Any, Any]]:
    """Yield container and stream (PyAV) of an H.264 file that browsers play.

    The file is there when the block has ended well, and not before; what the encoder holds back is
    written then.

    Args:
        path: file to write, ``….mp4``.
        rate: frames a second.
        crf: quality of libx264, 0 (lossless) to 51.
        preset: of libx264: slower ones make smaller files.
        threads: of the encoder, 0 for one on each core; with 1 the same images give the same bytes
            on every machine.

    Raises:
        RequestError: the folder cannot be written to.
    """
    import av  # slow to import; only videos need it

    # The index goes to the front, so that a browser starts to play before all has arrived.
    options = {"movflags": "+faststart"}
    with (
        atomic_file(path) as temporary,
        av.open(str(temporary), "w", format="mp4", options=options) as container,
    ):
        container.metadata.update(METADATA)
        stream = container.add_stream("libx264", rate=rate)
        stream.pix_fmt = "yuv420p"  # the one that every browser plays: even sizes only
        stream.options = {"crf": str(crf), "preset": preset}
        stream.codec_context.thread_count = threads
        yield container, stream
        container.mux(stream.encode(None))


def require_own_video(path: Path) -> None:
    """Make sure that a file is a video with our `METADATA`.

    Raises:
        RequestError: it is none.
    """
    import av.error  # slow to import; most requests name a new file

    try:
        with av.open(str(path)) as container:
            found = container.metadata
    except (av.error.FFmpegError, OSError, ValueError) as error:
        raise RequestError(f"'{path}' is no video: {error}") from error
    if not METADATA.items() <= found.items():
        raise RequestError(f"'{path}' is a video that another program or an earlier release made")


VIDEO = FileKind("H.264 video", require_own_video, ".mp4")
