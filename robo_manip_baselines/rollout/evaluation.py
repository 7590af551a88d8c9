"""Evaluation of a trained policy: configuration, checks, episodes, results and videos."""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from annotated_types import Interval

from robo_manip_baselines.envs.mujoco.cell.opengl import opengl_problem
from robo_manip_baselines.envs.mujoco.cell.scene import CONTROL_PERIOD
from robo_manip_baselines.envs.mujoco.face.motion import MotionLibrary, pin_library
from robo_manip_baselines.envs.mujoco.face.motions import parse_motion
from robo_manip_baselines.envs.mujoco.tasks.face_env import world_of
from robo_manip_baselines.envs.mujoco.tasks.registry import task_entry, without_library_path
from robo_manip_baselines.observation import Corruption, ObservationSpec
from robo_manip_baselines.observation.spec import MEASURED, CameraLatency
from robo_manip_baselines.policy.checkpoint import (
    SHIPPED_PREFIX,
    Checkpoint,
    load_model,
    read_checkpoint,
    without_initial_weights,
)
from robo_manip_baselines.policy.presets import (
    STRATEGIES,
    ActionExecution,
    Chunk,
    InferenceDelay,
)
from robo_manip_baselines.rollout.agreement import require_continuation
from robo_manip_baselines.rollout.results import (
    SUMMARY,
    EpisodeResult,
    EvaluationSummary,
    open_results,
    recorded_settings,
    require_evaluation_folder,
    require_seeds,
    summarize,
)
from robo_manip_baselines.rollout.rollout import Recording, rollout
from robo_manip_baselines.rollout.videos import pick_for_video, video_name, write_video
from robo_manip_baselines.rollout.workers import EnvConfig, open_envs
from robo_manip_baselines.runs.checkpoints import CHECKPOINTS
from robo_manip_baselines.runs.documents import as_json
from robo_manip_baselines.runs.errors import RequestError, require_choice
from robo_manip_baselines.runs.files import locked, remove_temporaries, write_json
from robo_manip_baselines.runs.progress import EpisodeProgress
from robo_manip_baselines.runs.ranges import NonNegativeInt, Processes, require_ranges
from robo_manip_baselines.runs.versions import software_versions
from robo_manip_baselines.training.requirements import prepare_pytorch

if TYPE_CHECKING:
    import torch

    from robo_manip_baselines.policy.execution import PolicyRunner
    from robo_manip_baselines.policy.interface import PolicyModel

logger = logging.getLogger(__name__)

FIRST_SEED = 1000
"""Default first seed of an evaluation, far from those of demonstrations, which start at 0."""

VIDEOS = "videos"

SOFTWARE = ("mujoco", "numpy", "robo_manip_baselines", "torch")
"""Software whose versions result rows hold."""

DETECTOR = ("mediapipe",)
"""Likewise, where the mouth is found in images."""

OnEpisode = Callable[[EpisodeResult, Recording], None]


@dataclass(frozen=True)
class EvaluationConfig:
    """Evaluation of a checkpoint.

    Attributes:
        checkpoint: folder of a training run, or of one of its checkpoints, or ``shipped:NAME``.
        seeds: of the episodes, one each.
        out: folder of the results; ``results/<task>_<run>`` if None.
        env_kwargs: arguments of the environment that differ from those of the demonstrations; held
            as JSON holds them. ``people`` is ``test`` after demonstrations of ``train`` people.
        corruption: of the observations, where it is not the one of the training; None otherwise.
        mouth_source: of the observations, see `ObservationSpec`; a camera takes the place of every
            corruption.
        camera_latency: of that camera.
        temporal_ensemble: average the predictions of all chunks, whatever the checkpoint says.
        n_action_steps: actions of a chunk to execute before the next one, where it is not the
            number of the checkpoint; None otherwise.
        strategy: one of ``STRATEGIES`` to execute chunks with; that of the checkpoint if None.
        inference_delay: control steps between an observation and the first action that is made
            from it; or ``measured``: as many as a prediction takes on this machine.
        num_envs: episodes that run at once; results do not depend on it.
        workers: processes in which environments step; 0 steps them in this one.
        device: of the network: auto, cpu, cuda or cuda:NUMBER.
        precision: of the network: fp32, or bf16 for the products inside it.
        videos: number of videos, half of them of successes.
        is_watched: show the episodes in MuJoCo's viewer, one after another, in real time.

    Raises:
        RequestError: a value is not valid.
    """

    checkpoint: Path
    seeds: range
    out: Path | None = None
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    corruption: Corruption | None = None
    mouth_source: str = "truth"
    camera_latency: CameraLatency = 1
    temporal_ensemble: bool = False
    n_action_steps: Chunk | None = None
    strategy: str | None = None
    inference_delay: InferenceDelay = 0
    num_envs: Annotated[int, Interval(ge=1, le=4096)] = 8
    workers: Processes = 2
    device: str = "auto"
    precision: str = "fp32"
    videos: NonNegativeInt = 0
    is_watched: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "env_kwargs", as_json(self.env_kwargs))
        require_seeds(self.seeds)
        require_ranges(self)
        if self.strategy is not None:
            require_choice("strategy", self.strategy, STRATEGIES)
        if self.temporal_ensemble and self.n_action_steps is not None:
            raise RequestError("--temporal_ensemble and --n_action_steps: give one of them")
        if self.strategy == "ensemble" and self.n_action_steps is not None:
            raise RequestError("--strategy ensemble and --n_action_steps: give one of them")
        if self.temporal_ensemble and self.strategy not in (None, "ensemble"):
            raise RequestError(
                f"--temporal_ensemble and --strategy {self.strategy}: give one of them"
            )

    def to_json(self) -> dict[str, Any]:
        """Return what JSON can hold, without ``is_watched``, on which no result depends."""
        values = {
            **asdict(self),
            "checkpoint": str(self.checkpoint),
            "seeds": [self.seeds.start, self.seeds.stop],
            "out": None if self.out is None else str(self.out),
        }
        del values["is_watched"]
        return values

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> EvaluationConfig:
        """Return the configuration that ``to_json`` was called on.

        Raises:
            RequestError: a value is not valid.
        """
        given = {**values, "seeds": range(*values["seeds"])}
        readers: Any = {"checkpoint": Path, "out": Path, "corruption": Corruption.from_json}
        for name, read in readers.items():
            if values.get(name) is not None:
                given[name] = read(values[name])
        return cls(**given)


def evaluated_people(recorded: Mapping[str, Any]) -> str:
    """Return whose motion an evaluation draws where nothing else is given: people not trained on.

    ``recorded`` are the arguments of the demonstrations' environment.
    """
    people = recorded.get("people", "all")
    return "test" if people == "train" else people


@dataclass(frozen=True)
class EvaluationPlan:
    """An `EvaluationConfig` with its checkpoint read and everything checked.

    Attributes:
        config: the configuration.
        checkpoint: of the policy.
        env: environment in which the policy acts.
        xml_hash: of the environment's model.
        execution: of the policy's chunks of actions.
        device: of the network.
    """

    config: EvaluationConfig
    checkpoint: Checkpoint
    env: EnvConfig
    xml_hash: str
    execution: ActionExecution
    device: torch.device

    @classmethod
    def of(cls, config: EvaluationConfig) -> EvaluationPlan:
        """Read the checkpoint and check that it, the environment and the machine fit.

        Raises:
            RequestError: something does not exist, or does not fit.
        """
        checkpoint = read_checkpoint(config.checkpoint)
        prepare_pytorch()
        # Imported here: a request that is wrong so far is refused without waiting for PyTorch.
        from robo_manip_baselines.policy.execution import INFERENCE_PRECISIONS
        from robo_manip_baselines.training.device import choose_device

        require_choice("precision", config.precision, INFERENCE_PRECISIONS)
        spec = checkpoint.spec
        if config.corruption is not None:
            spec = replace(spec, corruption=config.corruption.pinned())
        if config.mouth_source != "truth":
            perception = {"mouth_source": config.mouth_source, "corruption": Corruption()}
            spec = replace(spec, **perception, camera_latency=config.camera_latency)
            if not spec.frames:
                raise RequestError(
                    f"mouth_source {spec.mouth_source}: the policy was trained with the preset "
                    f"'{spec.obs}', which shows no mouth; leave it out"
                )
        recorded = checkpoint.dataset.get("env_kwargs", {})
        if "motion_library" in config.env_kwargs:  # another file, of other content perhaps
            recorded = {k: v for k, v in recorded.items() if k != "motion_sha256"}
        if "motion" in config.env_kwargs and not parse_motion(config.env_kwargs["motion"]).recorded:
            recorded = {name: value for name, value in recorded.items() if name != "clips"}
        if (people := evaluated_people(recorded)) != recorded.get("people", people):
            # its clips are of people whom it has seen
            recorded = {k: v for k, v in recorded.items() if k != "clips"} | {"people": people}
        env_kwargs = pin_library({**recorded, **config.env_kwargs})
        env = EnvConfig(checkpoint.env, spec, env_kwargs)
        xml_hash = _require_fit(checkpoint, env)
        if needs_opengl(spec, config.videos) and (problem := opengl_problem()):
            why = "the policy sees images" if spec.cameras else "--video 0 needs no OpenGL"
            if spec.sees_by_camera:
                why = "the mouth is found in images"
            raise RequestError(f"{problem} ({why})")
        execution = choose_execution(checkpoint.execution, config)
        plan = cls(config, checkpoint, env, xml_hash, execution, choose_device(config.device))
        return plan._measured() if config.inference_delay == MEASURED else plan

    def _measured(self) -> EvaluationPlan:
        """Return the plan with the delay of its results so far, or as a prediction takes.

        The delay is the number of whole control steps in that time: a prediction that takes less
        than one is there before the next observation.
        """
        if (there := recorded_settings(self.out)) is not None:
            delay = ActionExecution.from_json(there.get("acting", {})).inference_delay
        else:
            with self._one_thread_if_small():
                seconds = self.make_policy(1).prediction_time()
            delay = int(seconds / CONTROL_PERIOD)
            logger.info("a prediction takes %.1f ms: %d control steps", 1e3 * seconds, delay)
        return replace(self, execution=replace(self.execution, inference_delay=delay))

    def __str__(self) -> str:
        execution, checkpoint, seeds = self.execution, self.checkpoint, self.config.seeds
        how = f"{execution.n_action_steps} actions of each chunk"
        if execution.temporal_ensemble:
            how = f"temporal ensemble (decay {execution.ensemble_decay:g})"
        if execution.inference_delay or execution.name not in ("ensemble", "synchronous"):
            how += f", {execution.name} with a delay of {execution.inference_delay} steps"
        return (
            f"{checkpoint.policy}, {self.condition}, step {checkpoint.step}, on "
            f"{self.device} in {self.config.precision}: {how}; seeds {seeds[0]} to {seeds[-1]}"
        )

    @property
    def corruption_suffix(self) -> str:
        """Name of a corruption that is not the one of the training: ``_under_delay3``."""
        corruption = self.env.spec.corruption
        if self.env.spec.sees_by_camera:
            latency = self.env.spec.camera_latency
            is_usual = latency == EvaluationConfig.camera_latency
            return f"_under_{self.env.spec.mouth_source}" + ("" if is_usual else f"_{latency}")
        if corruption.is_same_as(self.checkpoint.spec.corruption):
            return ""
        return f"_under_{corruption.label or 'truth'}"

    @property
    def condition(self) -> str:
        """Name of the experimental condition, such as ``current_pred_h2_under_delay3``."""
        return self.checkpoint.spec.name + self.corruption_suffix

    @property
    def out(self) -> Path:
        """Folder of the results."""
        name = f"{self.env.env}_{run_name(self.config.checkpoint)}{self.corruption_suffix}"
        return self.config.out or Path("results") / name

    @property
    def settings(self) -> dict[str, Any]:
        """Settings that the results of one folder have in common."""
        acting = self.execution.to_json()  # only what makes a difference
        del acting["execute" if self.execution.temporal_ensemble else "decay"]
        return {
            "env": self.env.task.env_id,
            "env_kwargs": without_library_path(self.env.env_kwargs),
            "observation": self.env.spec.to_json(),
            "xml_hash": self.xml_hash,
            "policy": self.checkpoint.policy,
            "checkpoint": self.checkpoint.content_hash,
            "acting": acting,
            "device": self.device.type,
            "precision": self.config.precision,
        }

    @cached_property
    def origin(self) -> dict[str, Any]:
        """Fields of a result row that all results of the evaluation share, ready for JSON."""
        checkpoint, spec, kwargs = self.checkpoint, self.env.spec, dict(self.env.env_kwargs)
        # A library is what it holds, wherever it lies.
        library = MotionLibrary.load(kwargs.pop("motion_library", None))
        for name in ("motion_sha256", "motion"):
            kwargs.pop(name, None)  # the other one is in every row
        shows_prediction = spec.corruption.error == "model"
        training = {
            "network": asdict(without_initial_weights(checkpoint.config)),
            "settings": _set(asdict(checkpoint.settings)),
            "step": checkpoint.step,
            "demonstrations": checkpoint.dataset.get("content_hash"),
        }
        settings = {
            "env_kwargs": kwargs,
            "motion_sha256": library.motion_sha256,
            "prediction_sha256": library.prediction_sha256 if shows_prediction else None,
            "xml_hash": self.xml_hash,
            "execution": self.settings["acting"],
            "precision": self.config.precision,
            "device": self.device.type,
            "training": hashlib.sha256(json.dumps(training, default=str).encode()).hexdigest(),
        }
        origin = {
            "env": self.env.env,
            "policy": checkpoint.policy,
            "condition": self.condition,
            "observation": spec.to_json(),
            "train_seed": checkpoint.train_seed,
            "checkpoint": checkpoint.content_hash,
            "versions": software_versions(*SOFTWARE, *(DETECTOR if spec.sees_by_camera else ())),
            "settings": settings,
        }
        return as_json(origin)

    @property
    def facts(self) -> dict[str, Any]:
        """Further facts that are recorded beside results."""
        return {
            "condition": self.condition,
            "checkpoint_folder": str(self.checkpoint.folder),
            "checkpoint_step": self.checkpoint.step,
            "train_seed": self.checkpoint.train_seed,
            "first_seed": self.config.seeds[0],
            "motion_library": self.env.env_kwargs.get("motion_library"),
        }

    @cached_property
    def model(self) -> PolicyModel:
        """The network, on its device.

        Raises:
            RequestError: its weights do not fit it.
        """
        return load_model(self.checkpoint, self.device)

    def make_policy(self, num_envs: int) -> PolicyRunner:
        """Make the network act in so many environments.

        Raises:
            RequestError: it cannot, as with more action steps than a chunk has.
        """
        from robo_manip_baselines.policy.execution import PolicyRunner

        checkpoint, precision = self.checkpoint, self.config.precision
        facts = checkpoint.spec, checkpoint.normalization, self.execution
        return PolicyRunner(
            *(self.model, *facts),
            encoding=checkpoint.encoding,
            skip=checkpoint.settings.skip,
            num_envs=num_envs,
            device=self.device,
            precision=precision,
        )

    def run(self, seeds: Sequence[int], on_episode: OnEpisode) -> None:
        """Let the policy act through these seeds, with a progress bar."""
        if not seeds:
            return
        checkpoint, successes = self.checkpoint, 0
        num_envs, longest = min(self.config.num_envs, len(seeds)), self.env.task.max_episode_steps
        workers, env = self.config.workers, self.env
        if self.config.is_watched:  # results do not depend on the mode, and do not record it
            num_envs, workers = 1, 0
            env = replace(env, env_kwargs={**env.env_kwargs, "render_mode": "human"})
        with (
            self._one_thread_if_small(),
            open_envs(env, num_envs, workers) as envs,
            EpisodeProgress(len(seeds), longest, checkpoint.policy) as progress,
        ):

            def finished(result: EpisodeResult, recording: Recording) -> None:
                nonlocal successes
                successes += result.is_success
                on_episode(replace(result, **self.origin), recording)
                progress.note = f"{successes} succeeded"
                progress.end(result.steps)

            policy = self.make_policy(num_envs)
            rollout(policy, envs, seeds, on_episode=finished, on_steps=progress.step)

    @contextlib.contextmanager
    def _one_thread_if_small(self) -> Iterator[None]:
        """Let PyTorch use one thread for a network without images on a CPU.

        More of them would wait for one another on products this small, beside busy worker
        processes, and cost several times what they save. One also rounds the same whatever the
        number of cores.
        """
        import torch

        before = torch.get_num_threads()
        if self.device.type == "cpu" and not self.checkpoint.spec.cameras:
            torch.set_num_threads(1)
        try:
            yield
        finally:
            torch.set_num_threads(before)


def needs_opengl(spec: ObservationSpec, videos: int) -> bool:
    """Return whether anything is drawn: for the policy, for the detector, or for videos."""
    return bool(spec.cameras or spec.sees_by_camera or videos)


def evaluate(config: EvaluationConfig) -> tuple[EvaluationPlan, EvaluationSummary, list[Path]]:
    """Evaluate a checkpoint: run the episodes that its folder lacks, write summary and videos.

    Returns:
        The plan that was carried out, the summary, and the files of all videos.

    Raises:
        RequestError: the folder holds other results, or the request cannot be met.
    """
    # Everything about the request that can be wrong is found out before any file exists.
    plan = EvaluationPlan.of(config)
    plan.make_policy(1)
    require_evaluation_folder(plan.out, plan.settings)
    logger.info("%s", plan)
    with locked(plan.out, is_kept=False):
        return plan, *_evaluate(plan)


def _evaluate(plan: EvaluationPlan) -> tuple[EvaluationSummary, list[Path]]:
    """Run the episodes that the folder of a plan lacks, write summary and videos."""
    remove_temporaries(plan.out, plan.out / VIDEOS)
    config = plan.config
    seeds, number, split = config.seeds, config.videos, plan.checkpoint.split
    if known := sorted(set(seeds) & {*split.train, *split.validation}):
        logger.warning(
            "%d of the seeds are also seeds of the demonstrations (the first is %d); results on "
            "them do not show how well the policy generalizes: choose another --seed",
            len(known),
            known[0],
        )
    recordings: dict[int, Recording] = {}
    with open_results(plan.out, plan.settings, plan.facts) as file:
        # Settings may be the same and other things not: the release, or rows from elsewhere.
        require_continuation(plan.out, file.done.values(), plan.origin)
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
        plan.run(todo, on_episode)
        seconds = time.perf_counter() - begin
        results = file.of(seeds)
        everything = file.of(sorted(file.done))
    # Of all rows of the folder: a table of results.jsonl has the same numbers.
    summary = summarize(plan.env.task, everything, new=len(todo), seconds=seconds)
    facts = {**plan.facts, "first_seed": everything[0].seed}
    write_json(plan.out / SUMMARY, {**facts, **asdict(summary)})
    if len(everything) > len(results):
        logger.info("the summary is over all %d episodes of %s", len(everything), plan.out)

    videos = {plan.out / VIDEOS / video_name(r): r for r in pick_for_video(results, number)}
    missing = {path: result for path, result in videos.items() if not path.exists()}
    # Episodes of an earlier run, which was stopped before its videos, are run once more.
    again = [result.seed for result in missing.values() if result.seed not in recordings]
    plan.run(again, lambda result, recording: recordings.update({result.seed: recording}))
    for path, result in missing.items():
        write_video(path, plan.env, result, recordings[result.seed])
    return summary, list(videos)


def _set(settings: dict[str, Any]) -> dict[str, Any]:
    """Return training settings as they were before ``norm``, which older checkpoints lack."""
    return {name: value for name, value in settings.items() if (name, value) != ("norm", None)}


def choose_execution(trained: ActionExecution, config: EvaluationConfig) -> ActionExecution:
    """Return the action execution of a checkpoint with the changes that an evaluation asks for.

    Raises:
        RequestError: they do not go together.
    """
    delay = 0 if config.inference_delay == MEASURED else config.inference_delay  # until it is
    changes: dict[str, Any] = {"inference_delay": delay}
    if config.n_action_steps is not None:
        changes |= {"temporal_ensemble": False, "n_action_steps": config.n_action_steps}
    if config.temporal_ensemble or config.strategy == "ensemble":
        changes |= {"temporal_ensemble": True}
    elif config.strategy is not None:
        changes |= {"temporal_ensemble": False, "strategy": config.strategy}
    return replace(trained, **changes)


def run_name(checkpoint: Path) -> str:
    """Name results after the run folder, with the step where one checkpoint of it was named."""
    if (text := str(checkpoint)).startswith(SHIPPED_PREFIX):
        return text.replace(":", "_")
    path = checkpoint.resolve()
    if path.parent.name == CHECKPOINTS:
        return f"{path.parent.parent.name}_{path.name}"
    return path.name


def _require_fit(checkpoint: Checkpoint, config: EnvConfig) -> str:
    """Return the hash of the environment's model, which is the one that the policy was trained for.

    A policy may be evaluated with another kind of face than it was trained with: the environment
    with its own face counts then.

    Raises:
        RequestError: naming what the checkpoint has and what the environment has.
    """
    trained_kwargs = checkpoint.dataset.get("env_kwargs", {})
    for name, (usual, *_) in task_entry(config.env).choices.items():
        trained, asked = (own.get(name, usual) for own in (trained_kwargs, config.env_kwargs))
        if trained != asked:
            raise RequestError(
                f"checkpoint '{checkpoint.folder}' was trained with {name} {trained}, not {asked}; "
                "leave the option as trained, or train another policy"
            )
    face = trained_kwargs.get("face", "visual")
    own = here = _facts_of_model(config)
    if here["face"] != face:
        own = _facts_of_model(config, face=face)
    pairs = {
        "actions": (", ".join(checkpoint.action_names), own["actions"]),
        "control period": (checkpoint.control_period, CONTROL_PERIOD),
        "size of the state": (checkpoint.dims.state, config.vector_size),
        "model hash": (checkpoint.xml_hash[:12], own["xml_hash"][:12]),
    }
    for name, (trained, found) in pairs.items():
        if trained != found:
            raise RequestError(
                f"checkpoint '{checkpoint.folder}' was trained with {name} {trained}; {config.env} "
                f"has {found} here; install the release that trained it, "
                f"{checkpoint.versions.get('robo_manip_baselines', 'unknown')}, or train again"
            )
    return here["xml_hash"]


def _facts_of_model(config: EnvConfig, **changes: Any) -> dict[str, str]:
    """Return kind of face, actions and hash of an environment's model."""
    with contextlib.closing(config.make(**changes)) as env:
        world = world_of(env)
        return {
            "face": world.face_kind,
            "actions": ", ".join(world.action_names),
            "xml_hash": world.xml_hash,
        }
