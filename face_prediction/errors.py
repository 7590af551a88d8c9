"""The errors of this package that are the caller's to mend."""

from __future__ import annotations


class RequestError(ValueError):
    """The request was wrong: one line that names what was given and what to do; exit code 2."""


class NoFaceError(RequestError):
    """A video was read to its end and held no face that the detector could find."""
