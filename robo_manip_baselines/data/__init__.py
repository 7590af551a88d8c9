"""Episode files: one HDF5 file an episode, see ``docs/episode_format.md``."""

from robo_manip_baselines.data.episode import (
    EpisodeFileError,
    EpisodeReader,
    read_metadata,
    write_episode,
)
from robo_manip_baselines.data.files import (
    episode_path,
    finished_seeds,
    list_episodes,
    remove_partial_episodes,
)

__all__ = [
    "EpisodeFileError",
    "EpisodeReader",
    "episode_path",
    "finished_seeds",
    "list_episodes",
    "read_metadata",
    "remove_partial_episodes",
    "write_episode",
]
