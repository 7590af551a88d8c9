"""Conditions of a benchmark: entries of a YAML file.

The keys of an entry are those of `ConditionConfig`, and the settings of `ObservationSpec` and
`Corruption` under the names of their options.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any

from annotated_types import Len

from robo_manip_baselines.benchmark.statistics.outcomes import END_POINTS
from robo_manip_baselines.envs.mujoco.face import FACES
from robo_manip_baselines.envs.mujoco.face.motions import parse_motion
from robo_manip_baselines.envs.mujoco.face.people import PEOPLE
from robo_manip_baselines.envs.mujoco.tasks.registry import TaskEntry, task_entry
from robo_manip_baselines.observation import PREDICTIONS, Corruption, ObservationSpec
from robo_manip_baselines.policy.checkpoint import read_checkpoint
from robo_manip_baselines.policy.registry import policy_entry
from robo_manip_baselines.runs.documents import convert, load_yaml, shortened
from robo_manip_baselines.runs.errors import RequestError, require_choice, require_printable
from robo_manip_baselines.runs.ranges import Count, Episodes, require_ranges

CONDITIONS = Path(str(files("robo_manip_baselines.benchmark") / "conditions"))
"""Folder of the files that ship with the package; a benchmark is named after its file."""

PUBLISHED = "published"
"""In place of a list of names: the conditions whose results the task's paper reports."""

MODEL = "model"
"""Prediction of a trained predictor, as the motion library holds it: the error of that name."""

_DEFAULT_SPEC = ObservationSpec("current_pred", cameras=())
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,99}")

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class ConditionConfig:
    """Experimental condition: demonstrations, policy and observations.

    Attributes:
        name: in ``results.jsonl``: letters, digits, ``_``, ``-`` and ``.``.
        policy: for example ``Act``.
        spec: observations in training and evaluation; their cameras, objects and arms are those of
            the benchmark's preset.
        expert: of the demonstrations; the task's default if empty.
        motion: of the face in demonstrations and evaluation, as text that `parse_motion` reads; in
            YAML a mapping or a list, too.
        title: in tables and figures; made from the observations if empty.
        checkpoint: trained policy to evaluate, a folder or ``shipped:NAME``; empty to train one.
            Policy and observations are the checkpoint's then, see `of_checkpoint`.

    Raises:
        RequestError: a value is not valid.
    """

    name: str
    policy: str = "Act"
    spec: ObservationSpec = _DEFAULT_SPEC
    expert: str = ""
    motion: str = "recorded"
    title: str = ""
    checkpoint: str = ""

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.name):
            raise RequestError(
                f"name '{self.name}': must be letters, digits, '_', '-' and '.', for example "
                "current_pred_h2_delay3"
            )
        require_printable("title", self.title)
        policy_entry(self.policy)
        motion = parse_motion(self.motion)
        object.__setattr__(self, "motion", str(motion))
        if not motion.is_as_recorded and self.spec.corruption.error == "model":
            raise RequestError(
                f"motion '{motion}': the trained predictor has seen recorded motion alone; choose "
                f"another prediction, of {', '.join(PREDICTIONS)}, or leave the motion out"
            )

    @classmethod
    def from_yaml(cls, values: Any) -> ConditionConfig:
        """Make a condition of an entry of a file.

        Raises:
            RequestError: a key or a value is not valid.
        """
        given: dict[type, dict[str, Any]] = {cls: {}, ObservationSpec: {}, Corruption: {}}
        for key, value in convert(values, dict, "a condition").items():
            owner, name = _KEYS[require_choice("key of a condition", key, _KEYS)]
            if name == "motion":
                value = str(parse_motion(value))
            given[owner][name] = value
        corruption = given[Corruption]
        if corruption.get("prediction") == MODEL:
            if "error" in corruption:
                raise RequestError(f"prediction '{MODEL}' goes without an error; leave it out")
            corruption |= {"prediction": "truth", "error": MODEL}
        elif "prediction" in corruption:
            require_choice("prediction", corruption["prediction"], (*PREDICTIONS, MODEL))
        if "name" not in given[cls]:
            raise RequestError("the condition has no name; add 'name: ...'")
        if "checkpoint" in given[cls]:
            for key in values:
                if key not in _OF_A_CHECKPOINT:
                    raise RequestError(
                        f"'{key}' is what a policy is trained with, and 'checkpoint' is trained; "
                        f"beside it go {', '.join(_OF_A_CHECKPOINT)}"
                    )
            own = convert(given[cls], cls, "condition")
            motion = own.motion if "motion" in values else ""
            return cls.of_checkpoint(own.name, own.checkpoint, motion=motion, title=own.title)
        settings = {**_DEFAULT_SPEC.to_json(), **given[ObservationSpec]}
        settings["corruption"] = corruption
        return replace(
            convert(given[cls], cls, "condition"), spec=ObservationSpec.from_json(settings)
        )

    @classmethod
    def of_checkpoint(
        cls, name: str, checkpoint: str, *, motion: str = "", title: str = ""
    ) -> ConditionConfig:
        """Make a condition of a policy that is trained already.

        Args:
            name: of the condition.
            checkpoint: folder of a run or of a checkpoint, or ``shipped:NAME``.
            motion: of the face; that of the checkpoint's demonstrations if empty.
            title: in tables and figures.

        Raises:
            RequestError: the checkpoint cannot be read, or a value is not valid.
        """
        read = read_checkpoint(checkpoint)
        trained = read.dataset.get("env_kwargs", {}).get("motion", "recorded")
        return cls(
            name,
            read.policy,
            read.spec,
            motion=motion or trained,
            title=title,
            checkpoint=checkpoint,
        )

    def for_task(self, task: TaskEntry) -> ConditionConfig:
        """Return the condition with the task's default expert, if none is given.

        Raises:
            RequestError: the task has no such expert, its paper has another condition of that
                name, or the checkpoint is of another task.
        """
        if self.checkpoint and (trained := read_checkpoint(self.checkpoint).env) != task.name:
            raise RequestError(
                f"checkpoint '{self.checkpoint}' was trained in {trained}, not in {task.name}; "
                "leave the condition out"
            )
        default, *_ = task.experts
        expert = require_choice("expert", self.expert or default, task.experts)
        is_plain = expert == default and self.motion == "recorded" and not self.checkpoint
        if self.name in task.load_study().published and not (
            is_plain and self.spec.name == self.name
        ):
            raise RequestError(
                f"the name '{self.name}' is that of a condition of the paper, with which it would "
                "be compared, and these settings are others; choose another name"
            )
        return replace(self, expert=expert)

    def observation(self, preset: ObservationSpec) -> ObservationSpec:
        """Return the spec of the policy: a preset's with the condition's settings in it."""
        names = ("obs", "horizon", "relative", "mouth_frame", "mouth_time", "corruption")
        return replace(preset, **{name: getattr(self.spec, name) for name in names})


_OF_A_CHECKPOINT = ("name", "checkpoint", "motion", "title")
"""Keys of an entry whose policy is trained already."""

_NOT_OF_A_CONDITION = (
    # Of the preset:
    *("spec", "cameras", "image_size", "render_size", "object_pose", "arms", "corruption"),
    *("error_stats", "stats_sha256"),  # one file for all conditions
    *("mouth_source", "camera_latency"),  # policies are trained with the truth
)


def _find_keys() -> dict[str, tuple[type, str]]:
    """Map each key of an entry to its class and its field."""
    keys: dict[str, tuple[type, str]] = {}
    for owner in (ConditionConfig, ObservationSpec, Corruption):
        for name in (item.name for item in fields(owner)):
            key = "corruption_seed" if (owner, name) == (Corruption, "seed") else name
            if name not in _NOT_OF_A_CONDITION:
                keys[key] = owner, name
    return keys


_KEYS = _find_keys()


def find_references(conditions: Sequence[ConditionConfig], within: Sequence[str]) -> dict[str, str]:
    """Return name of a condition -> name of the one that it is compared with.

    That is the first that observes ``current`` of those that have the same values of all keys
    ``within``, or the first of these.

    Args:
        conditions: in their order.
        within: keys of entries of a file of conditions, such as ``motion`` and ``delay``.
    """

    def values(condition: ConditionConfig) -> tuple[Any, ...]:
        spec = condition.spec
        owners = {ConditionConfig: condition, ObservationSpec: spec, Corruption: spec.corruption}
        return tuple(getattr(owners[owner], name) for owner, name in (_KEYS[key] for key in within))

    alike: dict[tuple[Any, ...], list[ConditionConfig]] = {}
    for condition in conditions:
        alike.setdefault(values(condition), []).append(condition)
    return {
        condition.name: next((c for c in group if c.spec.obs == "current"), group[0]).name
        for group in alike.values()
        for condition in group
    }


@dataclass(frozen=True)
class DrawnPeople:
    """People whose motion a benchmark draws, see `MotionLibrary.part`.

    Attributes:
        demonstrations, evaluation: ``all``, ``train`` or ``test``.

    Raises:
        RequestError: there are no such people.
    """

    demonstrations: str = "all"
    evaluation: str = "all"

    def __post_init__(self) -> None:
        for item in fields(self):
            require_choice(f"people of {item.name}", getattr(self, item.name), PEOPLE)

    def __bool__(self) -> bool:
        """Return whether anybody is left out anywhere."""
        return (self.demonstrations, self.evaluation) != ("all", "all")

    def __str__(self) -> str:
        if not self:
            return "the same in demonstrations and evaluation"
        return f"{self.demonstrations} in demonstrations, {self.evaluation} in evaluation"


EVERYBODY = DrawnPeople()


@dataclass(frozen=True)
class SizeChanges:
    """Numbers of a preset that a benchmark has otherwise; None as in the preset.

    Attributes:
        demonstrations, train_seeds, num_episodes: see `BenchmarkPreset`.
        train_settings: beside those of the preset.
    """

    demonstrations: Episodes | None = None
    train_seeds: Count | None = None
    num_episodes: Episodes | None = None
    train_settings: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        require_ranges(self)

    def given(self) -> dict[str, Any]:
        """Return the numbers that differ, without the settings."""
        numbers = {item.name: getattr(self, item.name) for item in fields(self)}
        del numbers["train_settings"]
        return {name: number for name, number in numbers.items() if number is not None}


AS_IN_THE_PRESET = SizeChanges()


@dataclass(frozen=True)
class ConditionsDocument:
    """Content of a file of conditions.

    Attributes:
        conditions: entries, see `ConditionConfig.from_yaml`.
        env: name of the task.
        presets: name of a preset -> names of its conditions, or ``published``.
        sizes: name of a preset -> its numbers that this benchmark has otherwise.
        headline: end point of the benchmark, a key of `END_POINTS`.
        people: in demonstrations and evaluation.
        face: kind of face, one of `FACES`.
        compare_within: keys of conditions, see `find_references`.

    Raises:
        RequestError: there is no such end point, face or key.
    """

    conditions: Annotated[tuple[Any, ...], Len(1, 1000)]
    env: str = "FeedingEnv"
    presets: dict[str, Any] = field(default_factory=dict)
    sizes: dict[str, SizeChanges] = field(default_factory=dict)
    headline: str = "success"
    people: DrawnPeople = EVERYBODY
    face: str = FACES[0]
    compare_within: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        require_choice("headline", self.headline, END_POINTS)
        require_choice("face", self.face, FACES)
        for key in self.compare_within:
            require_choice("key to compare within", key, _KEYS)


@dataclass(frozen=True)
class ConditionFile:
    """Contents of a file of conditions.

    Attributes:
        env: name of the task.
        conditions: in their order.
        presets: name of a preset -> names of its conditions; others have all of them.
        headline: end point of the benchmark, a key of `END_POINTS`.
        people: in demonstrations and evaluation.
        face: kind of face.
        sizes: name of a preset -> its numbers that this benchmark has otherwise.
        compare_within: keys of conditions, see `find_references`.
    """

    env: str
    conditions: tuple[ConditionConfig, ...]
    presets: Mapping[str, tuple[str, ...]]
    headline: str = "success"
    people: DrawnPeople = EVERYBODY
    face: str = FACES[0]
    sizes: Mapping[str, SizeChanges] = field(default_factory=dict)
    compare_within: tuple[str, ...] = ()

    def choose(self, names: Sequence[str]) -> tuple[ConditionConfig, ...]:
        """Return the conditions of these names, in the order of the file.

        Raises:
            RequestError: there is no such condition.
        """
        known = [condition.name for condition in self.conditions]
        wanted = {require_choice("condition", name, known) for name in names}
        return tuple(condition for condition in self.conditions if condition.name in wanted)


def read_conditions(path: Path) -> ConditionFile:
    """Read a file of conditions.

    Raises:
        RequestError: the file cannot be read, or an entry is not valid; the message names its line.
    """
    content, lines = load_yaml(path)
    key = "conditions"
    if isinstance(content, dict) and "arms" in content and key not in content:
        content = {key if name == "arms" else name: value for name, value in content.items()}
        lines = {
            (key, *place[1:]) if place[:1] == ("arms",) else place: n for place, n in lines.items()
        }
        logger.info("'%s': 'arms:' is called 'conditions:' now; both are read", path)
    document = convert(content, ConditionsDocument, f"'{path}'", lines)
    place = ""
    conditions: list[ConditionConfig] = []
    try:
        task = task_entry(document.env)
        task.require_env()
        for number, values in enumerate(document.conditions):
            place = f", line {lines[key, number]}"
            condition = ConditionConfig.from_yaml(values).for_task(task)
            if condition.name in [other.name for other in conditions]:
                raise RequestError(
                    f"the name '{condition.name}' is there twice; choose another one"
                )
            if document.people and condition.name in task.load_study().published:
                raise RequestError(
                    f"the name '{condition.name}' is that of a condition of the paper, with which "
                    "it would be compared, and the people are others; choose another name"
                )
            conditions.append(condition)
        place = ""
        published = tuple(task.load_study().published)
        file = ConditionFile(
            task.name,
            tuple(conditions),
            {
                name: published
                if names == PUBLISHED
                else convert(names, tuple[str, ...], f"presets.{shortened(name)}")
                for name, names in document.presets.items()
            },
            document.headline,
            document.people,
            document.face,
            document.sizes,
            document.compare_within,
        )
        for names in file.presets.values():
            file.choose(names)
    except RequestError as error:
        raise RequestError(f"'{path}'{place}: {error}") from None
    return file
