"""Faces and cameras: tracks of faces in video, and the recorded motion lifted from them.

This package knows no robot. It meets ``robo_manip_baselines`` in files only, and importing it
needs neither MediaPipe, nor OpenGL, nor a display, nor a GPU.
"""

from __future__ import annotations

from face_prediction.tracking.tracks import FaceTrack, load_track, save_track
from robo_manip_baselines.runs.errors import RequestError

__all__ = ["FaceTrack", "RequestError", "load_track", "save_track"]
