"""Episode files: one HDF5 file an episode, see ``docs/episode_format.md``."""

from robo_manip_baselines.data.episode import (
    EpisodeFileError,
    EpisodeReader,
    read_metadata,
)
from robo_manip_baselines.data.episode_writer import write_episode
from robo_manip_baselines.data.files import (
    atomic_file,
    episode_path,
    finished_seeds,
    list_episodes,
    prepare_folder,
    remove_temporaries,
)
from robo_manip_baselines.data.images import decode_image, encode_image

__all__ = [
    "EpisodeFileError",
    "EpisodeReader",
    "atomic_file",
    "decode_image",
    "encode_image",
    "episode_path",
    "finished_seeds",
    "list_episodes",
    "prepare_folder",
    "read_metadata",
    "remove_temporaries",
    "write_episode",
]
