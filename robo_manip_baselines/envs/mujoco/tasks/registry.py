"""Registered tasks. Adding one is a folder with an ``ENTRY`` and a line in ``TASKS``.

Another package registers a task by an entry point of the group ``robo_manip_baselines.tasks``:
the name of the task, and ``module:ENTRY``. Importing this module imports no simulator.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import entry_points
from inspect import Parameter, signature
from pkgutil import resolve_name
from typing import Any, Literal, Protocol

import gymnasium
import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.observation import ObservationSpec, ObservedNames
from robo_manip_baselines.observation.spec import ARMS
from robo_manip_baselines.runs.errors import RequestError, require_choice

NAMESPACE = "robo_manip_baselines"

TASKS = {
    "FeedingEnv": "robo_manip_baselines.envs.mujoco.tasks.feeding:ENTRY",
    "DrinkingEnv": "robo_manip_baselines.envs.mujoco.tasks.drinking:ENTRY",
    "BimanualFeedingEnv": "robo_manip_baselines.envs.mujoco.tasks.bimanual_feeding:ENTRY",
    "FaceWipingEnv": "robo_manip_baselines.envs.mujoco.tasks.wiping:ENTRY",
}
"""Name of a task -> ``module:name`` of its `TaskEntry`."""

IMPORTED = "ImportedEnv"
"""Task of demonstrations that other programs recorded, see `imported_entry`: policies can be
trained on them, and there is no environment to run."""


@dataclass(frozen=True)
class Field:
    """Array of an episode file, a row for each control step.

    Attributes:
        name: in the file.
        shape: sizes, or symbols of the episode format, from "T" on.
        description: for the documentation.
        unit: SI unit of the elements.
        frame: in which they are expressed.
        dtype: of the array.
        rule: that the numbers obey.
        since: schema version; absent from files of a lower one.
        is_optional: whether an episode may come without.
    """

    name: str
    shape: tuple[int | str, ...]
    description: str
    unit: str = ""
    frame: str = ""
    dtype: str = "float64"
    rule: Literal["", "unit quaternion", "increasing", "not negative", "phase index"] = ""
    since: int = 1
    is_optional: bool = False


@dataclass(frozen=True)
class Attribute:
    """Attribute of an episode file's root group.

    Attributes:
        name: in the file.
        kind: type of the value.
        description: for the documentation.
        is_derived: filled in by the writer.
        length: of a vector.
        since: schema version; no attribute of files of a lower one.
        is_optional: whether an episode may come without.
    """

    name: str
    kind: Literal["text", "json", "int", "float", "bool", "vector"]
    description: str
    is_derived: bool = False
    length: int = 0
    since: int = 1
    is_optional: bool = False


@dataclass(frozen=True)
class ResultColumn:
    """Column that a task adds to result rows.

    Attributes:
        name: in ``results.jsonl``.
        kind: ``float`` or ``vector`` of three numbers.
        description: for the documentation.
        is_optional: whether null is valid.
        in_report: whether the report lists it with each episode.
        unit: SI unit, for the heading in the report.
        in_tables: whether a table of benchmarks has its mean and 90th percentile.
        may_be_absent: whether rows of earlier releases lack it, which reads as null.
    """

    name: str
    kind: Literal["float", "vector"]
    description: str
    is_optional: bool = False
    in_report: bool = False
    unit: str = ""
    in_tables: bool = False
    may_be_absent: bool = False


@dataclass(frozen=True)
class PublishedResult:
    """Result of a condition in a paper.

    Attributes:
        successes: number of successful trials.
        completion_time: s, mean.
    """

    successes: int
    completion_time: float


@dataclass(frozen=True)
class Claim:
    """Contrast between conditions that should be above a limit.

    Attributes:
        text: of the claim.
        weights: name of a condition -> its weight in the contrast.
        measure: what is weighted: ``success`` (rate) or ``time`` (s).
        limit: that the contrast should exceed.
    """

    text: str
    weights: Mapping[str, float]
    measure: str = "success"
    limit: float = 0.0


@dataclass(frozen=True)
class EpisodeFigure:
    """Figure of a report with one panel for each condition, drawn by the task.

    Attributes:
        name: of the file.
        title: above the figure.
        caption: below it.
        summary: for readers who cannot see it.
        xlabel, ylabel: of all panels.
        draw: draws the result rows of one condition into Matplotlib axes.
    """

    name: str
    title: str
    caption: str
    summary: str
    xlabel: str
    ylabel: str
    draw: Any


@dataclass(frozen=True)
class TaskStudy:
    """Published results, claims and figures of a task, for benchmarks.

    Attributes:
        published: name of a condition -> result in the paper.
        trials: of each published condition.
        time_rounding: s, half of the last digit of published times.
        success_table, time_table: names of the paper's tables; empty without a paper.
        claims: in the order of the table.
        figures: of the report.
    """

    published: Mapping[str, PublishedResult] = field(default_factory=dict)
    trials: int = 0
    time_rounding: float = 0.0
    success_table: str = ""
    time_table: str = ""
    claims: tuple[Claim, ...] = ()
    figures: tuple[EpisodeFigure, ...] = ()


class Expert(Protocol):
    """Scripted expert that acts in the environment it was made for."""

    def reset(self) -> None:
        """Start an episode; called after the environment's reset."""
        ...

    def act(self) -> NDArray[np.float32]:
        """Return the next action."""
        ...


class EpisodeMetrics(Protocol):
    """Metrics of one evaluation episode, from the ``info`` of its steps; made without arguments."""

    def update(self, info: Mapping[str, Any]) -> None:
        """Take in the ``info`` of a step."""
        ...

    def result(self, info: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
        """Return the kind of failure and the task's columns, given the ``info`` of the last step.

        The kind is empty for a success.
        """
        ...


@dataclass(frozen=True, eq=False)
class TaskEntry:
    """Everything that the rest of the package knows of a task.

    Attributes:
        name: as commands take it; ``env_id`` is made from it and ``version``.
        env: ``module:class`` of the environment, a `FaceEnv`.
        version: of the environment.
        max_episode_steps: time limit in control steps of 0.02 s.
        experts: name -> ``module:callable`` that makes the `Expert` of an environment; the first
            one is the default.
        metrics: ``module:class`` of its `EpisodeMetrics`.
        failures: kind of failure -> description.
        arms: that can do it, of `ObservationSpec.arms`; the first is the default.
        choices: arguments of its own environment -> valid values; the first is the default.
        names: of target and objects in observations.
        target_field, predicted_field: fields of an episode that hold the true target and a
            predictor's output for it; ``predicted_field`` is empty where the target is not the
            mouth, which is what predictors forecast.
        object_fields: fields that hold the poses of the objects, in the order of ``names.objects``.
        fields: that the task adds to an episode file.
        attributes: likewise.
        columns: that it adds to result rows.
        success, strict_success: descriptions of the two conditions.
        completion_time: description of the interval that ``completion_time`` measures.
        success_time_limit: s after which a success counts as late in tables; None for no limit.
        study: ``module:name`` of its `TaskStudy`; empty without one.
        goal_env: ``module:class`` of a goal-conditioned view of it, for reinforcement learning;
            empty without one. Commands do not take it.
        schema_version: lowest version of the episode schema that describes its files.
        instruction: the task in words, for policies with language.
    """

    name: str
    env: str
    max_episode_steps: int
    experts: Mapping[str, str]
    metrics: str
    failures: Mapping[str, str]
    version: int = 0
    arms: tuple[str, ...] = tuple(ARMS)
    choices: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    names: ObservedNames = field(default_factory=ObservedNames)
    target_field: str = "mouth_position"
    predicted_field: str = "predicted_mouth"
    object_fields: tuple[str, ...] = ()
    fields: tuple[Field, ...] = ()
    attributes: tuple[Attribute, ...] = ()
    columns: tuple[ResultColumn, ...] = ()
    success: str = ""
    strict_success: str = ""
    completion_time: str = "from the start to success"
    success_time_limit: float | None = None
    study: str = ""
    goal_env: str = ""
    schema_version: int = 3
    instruction: str = ""

    def __post_init__(self) -> None:
        if len(self.names.objects) != len(self.object_fields):
            raise ValueError(f"task {self.name}: one field for each of {self.names.objects}")

    @property
    def env_id(self) -> str:
        """Registered id of the environment."""
        return f"{NAMESPACE}/{self.name}-v{self.version}"

    @property
    def goal_env_id(self) -> str:
        """Registered id of the goal-conditioned view, if there is one."""
        return f"{NAMESPACE}/{self.name.removesuffix('Env')}GoalEnv-v{self.version}"

    def require_env(self) -> None:
        """Require that there is an environment to run.

        Raises:
            RequestError: there are only demonstrations.
        """
        if not self.env:
            raise RequestError(
                f"{self.name}: demonstrations of other programs, without an environment to run; "
                f"train on them with bin/Train.py, or choose one of {', '.join(task_names())}"
            )

    def require_arms(self, arms: str) -> None:
        """Require arms that can do the task.

        Raises:
            RequestError: they cannot.
        """
        if arms not in self.arms:
            raise RequestError(
                f"arms {arms}: cannot do {self.name}; valid: {', '.join(sorted(self.arms))}"
            )

    def require_argument(self, name: str, value: str) -> str:
        """Return the value of an argument of the task's own environment.

        Raises:
            RequestError: the task has no such argument, or not that value.
        """
        if name not in self.choices:
            raise RequestError(f"{name} {value}: {self.name} has no such choice; leave it out")
        return require_choice(name, value, self.choices[name])

    def make_expert(self, name: str, env: Any) -> Expert:
        """Make a scripted expert for an unwrapped environment.

        Raises:
            RequestError: there is no such expert.
        """
        return resolve_name(self.experts[require_choice("expert", name, self.experts)])(env)

    def make_metrics(self) -> EpisodeMetrics:
        """Make the metrics of one episode."""
        return resolve_name(self.metrics)()

    def require_forecasts(self, spec: ObservationSpec) -> None:
        """Require that the target is the mouth, which is what is forecast, if forecasts are shown.

        A camera shows forecasts, too.

        Raises:
            RequestError: it is another point of the face.
        """
        corruption = spec.corruption
        shown = corruption.prediction != "truth" and f"prediction {corruption.prediction}"
        shown = shown or (spec.sees_by_camera and f"mouth_source {spec.mouth_source}")
        shown = shown or (corruption.error == "model" and "error model")
        if shown and not self.predicted_field:
            raise RequestError(
                f"{shown}: predictors forecast the mouth, not the {self.names.target} of "
                f"{self.name}; choose another one"
            )

    def load_study(self) -> TaskStudy:
        """Return published results, claims and figures."""
        return resolve_name(self.study) if self.study else TaskStudy()


@cache
def _references() -> dict[str, str]:
    """Map the names of all tasks to ``module:name``, the package's own first."""
    points = entry_points(group="robo_manip_baselines.tasks")
    return {point.name: point.value for point in points} | TASKS


def task_names() -> list[str]:
    """Return the names of all registered tasks."""
    return [*TASKS, *sorted(set(_references()) - set(TASKS))]


def task_entry(name: str) -> TaskEntry:
    """Return the entry of a task; also that of `IMPORTED`, which `task_names` does not list.

    Raises:
        RequestError: there is no such task.
    """
    if name == IMPORTED:
        return imported_entry()
    references = _references() | TASKS
    return resolve_name(references[require_choice("environment", name, references)])


def entry_of_id(env_id: str) -> TaskEntry:
    """Return the entry of a registered environment id.

    Raises:
        RequestError: there is no such task, or it has another version in this release.
    """
    name = env_id.removeprefix(f"{NAMESPACE}/").rpartition("-v")[0]
    entry = task_entry(name or env_id)
    if entry.env_id != env_id:
        raise RequestError(f"environment '{env_id}': this release has {entry.env_id}")
    return entry


def register_envs(names: Sequence[str] | None = None) -> None:
    """Register the environments of tasks, and goal-conditioned views of them, with Gymnasium.

    Those of all tasks, if no names are given.
    """
    for name in task_names() if names is None else names:
        entry = task_entry(name)
        for env_id, env in ((entry.env_id, entry.env), (entry.goal_env_id, entry.goal_env)):
            if env and env_id not in gymnasium.registry:
                limit = entry.max_episode_steps
                gymnasium.register(env_id, entry_point=env, max_episode_steps=limit)


def make_env(name: str, **kwargs: Any) -> gymnasium.Env[Any, Any]:
    """Make the environment of a task.

    Raises:
        RequestError: there is no such task, it has no environment, or an argument is not valid.
    """
    task_entry(name).require_env()
    register_envs([name])
    return gymnasium.make(task_entry(name).env_id, **kwargs)


ENV_ARGUMENTS: Mapping[str, tuple[type, ...]] = {
    "obs": (str,),
    "horizon": (int,),
    "cameras": (list,),
    "image_size": (list,),
    "render_size": (list, type(None)),
    "object_pose": (bool,),
    "relative": (bool,),
    "mouth_frame": (str,),
    "mouth_time": (str,),
    "arms": (str,),
    "corruption": (dict, type(None)),
    "mouth_source": (str,),
    "camera_latency": (int, str),
    "face": (str,),
    "face_motion": (str,),
    "motion": (str,),
    "people": (str,),
    "clips": (list, type(None)),
    "motion_library": (str, type(None)),
    "motion_sha256": (str, type(None)),
    "shadows": (bool,),
    "multisamples": (int,),
    "render_mode": (str, type(None)),
    "error": (str,),  # of older releases; it says what was shown, like `corruption`
}
"""Arguments of every environment, as JSON -> types. The same as those of `FaceEnv`, whose module
imports the simulator."""


def env_kwargs_problem(task: TaskEntry | None, kwargs: object) -> str:
    """Return what is wrong with arguments of an environment that were read from a file, or "".

    Args:
        task: whose environment may have arguments of its own; the common ones are known if None.
        kwargs: as JSON gives them.
    """
    if not isinstance(kwargs, dict):
        return f"must be an object with names of arguments, not {str(kwargs)[:80]!r}"
    unknown = sorted(str(name) for name in kwargs if name not in ENV_ARGUMENTS)
    if unknown and task is not None and task.env:
        known = signature(resolve_name(task.env)).parameters
        unknown = [
            name
            for name in unknown
            if name not in known or known[name].kind is Parameter.VAR_KEYWORD
        ]
    if unknown:
        return f"has '{unknown[0][:80]}', which is no argument of the environment"
    for name, value in kwargs.items():
        kinds = ENV_ARGUMENTS.get(name, (type(value),))
        if type(value) not in kinds:  # a bool is no int here
            return f"has {name} {str(value)[:80]!r}, not of type {kinds[0].__name__}"
        if isinstance(value, list):
            kind = int if name.endswith("_size") else str
            if not all(type(item) is kind for item in value):
                return f"has {name} {str(value)[:80]}, not a list of type {kind.__name__}"
        if name.endswith("_size") and value is not None and len(value) != 2:
            return f"has {name} {str(value)[:80]}, not height and width"
    if kwargs.get("render_mode") not in (None, "rgb_array"):
        return "has a render_mode that opens windows"
    return ""


@cache
def imported_entry() -> TaskEntry:
    """Return the entry of demonstrations that other programs recorded: no target, no object."""
    return TaskEntry(
        name=IMPORTED,
        env="",
        max_episode_steps=0,
        experts={},
        metrics="",
        failures={},
        target_field="",
        predicted_field="",
        attributes=(
            Attribute("source_format", "text", "Format it was imported from, `rmb` or `aloha`"),
            Attribute("source_name", "text", "Name of the file or folder it was imported from"),
            Attribute("source_attributes", "json", "Attributes of that file"),
            Attribute("instruction", "text", "The task in words, if the file has it"),
        ),
    )


@cache
def _shipped_libraries() -> dict[str, str]:
    """Map the digests of the motion libraries that ship with the package to their names."""
    from robo_manip_baselines.envs.mujoco.face.motion import (  # the simulator, too
        LIBRARIES,
        MotionLibrary,
    )

    return {MotionLibrary.load(name).sha256: name or "" for name in (None, *LIBRARIES)}


def without_library_path(env_kwargs: Mapping[str, Any]) -> dict[str, Any]:
    """Return arguments of an environment that name the motion library by its content alone.

    A path tells nothing where files may be replaced or moved. Without a path, the library is the
    one that ships with the package; others that ship keep, or get, their names. The path stays
    where older releases recorded no digest.
    """
    kwargs = dict(env_kwargs)
    if kwargs.get("motion_library") and not kwargs.get("motion_sha256"):
        return kwargs
    kwargs.pop("motion_library", None)
    sha256 = kwargs.pop("motion_sha256", None)
    if sha256 is None:
        return kwargs
    name = _shipped_libraries().get(sha256)
    if name == "":
        return kwargs
    return {**kwargs, **({"motion_library": name} if name else {}), "motion_sha256": sha256}


FACE_FIELDS = (
    Field(
        "mouth_position",
        ("T", "K", 3),
        "True mouth centre now (k = 0) and k = 1…K-1 frames of `prediction_period` ahead: x, y, z",
        "m",
        "world",
    ),
    Field(
        "predicted_mouth",
        ("T", "H", 3),
        "Mouth centre k = 1…H frames ahead as forecast by a trained predictor, its last error held "
        "between video frames: x, y, z; only where the recorded motion holds predictions",
        "m",
        "world",
        since=2,
        is_optional=True,
    ),
    Field(
        "head_orientation",
        ("T", 4),
        "True head orientation now: quaternion w, x, y, z",
        "1",
        "world",
        rule="unit quaternion",
    ),
    Field(
        "jaw_opening",
        ("T",),
        "Distance between the middle of the inner lips, now",
        "m",
        rule="not negative",
    ),
    Field(
        "region_force",
        ("T", "R", "B"),
        "Largest normal force between a region of the face and what touches it, in the control "
        "step of this row's action, all contact points together",
        "N",
        dtype="float32",
        rule="not negative",
        since=4,
        is_optional=True,
    ),
    Field(
        "region_impulse",
        ("T", "R", "B"),
        "Impulse of the normal force, likewise",
        "N s",
        dtype="float32",
        rule="not negative",
        since=4,
        is_optional=True,
    ),
)
"""Fields that every task with a replayed face records."""

FACE_ATTRIBUTES = (
    Attribute(
        "motion_clip",
        "text",
        "Clip that the face's motion was recorded from; synthetic without a recording",
    ),
    Attribute("motion_subject", "text", "Person in that clip, likewise"),
    Attribute(
        "motion_start_index",
        "int",
        "First sample of the segment in the motion library; -1 without a recording",
    ),
    Attribute("motion_start_time", "float", "Start of the segment within its run, in s"),
    Attribute("face_offset", "vector", "Offset of the face's base position, in m", length=3),
)
"""Attributes that every task with a replayed face records."""

FORCE_LIMITS = (1, 10, 30)
"""N, forces on the face above which time is counted: a touch, a push, and one that hurts."""

FORCE_COLUMNS = (
    ResultColumn(
        "face_force",
        "float",
        "N, largest normal force between robot and face",
        in_report=True,
        unit="N",
        in_tables=True,
    ),
    *(
        ResultColumn(
            f"force_time_{limit}",
            "float",
            f"s, time with more than {limit} N between robot and face",
            is_optional=True,
            unit="s",
            in_tables=True,
            may_be_absent=True,
        )
        for limit in FORCE_LIMITS
    ),
)
"""Columns of every task that records the force on the face; `FaceForce` has their values."""
