"""``bin/Rollout.py --policy``: what it does and says."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from tqdm import tqdm

from robo_manip_baselines.commands.rollout import RolloutOptions
from robo_manip_baselines.policy.checkpoint import load_model
from robo_manip_baselines.rollout.evaluation import Evaluation, plan, stamp
from robo_manip_baselines.rollout.results import (
    EpisodeResult,
    ResultsFile,
    summarise,
    table,
    write_summary,
)
from robo_manip_baselines.rollout.rollout import Recording, rollout
from robo_manip_baselines.rollout.videos import (
    pick_for_video,
    video_name,
    write_video,
)
from robo_manip_baselines.rollout.workers import open_environments

if TYPE_CHECKING:
    from robo_manip_baselines.policy.execution import PolicyRunner


logger = logging.getLogger(__name__)

VIDEOS = "videos"

OnEpisode = Callable[[EpisodeResult, Recording], None]


def evaluate(options: RolloutOptions) -> None:
    """Evaluate the policy that the options name, then print a table and write videos.

    Episodes that the folder holds already are not done again.

    Raises:
        RequestError: the request cannot be met.
    """
    evaluation = plan(options)
    logger.info("%s", evaluation)
    if known := evaluation.seen_seeds():
        logger.warning(
            "%d of the seeds are also seeds of the demonstrations (the first is %d); how well the "
            "policy does there says little: choose another --seed",
            len(known),
            known[0],
        )
    seeds, number = evaluation.seeds, options.evaluation.video
    recordings: dict[int, Recording] = {}
    with ResultsFile(evaluation.out, evaluation.settings(), evaluation.facts()) as file:
        todo = [seed for seed in seeds if seed not in file.done]
        if len(todo) < len(seeds):
            logger.info("%d of %d episodes are there already", len(seeds) - len(todo), len(seeds))

        def on_episode(result: EpisodeResult, recording: Recording) -> None:
            file.append(result)
            recordings[result.seed] = recording
            # Of each outcome, only the first few can be picked for a video.
            there = [r for r in file.done.values() if r.is_success == result.is_success]
            for late in sorted(r.seed for r in there)[number:]:
                recordings.pop(late, None)

        begin = time.perf_counter()
        run(evaluation, todo, on_episode)
        seconds = time.perf_counter() - begin
        results = file.of(seeds)
    summary = summarise(results, new=len(todo), seconds=seconds)
    write_summary(evaluation.out, summary, evaluation.facts())
    written = _write_videos(evaluation, results, recordings, number)
    rows = {"written to": str(evaluation.out), "videos": ", ".join(written) or "-"}
    print(table(summary, rows))  # noqa: T201


def run(evaluation: Evaluation, seeds: Sequence[int], on_episode: OnEpisode) -> None:
    """Let the policy act through these seeds, with a progress bar."""
    if not seeds:
        return
    num_envs = min(evaluation.num_envs, len(seeds))
    policy = make_policy(evaluation, num_envs)
    successes = 0
    with (
        one_thread_if_small(evaluation),
        open_environments(evaluation.task, num_envs, evaluation.workers) as environments,
        tqdm(total=len(seeds), unit="episode", desc=evaluation.checkpoint.policy) as progress,
    ):

        def finished(result: EpisodeResult, recording: Recording) -> None:
            nonlocal successes
            successes += result.is_success
            on_episode(stamp(result, evaluation), recording)
            progress.set_postfix_str(f"{successes} succeeded", refresh=False)
            progress.update()

        rollout(policy, environments, seeds, on_episode=finished)


def make_policy(evaluation: Evaluation, slots: int) -> PolicyRunner:
    """Load the network and make it act in so many slots."""
    from robo_manip_baselines.policy.execution import PolicyRunner

    checkpoint, device = evaluation.checkpoint, evaluation.device
    return PolicyRunner(
        load_model(checkpoint, device),
        checkpoint.spec,
        checkpoint.normalization,
        evaluation.execution,
        num_envs=slots,
        device=device,
        precision=evaluation.precision,
    )


@contextmanager
def one_thread_if_small(evaluation: Evaluation) -> Iterator[None]:
    """Let PyTorch use one thread for a network without images on a CPU.

    More of them would wait for one another on products this small, beside busy worker processes,
    and cost several times what they save. One also rounds the same whatever the number of cores.
    """
    import torch

    before = torch.get_num_threads()
    if evaluation.device.type == "cpu" and not evaluation.checkpoint.spec.cameras:
        torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _write_videos(
    evaluation: Evaluation,
    results: Sequence[EpisodeResult],
    recordings: dict[int, Recording],
    number: int,
) -> list[str]:
    """Write the videos that are not there yet; return the names of all."""
    picked = pick_for_video(results, number)
    folder = evaluation.out / VIDEOS
    todo = [result for result in picked if not (folder / video_name(result)).exists()]
    # Episodes of an earlier run, which was stopped before its videos, are played once more.
    missing = [result.seed for result in todo if result.seed not in recordings]
    run(evaluation, missing, lambda result, recording: recordings.update({result.seed: recording}))
    for result in todo:
        path = folder / video_name(result)
        write_video(path, evaluation.task, result, recordings[result.seed])
    return [str(Path(VIDEOS) / video_name(result)) for result in picked]
