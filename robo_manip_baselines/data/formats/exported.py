"""Export of demonstrations to formats with a file or folder for each episode."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py

from robo_manip_baselines.data.episode import EpisodeReader
from robo_manip_baselines.data.files import list_episodes
from robo_manip_baselines.data.formats.imported import require_sources
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import locked, remove_temporaries
from robo_manip_baselines.runs.hdf5 import READ_ERRORS, one_line, open_hdf5
from robo_manip_baselines.runs.progress import ProgressBar

OwnAttributes = Callable[[h5py.File, Path], dict[str, Any] | None]
"""Reads the attributes of the episode that a file was exported from; None if it was not."""


def export_episodes(
    folder: Path,
    out: Path,
    *,
    target: Callable[[int, Path], str],
    write: Callable[[EpisodeReader, Path], None],
    own: OwnAttributes,
    main: str = "",
) -> dict[str, str]:
    """Write each demonstration of a folder that has not been written.

    Args:
        folder: as ``bin/Rollout.py`` writes it; ``failed/`` is left out.
        out: folder for them; a run that was killed is continued.
        target: number and path of an episode -> name of what it becomes in ``out``.
        write: writes an episode, whole or not at all.
        own: see `OwnAttributes`.
        main: path of the HDF5 file within a target that is a folder.

    Returns:
        Rows of the closing table.

    Raises:
        RequestError: there is no episode, or ``out`` holds others.
        EpisodeFileError: an episode is damaged.
        WriteError: the disk is full, or fails.
    """
    paths = list_episodes(folder)
    require_sources(folder, paths, "episode_*.hdf5 file")
    with locked(out, is_kept=False):
        remove_temporaries(out)
        new = 0
        with ProgressBar(len(paths), "episode", "export") as bar:
            for number, path in enumerate(paths):
                place = out / target(number, path)
                with EpisodeReader(path) as episode:
                    if place.exists():
                        _require_same(place, main, episode, own)
                    else:
                        write(episode, place)
                        new += 1
                bar.advance()
    return {"written to": str(out), "episodes": f"{len(paths)}, of which {new} new"}


def _require_same(place: Path, main: str, episode: EpisodeReader, own: OwnAttributes) -> None:
    """Require that a target was made from an episode."""
    try:
        with open_hdf5(place / main if main else place) as file:
            made_of = own(file, place)
    except READ_ERRORS as error:
        raise RequestError(f"'{place}': {one_line(error)}; it is in the way") from error
    wanted = episode.attributes["content_sha256"]
    if not made_of or made_of.get("content_sha256") != wanted:
        raise RequestError(
            f"'{place}' was not exported from '{episode.path}'; choose another folder"
        )
