"""Conditions of a benchmark: entries of a YAML file.

The keys of an entry are those of `ConditionConfig`, and the settings of `ObservationSpec` and
`Corruption` under the names of their options.
"""

from __future__ import annotations

import logging
import re
import typing
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

from robo_manip_baselines.benchmark.forecasts import FORECASTS
from robo_manip_baselines.envs.mujoco.face.motions import parse_motion
from robo_manip_baselines.envs.mujoco.tasks.registry import TaskEntry, task_entry
from robo_manip_baselines.observation import Corruption, ObservationSpec
from robo_manip_baselines.policy.registry import policy_entry
from robo_manip_baselines.runs.errors import RequestError, require_choice

CONDITIONS = Path(str(files("robo_manip_baselines.benchmark") / "conditions"))
"""Folder of the files that ship with the package; a benchmark is named after its file."""

PUBLISHED = "published"
"""In place of a list of names: the conditions whose results the task's paper reports."""

_DEFAULT_SPEC = ObservationSpec("current_pred", cameras=())
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")
_TYPE_NAMES = {str: "text", int: "a whole number", float: "a number"}

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class ConditionConfig:
    """Experimental condition: demonstrations, policy and observations.

    Attributes:
        name: in ``results.jsonl``: letters, digits, ``_``, ``-`` and ``.``.
        policy: for example ``Act``.
        spec: observations in training and evaluation; their cameras, objects and arms are those of
            the benchmark's preset.
        prediction: future of the target in observations: ``truth``, or a forecast in its place, see
            `forecasts`.
        expert: of the demonstrations; the task's default if empty.
        motion: of the face in demonstrations and evaluation, as text that `parse_motion` reads; in
            YAML a mapping or a list, too.
        title: in tables and figures; made from the observations if empty.

    Raises:
        RequestError: a value is not valid.
    """

    name: str
    policy: str = "Act"
    spec: ObservationSpec = _DEFAULT_SPEC
    prediction: str = "truth"
    expert: str = ""
    motion: str = "recorded"
    title: str = ""

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.name):
            raise RequestError(
                f"name '{self.name}': must be letters, digits, '_', '-' and '.', for example "
                "current_pred_h2_delay3"
            )
        policy_entry(self.policy)
        require_choice("prediction", self.prediction, ("truth", *FORECASTS))
        motion = parse_motion(self.motion)
        object.__setattr__(self, "motion", str(motion))
        spec = self.spec
        if not motion.is_as_recorded and (
            self.prediction != "truth" or spec.corruption.error == "model"
        ):
            raise RequestError(
                f"motion '{motion}': forecasts in place of the truth, and the error model, are of "
                "recorded motion; leave one of them out"
            )
        if self.prediction != "truth" and (
            spec.obs != "current_pred" or spec.corruption.error != "none"
        ):
            raise RequestError(
                f"prediction '{self.prediction}' goes with obs current_pred and without an error; "
                "leave the other out"
            )

    @classmethod
    def from_yaml(cls, values: Any) -> ConditionConfig:
        """Make a condition of an entry of a file.

        Raises:
            RequestError: a key or a value is not valid.
        """
        if not isinstance(values, dict):
            raise RequestError("a condition is a mapping such as {name: current, obs: current}")
        given: dict[type, dict[str, Any]] = {cls: {}, ObservationSpec: {}, Corruption: {}}
        for key, value in values.items():
            owner, name, kind = _KEYS[require_choice("key of a condition", str(key), _KEYS)]
            if name == "motion":
                value = str(parse_motion(value))
            accepted = (int, float) if kind is float else kind
            if not isinstance(value, accepted) or isinstance(value, bool):
                raise RequestError(f"{key} must be {_TYPE_NAMES[kind]}, not {value!r}")
            given[owner][name] = value
        if "name" not in values:
            raise RequestError("the condition has no name; add 'name: ...'")
        corruption = Corruption(**given[Corruption])
        spec = replace(_DEFAULT_SPEC, **given[ObservationSpec], corruption=corruption)
        return cls(**given[cls], spec=spec)

    def for_task(self, task: TaskEntry) -> ConditionConfig:
        """Return the condition with the task's default expert, if none is given.

        Raises:
            RequestError: the task has no such expert, or its paper has another condition of that
                name.
        """
        default, *_ = task.experts
        expert = require_choice("expert", self.expert or default, task.experts)
        is_plain = self.prediction == "truth" and expert == default and self.motion == "recorded"
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
        corruption = self.spec.corruption
        if self.prediction != "truth":  # forecasts are recorded as a predictor's output is
            corruption = replace(corruption, error="model")
        return replace(preset, obs=self.spec.obs, horizon=self.spec.horizon, corruption=corruption)


_NOT_OF_A_CONDITION = (
    *("cameras", "image_size", "render_size", "object_pose", "arms", "corruption"),  # of the preset
    *("error_stats", "stats_sha256"),  # one file for all conditions
)


def _find_keys() -> dict[str, tuple[type, str, type]]:
    """Map each key of an entry to its class, its field and the type of its value."""
    keys: dict[str, tuple[type, str, type]] = {}
    for owner in (ConditionConfig, ObservationSpec, Corruption):
        hints = typing.get_type_hints(owner)
        for name in (item.name for item in fields(owner)):
            key = "corruption_seed" if (owner, name) == (Corruption, "seed") else name
            accepted = (hints[name], *typing.get_args(hints[name]))
            kinds = [kind for kind in _TYPE_NAMES if kind in accepted]
            if kinds and name not in _NOT_OF_A_CONDITION:
                keys[key] = owner, name, kinds[0]
    return keys


_KEYS = _find_keys()


@dataclass(frozen=True)
class ConditionFile:
    """Contents of a file of conditions.

    Attributes:
        env: name of the task.
        conditions: in their order.
        presets: name of a preset -> names of its conditions; others have all of them.
    """

    env: str
    conditions: tuple[ConditionConfig, ...]
    presets: Mapping[str, tuple[str, ...]]

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
    import yaml  # slow to import

    try:
        text = path.read_text(encoding="utf-8")
        content, node = yaml.safe_load(text), yaml.compose(text, yaml.SafeLoader)
    except OSError as error:
        raise RequestError(f"cannot read '{path}': {error.strerror or error}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise RequestError(f"'{path}' is no YAML: {error}") from error
    key = "conditions"
    if isinstance(content, dict) and "arms" in content and key not in content:
        key = "arms"
        logger.info("'%s': 'arms:' is called 'conditions:' now; both are read", path)
    if not isinstance(content, dict) or not isinstance(content.get(key), list):
        raise RequestError(f"'{path}' must hold 'env: FeedingEnv' and a list 'conditions:'")
    if not content[key]:
        raise RequestError(
            f"'{path}' has no conditions; give a line such as '- {{name: current, ...}}'"
        )
    (entries,) = (value.value for name, value in node.value if name.value == key)
    place = ""
    conditions: list[ConditionConfig] = []
    try:
        for name in content:
            require_choice("entry", str(name), ("env", key, "presets"))
        task = task_entry(str(content.get("env", "FeedingEnv")))
        for entry, values in zip(entries, content[key], strict=True):
            place = f", line {entry.start_mark.line + 1}"
            condition = ConditionConfig.from_yaml(values).for_task(task)
            if condition.name in [other.name for other in conditions]:
                raise RequestError(
                    f"the name '{condition.name}' is there twice; choose another one"
                )
            conditions.append(condition)
        place = ""
        presets = content.get("presets", {})
        if not isinstance(presets, dict) or not all(
            names == PUBLISHED or isinstance(names, list) for names in presets.values()
        ):
            raise RequestError(f"presets map names of presets to '{PUBLISHED}', or a list of names")
        published = task.load_study().published
        file = ConditionFile(
            task.name,
            tuple(conditions),
            {k: tuple(published if v == PUBLISHED else v) for k, v in presets.items()},
        )
        for names in file.presets.values():
            file.choose(names)
    except RequestError as error:
        raise RequestError(f"'{path}'{place}: {error}") from None
    return file
