"""``bin/Rollout.py``: record demonstrations of a scripted expert, or evaluate a trained policy."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Protocol

import tyro
from annotated_types import Interval

from robo_manip_baselines.envs.mujoco.cell.opengl import opengl_problem, require_viewer
from robo_manip_baselines.envs.mujoco.tasks.registry import task_entry
from robo_manip_baselines.observation import Corruption, ObservationSpec
from robo_manip_baselines.observation.corruption import MEASURED_ERRORS
from robo_manip_baselines.policy.presets import Chunk, InferenceDelay
from robo_manip_baselines.runs.command import last_value, parse
from robo_manip_baselines.runs.errors import RequestError, require_choice
from robo_manip_baselines.runs.files import require_out_file
from robo_manip_baselines.runs.progress import closing_table
from robo_manip_baselines.runs.ranges import Episodes, NonNegativeInt, Processes, Quality, Seed
from robo_manip_baselines.runs.videos import VIDEO

if TYPE_CHECKING:
    from robo_manip_baselines.policy.checkpoint import Checkpoint
    from robo_manip_baselines.rollout.demonstrate import Collection
    from robo_manip_baselines.rollout.evaluation import EvaluationConfig

EXAMPLE = """python bin/Rollout.py FeedingEnv --scripted --num_episodes 50 --workers 2

Example: python bin/Rollout.py FeedingEnv --policy Act --checkpoint runs/act --video 4"""

DESCRIPTION = (
    "Let a scripted expert record demonstrations (--scripted), or evaluate a trained policy "
    "(--policy, --checkpoint)."
)

PERCEPTION = ("mouth_source", "camera_latency")
"""Parts of the observation that may differ between training and evaluation."""

UNTRAINED = ObservationSpec("current_pred")
"""Defaults of the observation where no checkpoint gives them."""

PREVIEW = "preview.mp4"

RECORDED = ("cameras", "image_size", "arms", *PERCEPTION)
"""Parts of the observation that demonstrations hold, or that their expert goes by; they hold the
truth behind the others."""

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class ScriptedOptions:
    """Only with --scripted.

    Attributes:
        expert: Name of the scripted expert; the first one of the task if not given.
        image_codec: jpeg, png or raw.
        image_quality: Quality of jpeg, 1 to 100.
        preview: Number of the first episodes that the preview video shows; 0 for no video.
    """

    expert: str | None = None
    image_codec: str = "jpeg"
    image_quality: Quality = 90
    preview: NonNegativeInt = 2


@dataclass(frozen=True)
class PolicyOptions:
    """Only with --policy.

    Attributes:
        checkpoint: Folder of a training run, or of one of its checkpoints; or shipped:baseline,
            shipped:current, shipped:forecast, which come with the package.
        num_envs: Episodes that run at once; results do not depend on it.
        temporal_ensemble: Average the predictions of all chunks, whatever the checkpoint says.
        n_action_steps: Execute so many actions of a chunk before the next, whatever the checkpoint
            says.
        strategy: Execution of chunks: synchronous, naive, ensemble, rtc, rtc_trained or
            roll_forward; that of the checkpoint if not given.
        inference_delay: Control steps between an observation and the first action that is made
            from it; or measured: as many as a prediction takes on this machine.
        device: Device of the network: auto, cpu, cuda or cuda:1.
        precision: fp32, or bf16 for the products inside the network.
        video: Videos to write: of the first successes and the first failures, half of each.
        change_corruption: Let --error, --delay, --face_dropout, --detector_rate and their settings
            replace those of the training; otherwise they are only checked.
    """

    checkpoint: Path | None = None
    num_envs: Annotated[int, Interval(ge=1, le=4096)] = 8
    temporal_ensemble: bool = False
    n_action_steps: Annotated[Chunk | None, tyro.conf.arg(aliases=["--execute"])] = None
    strategy: str | None = None
    inference_delay: InferenceDelay = 0
    device: str = "auto"
    precision: str = "fp32"
    video: NonNegativeInt = 0
    change_corruption: bool = False


@dataclass(frozen=True)
class RolloutOptions:
    """Options of the command.

    Attributes:
        env: Task, for example FeedingEnv.
        scripted: Let the scripted expert act, and record its episodes.
        policy: Let a trained policy act, for example Act, and record its results.
        num_episodes: Episodes, one for each seed from --seed on.
        seed: Seed of the first episode; if not given, 0 with --scripted and 1000 with --policy.
        out: Folder to write to; if not given, dataset/<env> or results/<env>_<run>.
        face: Kind of face: visual, or physical, soft tissue on a head that yields. If not given,
            visual, or as in the demonstrations of the policy.
        face_motion: Start of the face's motion: with the episode, or after_lift. If not given,
            episode, or as in the demonstrations of the policy.
        motion: Motion of the face: recorded, sway, ..., with parameters sway:amplitude=0.03, or a
            sum recorded+tremor. If not given, recorded, or as in the demonstrations.
        people: People who move: all, or train or test for demonstrations and evaluation with
            different people. If not given, all, and test for a policy that learnt from train.
        clips: Recorded clips to draw from; if not given, all, or those of the demonstrations.
        utensil: What brings the food in FeedingEnv: gripper or spoon. If not given, gripper, or as
            in the demonstrations of the policy.
        motion_library: File of recorded face motion, or extended, which ships, too, and has more
            people. If not given, the one that ships, or that of the demonstrations.
        workers: Processes in which environments step; with --policy, 0 steps them in the main one.
        view: Show the episodes in MuJoCo's viewer, one after another, in real time.
        spec: Observation. With --scripted, cameras and image_size are recorded; with --policy, the
            observation is that of the checkpoint, and options are checked against it.
        corruption: --no_corruption shows the truth, whatever the checkpoint and other options say.
        demonstration: Only with --scripted.
        evaluation: Only with --policy.
    """

    env: tyro.conf.Positional[str]
    scripted: bool = False
    policy: str | None = None
    num_episodes: Episodes = 50
    seed: Seed | None = None
    out: Path | None = None
    face: str | None = None
    face_motion: str | None = None
    motion: str | None = None
    people: str | None = None
    clips: tuple[str, ...] = ()
    utensil: str | None = None
    motion_library: Path | None = None
    workers: Processes = 2
    view: bool = False
    spec: tyro.conf.OmitArgPrefixes[ObservationSpec] = field(default_factory=lambda: UNTRAINED)
    corruption: bool = True
    demonstration: tyro.conf.OmitArgPrefixes[ScriptedOptions] = field(
        default_factory=ScriptedOptions
    )
    evaluation: tyro.conf.OmitArgPrefixes[PolicyOptions] = field(default_factory=PolicyOptions)

    def seeds(self, first: int) -> range:
        """Return the seeds of the episodes; ``first`` where none was given."""
        start = first if self.seed is None else self.seed
        return range(start, start + self.num_episodes)


class EnvOptions(Protocol):
    """Options about the environment: the face, its motion, and what only some tasks have."""

    @property
    def env(self) -> str: ...  # noqa: D102
    @property
    def face(self) -> str | None: ...  # noqa: D102
    @property
    def face_motion(self) -> str | None: ...  # noqa: D102
    @property
    def motion(self) -> str | None: ...  # noqa: D102
    @property
    def people(self) -> str | None: ...  # noqa: D102
    @property
    def clips(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def utensil(self) -> str | None: ...  # noqa: D102
    @property
    def motion_library(self) -> Path | None: ...  # noqa: D102


def env_arguments(options: EnvOptions) -> dict[str, Any]:
    """Return the arguments of the environment that were given: of the face, and of the task alone.

    Raises:
        RequestError: there are no such face, motion or people, or the task has no such argument.
    """
    from robo_manip_baselines.envs.mujoco.face import FACES
    from robo_manip_baselines.envs.mujoco.face.motions import parse_motion
    from robo_manip_baselines.envs.mujoco.face.people import PEOPLE

    given = {
        "face": options.face and require_choice("face", options.face, FACES),
        "face_motion": options.face_motion,
        "motion": None if options.motion is None else str(parse_motion(options.motion)),
        "people": options.people and require_choice("people", options.people, PEOPLE),
        "clips": options.clips,
        "utensil": options.utensil
        and task_entry(options.env).require_argument("utensil", options.utensil),
        "motion_library": options.motion_library and str(options.motion_library),
    }
    return {name: value for name, value in given.items() if value}


def require_consistent(options: RolloutOptions) -> None:
    """Make sure that one of the two uses is chosen, and that all options go with it.

    Raises:
        RequestError: naming what does not fit.
    """
    if options.scripted and options.policy is not None:
        raise RequestError("--scripted and --policy: one of them acts; leave the other out")
    if not options.scripted and options.policy is None:
        raise RequestError(
            "nothing acts; give --scripted to let the scripted expert act, or "
            "--policy Act --checkpoint runs/... to let a trained policy act"
        )
    given = options.evaluation if options.scripted else options.demonstration
    changed = changed_options(given, type(given)())
    if options.scripted:
        changed += [n for n in changed_options(options.spec, UNTRAINED) if n not in RECORDED]
        changed += [] if options.corruption else ["no_corruption"]
    if changed:
        wanted = "--policy" if options.scripted else "--scripted"
        raise RequestError(f"--{changed[0]} goes with {wanted}; leave it out")
    if options.view:
        require_viewer()


def changed_options(given: Any, default: Any) -> list[str]:
    """Return the options, as they are written, in which two dataclasses differ."""
    names: list[str] = []
    for item in fields(given):
        value, before = getattr(given, item.name), getattr(default, item.name)
        if isinstance(value, Corruption):
            parts = changed_options(value, before)
            names += ["corruption_seed" if name == "seed" else name for name in parts]
        elif value != before:
            names.append(f"no_{item.name}" if value is False else item.name)
    return names


# -- demonstrations -------------------------------------------------------------------------------


def to_collection(options: RolloutOptions) -> Collection:
    """Return the collection that the options of --scripted ask for.

    Raises:
        RequestError: a value is not valid.
    """
    from robo_manip_baselines.rollout.demonstrate import Collection

    spec, demonstration = options.spec, options.demonstration
    env_kwargs: dict[str, Any] = {"cameras": spec.cameras, "image_size": spec.image_size}
    if spec.arms != task_entry(options.env).arms[0]:
        env_kwargs["arms"] = spec.arms
    if spec.sees_by_camera:
        env_kwargs |= {name: getattr(spec, name) for name in PERCEPTION}
    return Collection(
        env=options.env,
        out=options.out or Path("dataset") / options.env,
        expert=demonstration.expert or next(iter(task_entry(options.env).experts)),
        seeds=options.seeds(first=0),
        env_kwargs={**env_kwargs, "face_motion": "episode", **env_arguments(options)},
        codec=demonstration.image_codec,
        quality=demonstration.image_quality,
        workers=options.workers,
        is_watched=options.view,
    )


def record(options: RolloutOptions) -> None:
    """Record demonstrations, print the closing table, and write the preview.

    Raises:
        RequestError: the request cannot be met.
    """
    from robo_manip_baselines.data import list_episodes
    from robo_manip_baselines.rollout.demonstrate import collect, require_demonstrations_folder
    from robo_manip_baselines.rollout.results import mean_and_sd
    from robo_manip_baselines.rollout.videos import write_preview

    shown, collection = options.demonstration.preview, to_collection(options)
    if shown and not options.spec.cameras and (problem := opengl_problem()):
        logger.warning("no preview video: %s", problem)
        shown = 0
    require_demonstrations_folder(collection.out)
    if shown:
        require_out_file(collection.out / PREVIEW, VIDEO, option="--preview")
    summary = collect(collection)
    episodes = list_episodes(collection.out)[:shown]
    rate = summary.steps_per_second
    rows = {
        "episodes": str(summary.episodes),
        "success": f"{summary.successes}/{summary.episodes}",
        "strict success": f"{summary.strict_successes}/{summary.episodes}",
        "completion time": mean_and_sd(
            summary.completion_time_mean, summary.completion_time_sd, summary.successes
        ),
        "speed": "-" if rate is None else f"{rate:.0f} steps/s",
        "failed seeds": ", ".join(map(str, summary.failed_seeds)) or "-",
        "written to": str(collection.out),
    }
    print(closing_table(rows), flush=True)  # noqa: T201
    if episodes:
        video = collection.out / PREVIEW
        write_preview(video, episodes)
        print(f"preview: {video}")  # noqa: T201


# -- evaluation -----------------------------------------------------------------------------------


def to_evaluation(options: RolloutOptions, checkpoint: Checkpoint | None) -> EvaluationConfig:
    """Return the evaluation that the options of --policy ask for, given the checkpoint they name.

    Raises:
        RequestError: a value is not valid, or differs from the checkpoint where it may not.
    """
    from robo_manip_baselines.policy.registry import policy_entry
    from robo_manip_baselines.rollout.evaluation import FIRST_SEED, EvaluationConfig

    policy_entry(options.policy or "")
    task_entry(options.env).require_env()
    given = options.evaluation
    if given.checkpoint is None or checkpoint is None:
        raise RequestError(
            "which checkpoint? give --checkpoint runs/..., as bin/Train.py prints it"
        )
    trained = checkpoint.spec
    typed = {"policy": options.policy, "environment": options.env, **vars(options.spec)}
    values = {"policy": checkpoint.policy, "environment": checkpoint.env, **vars(trained)}
    for name, value in values.items():
        if name not in ("corruption", *PERCEPTION) and typed[name] != value:
            raise RequestError(
                f"checkpoint '{checkpoint.folder}' was trained with {name} {_as_typed(value)}, not "
                f"{_as_typed(typed[name])}; leave the option as trained, or train another policy"
            )
    corruption = (options.spec.corruption if options.corruption else Corruption()).pinned()
    by_camera = options.spec.sees_by_camera  # in place of the corruption
    is_given = options.corruption and not by_camera
    is_given = is_given and not corruption.is_same_as(trained.corruption)
    if is_given and not given.change_corruption:
        raise RequestError(
            f"checkpoint '{checkpoint.folder}' was trained with {trained.corruption}, not with "
            f"{corruption}; leave the options as trained, or give --change_corruption to evaluate "
            "it under the other one"
        )
    return EvaluationConfig(
        checkpoint=given.checkpoint,
        seeds=options.seeds(FIRST_SEED),
        out=options.out,
        env_kwargs=env_arguments(options),
        corruption=None if by_camera or corruption == trained.corruption else corruption,
        mouth_source=options.spec.mouth_source,
        camera_latency=options.spec.camera_latency,
        temporal_ensemble=given.temporal_ensemble,
        n_action_steps=given.n_action_steps,
        strategy=given.strategy,
        inference_delay=given.inference_delay,
        num_envs=given.num_envs,
        workers=options.workers,
        device=given.device,
        precision=given.precision,
        videos=given.video,
        is_watched=options.view,
    )


def _as_typed(value: object) -> str:
    if not isinstance(value, tuple):
        return str(value)
    return ("x" if value and isinstance(value[0], int) else ",").join(map(str, value)) or "none"


# -- command line ---------------------------------------------------------------------------------


def parse_options(args: Sequence[str]) -> tuple[RolloutOptions, Checkpoint | None]:
    """Read a command line; the spec of the checkpoint that it names gives the defaults.

    Raises:
        RequestError: one line that names what is wrong and what is valid.
        SystemExit: with code 0 after ``--help``.
    """
    checkpoint, spec = None, UNTRAINED
    folder = last_value(args, "checkpoint")
    if last_value(args, "policy") and folder:
        from robo_manip_baselines.policy.checkpoint import read_checkpoint

        checkpoint = read_checkpoint(folder)
        corruption = checkpoint.spec.corruption
        # The statistics of the training go with its error, and with no other file.
        if (last_value(args, "error") or corruption.error) not in MEASURED_ERRORS:
            corruption = replace(corruption, error_stats=None, stats_sha256=None)
        elif last_value(args, "error_stats"):
            corruption = replace(corruption, stats_sha256=None)
        if last_value(args, "mouth_source") not in (None, "truth"):
            corruption = Corruption()  # a camera has errors of its own
        spec = replace(checkpoint.spec, corruption=corruption)
    default = RolloutOptions(tyro.MISSING, spec=spec)
    options = parse(RolloutOptions, EXAMPLE, description=DESCRIPTION, args=args, default=default)
    require_consistent(options)
    task_entry(options.env).require_env()
    if options.scripted and not last_value(args, "arms"):
        arms = task_entry(options.env).arms[0]
        options = replace(options, spec=replace(options.spec, arms=arms))
    return options, checkpoint


def main(args: Sequence[str]) -> None:
    """Run ``bin/Rollout.py``."""
    options, checkpoint = parse_options(args)
    if options.scripted:
        record(options)
        return
    config = to_evaluation(options, checkpoint)
    from robo_manip_baselines.rollout.evaluation import evaluate
    from robo_manip_baselines.rollout.results import summary_table

    plan, summary, videos = evaluate(config)
    names = ", ".join(str(path.relative_to(plan.out)) for path in videos)
    facts = {"written to": str(plan.out), "videos": names or "-"}
    print(summary_table(plan.env.task, summary, facts))  # noqa: T201
