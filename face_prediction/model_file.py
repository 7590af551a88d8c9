"""Where MediaPipe's face landmarker model is, and how it gets there."""

from __future__ import annotations

import hashlib
import logging
import os
import tempfile
import urllib.error
import urllib.request
from pathlib import Path

from face_prediction.errors import RequestError
from face_prediction.video import sha256_of

logger = logging.getLogger(__name__)

MODEL_NAME = "face_landmarker.task"
#: MediaPipe's model page, "Face Landmarker", float16, version 1 (Apache-2.0).
MODEL_URL = (
    "https://storage.googleapis.com/mediapipe-models/face_landmarker/face_landmarker/"
    "float16/1/face_landmarker.task"
)
MODEL_SHA256 = "64184e229b263107bc2b804c6625db1341ff2bb731874b0bcc2fe6544e0bc9ff"
TIMEOUT_S = 30.0


def default_model_path() -> Path:
    """``face_landmarker.task`` in ``$XDG_CACHE_HOME/face_prediction`` (or ``~/.cache/…``)."""
    cache = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(cache) / "face_prediction" / MODEL_NAME


def find_model(given: Path | None, url: str = MODEL_URL, expected: str = MODEL_SHA256) -> Path:
    """The model to use: ``given`` if named, else the cached one, downloaded once if absent.

    Raises:
        RequestError: the named file is absent, or the cached one is damaged or absent and cannot
            be downloaded; the message says what to do.
    """
    if given is not None:
        if not given.is_file():
            raise RequestError(f"--model {given}: no such file; download it from {MODEL_URL}")
        return given
    path = default_model_path()
    if not path.is_file():
        _download(url, path, expected)
    elif sha256_of(path) != expected:
        raise RequestError(f"{path}: not the expected file (sha256 differs); delete it, try again")
    return path


def _download(url: str, path: Path, expected: str) -> None:
    try:
        with urllib.request.urlopen(url, timeout=TIMEOUT_S) as response:
            logger.info("downloading %s to %s", url, path)
            data = response.read()
    except (urllib.error.URLError, OSError) as error:
        reason = getattr(error, "reason", error)
        raise RequestError(
            f"no model at {path} and none could be downloaded ({reason}); on a machine with a "
            f"network fetch {url}, then put it there or name it with --model"
        ) from None
    found = hashlib.sha256(data).hexdigest()
    if found != expected:
        raise RequestError(f"{url}: sha256 {found}, expected {expected}; nothing was kept")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent, suffix=".tmp")
        with os.fdopen(handle, "wb") as stream:
            stream.write(data)
        Path(name).replace(path)
    except OSError as error:
        raise RequestError(
            f"{path}: cannot be written ({error.strerror}); name a model with --model"
        ) from None
