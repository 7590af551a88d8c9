"""Recognition of videos that commands of this project have written: no others are replaced."""

from __future__ import annotations

from pathlib import Path

from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import FileKind

METADATA = {"comment": "made by robo_manip_baselines"}
"""Metadata of every video that is written."""


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
