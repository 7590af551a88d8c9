"""Episode files: one HDF5 file an episode, see ``docs/episode_format.md``."""

from robo_manip_baselines.data.episode import (
    EpisodeFileError,
    EpisodeReader,
    decode_image,
    encode_image,
    read_metadata,
    write_episode,
)
from robo_manip_baselines.data.files import (
    atomic_file,
    episode_path,
    finished_seeds,
    list_episodes,
    prepare_folder,
    remove_temporaries,
)

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
