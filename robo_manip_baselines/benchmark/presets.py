"""How large a benchmark is: everything that is the same for all of its arms."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from robo_manip_baselines.envs.mujoco.tasks.feeding.paper import PAPER
from robo_manip_baselines.runs.errors import RequestError


@dataclass(frozen=True)
class Preset:
    """The size of a benchmark.

    Attributes:
        train_preset: preset of ``bin/Train.py``.
        cameras: that are recorded and shown; none shows the cube's position instead.
        demonstrations: episodes of each expert, seeds from 0.
        demonstration_block: how many of them are one unit of work.
        num_episodes: evaluation episodes of each trained policy, seeds from 1000.
        episode_block: how many of them are one unit of work.
        train_seeds: trainings of each arm, seeds from 0.
        arms: names of the arms of ``feeding``; empty for all of them.
        train_args: further options of ``bin/Train.py``.
        num_envs: evaluation episodes that run at once in a unit.
        device: where networks are trained and act, ``cpu`` or ``cuda``.
        threads: CPU threads of each unit, whatever the number of workers: results would differ by
            rounding with another number.
        gpu_share: of a GPU for each training and evaluation.
        caution: for the reader of the report, empty where none is needed.
        has_videos: whether the report shows a success and a failure of each arm.
        seconds: of a unit of each kind, as measured, so that the time left can be told before
            anything has been done: per demonstration, training, evaluation episode and video.

    Raises:
        RequestError: a value that is not valid.
    """

    train_preset: str
    cameras: tuple[str, ...]
    demonstrations: int
    demonstration_block: int
    num_episodes: int
    episode_block: int
    train_seeds: int = 1
    arms: tuple[str, ...] = ()
    train_args: tuple[str, ...] = ()
    num_envs: int = 8
    device: str = "cpu"
    threads: int = 1
    gpu_share: float = 0.0
    caution: str = ""
    has_videos: bool = True
    seconds: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in ("demonstrations", "num_episodes", "train_seeds"):
            if getattr(self, name) < 1:
                raise RequestError(f"{name} {getattr(self, name)}: must be 1 or more")


PRESETS: dict[str, Preset] = {
    # Two CPU cores, without images.
    "cpu": Preset(
        train_preset="cpu",
        cameras=(),
        demonstrations=50,
        demonstration_block=25,
        num_episodes=100,
        episode_block=50,
        seconds={"demonstration": 2.0, "training": 460.0, "episode": 1.2, "video": 40.0},
    ),
    # The paper's setting (Table III, section IV.C): three cameras, 50 demonstrations, 50 episodes.
    "paper": Preset(
        train_preset="paper",
        cameras=("top", "angle", "front_close"),
        demonstrations=50,
        demonstration_block=4,
        num_episodes=50,
        episode_block=10,
        arms=tuple(PAPER),
        device="cuda",
        threads=2,
        gpu_share=0.125,
        seconds={"demonstration": 10.0, "training": 600.0, "episode": 8.0, "video": 40.0},
    ),
    # Whether all of it works, in three minutes: too small to find anything out.
    "smoke": Preset(
        train_preset="cpu",
        cameras=(),
        demonstrations=5,
        demonstration_block=3,
        num_episodes=4,
        episode_block=4,
        arms=("current", "current_pred_h2", "current_pred_h2_uniform"),
        train_args=("--steps", "200", "--hidden_size", "64", "--feedforward_size", "128"),
        caution="This size only shows that everything works: its policies have hardly learnt "
        "anything. --preset cpu compares arms.",
        seconds={"demonstration": 3.0, "training": 20.0, "episode": 3.0, "video": 20.0},
    ),
}
