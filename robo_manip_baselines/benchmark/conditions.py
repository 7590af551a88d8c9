"""Arms of a benchmark: lines of a YAML file."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

from robo_manip_baselines.benchmark.forecasts import FORECASTS
from robo_manip_baselines.benchmark.statistics.conditions import Arm, arm_of
from robo_manip_baselines.envs.mujoco.tasks.feeding.expert import EXPERTS
from robo_manip_baselines.envs.mujoco.tasks.feeding.paper import PAPER
from robo_manip_baselines.envs.mujoco.tasks.registry import ENVS
from robo_manip_baselines.observation import Corruption, ObservationSpec
from robo_manip_baselines.policy.registry import policy_entry
from robo_manip_baselines.rollout.evaluation import arm_name
from robo_manip_baselines.runs.errors import RequestError, require_choice

ARMS = Path(str(files("robo_manip_baselines.benchmark") / "arms"))
"""Folder of the files that ship with the package; a benchmark is named after its file."""

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]*")


@dataclass(frozen=True)
class ArmLine:
    """An arm: what is demonstrated, what the policy is shown, and which policy it is.

    Attributes:
        name: as in ``results.jsonl``: letters, digits, ``_``, ``-`` and ``.``.
        policy: which one, for example ``Act``.
        obs, horizon: see `ObservationSpec`.
        error, delay, face_dropout, face_dropout_length, detector_rate, corruption_seed: what
            stands between truth and policy in training and in evaluation, see `Corruption`;
            None is as if nothing were said.
        prediction: ``truth``, or a forecast in its place, see `forecasts`.
        expert: who demonstrates, ``reactive`` or ``anticipatory``.
        title: in tables and plots; from the name if empty.

    Raises:
        RequestError: a value that is not valid.
    """

    name: str
    policy: str = "Act"
    obs: str = "current_pred"
    horizon: int = 2
    error: str = "none"
    delay: int | None = None
    face_dropout: float | None = None
    face_dropout_length: float | None = None
    detector_rate: float | None = None
    corruption_seed: int | None = None
    prediction: str = "truth"
    expert: str = "reactive"
    title: str = ""

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.name):
            raise RequestError(
                f"name '{self.name}': must be letters, digits, '_', '-' and '.', for example "
                "current_pred_h2_delay3"
            )
        policy_entry(self.policy)
        require_choice("expert", self.expert, EXPERTS)
        require_choice("prediction", self.prediction, ("truth", *FORECASTS))
        if self.prediction != "truth" and (self.obs != "current_pred" or self.error != "none"):
            raise RequestError(
                f"prediction '{self.prediction}' goes with obs current_pred and without an error; "
                "leave the other out"
            )
        spec = ObservationSpec(self.obs, self.horizon, cameras=(), corruption=self._corruption())
        is_plain = self.prediction == "truth" and self.expert == "reactive"
        if self.name in PAPER and not (is_plain and arm_name(spec) == self.name):
            raise RequestError(
                f"the name '{self.name}' is that of an arm of the paper, with which it would be "
                "compared, and these settings are others; choose another name"
            )

    @property
    def shown_error(self) -> str:
        """The error as `bin/Train.py` is told it; forecasts travel as those of a predictor."""
        return "model" if self.prediction != "truth" else self.error

    @property
    def train_args(self) -> tuple[str, ...]:
        """What ``bin/Train.py`` is told of the arm."""
        told: dict[str, Any] = {"obs": self.obs}
        if self.obs == "current_pred":
            told["horizon"] = self.horizon
        if self.shown_error != "none":
            told["error"] = self.shown_error
        for name in _DETECTION:
            told[name] = getattr(self, name)
        return tuple(
            part
            for name, value in told.items()
            if value is not None
            for part in (f"--{name}", str(value))
        )

    @property
    def described(self) -> Arm:
        """The arm as tables and plots show it."""
        known = arm_of(self.name)
        return replace(known, label=self.title) if self.title else known

    def _corruption(self) -> Corruption:
        given = {name: getattr(self, name) for name in _DETECTION}
        given["seed"] = given.pop("corruption_seed")
        known = {name: value for name, value in given.items() if value is not None}
        return Corruption(error=self.shown_error, **known)


_DETECTION = ("delay", "face_dropout", "face_dropout_length", "detector_rate", "corruption_seed")
"""Settings of the corruption beside the error, named as ``bin/Train.py`` spells them."""

_TYPES = {
    "horizon": (int,),
    "delay": (int,),
    "corruption_seed": (int,),
    "face_dropout": (int, float),
    "face_dropout_length": (int, float),
    "detector_rate": (int, float),
}
"""Types of the values that are no words."""


def read_arms(path: Path) -> tuple[str, tuple[ArmLine, ...]]:
    """Read a file of arms.

    Returns:
        The name of the environment, and the arms in their order.

    Raises:
        RequestError: the file cannot be read, or something in it is not valid; names the line.
    """
    # Imported here: what needs no arms needs no YAML either.
    import yaml

    try:
        text = path.read_text(encoding="utf-8")
        content = yaml.safe_load(text)
    except OSError as error:
        raise RequestError(f"cannot read '{path}': {error.strerror or error}") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise RequestError(f"'{path}' is no YAML: {error}") from error
    if not isinstance(content, dict) or not isinstance(content.get("arms"), list):
        raise RequestError(f"'{path}' must hold 'env: FeedingEnv' and a list 'arms:'")
    lines = _line_numbers(yaml.compose(text, yaml.SafeLoader))
    try:
        for name in content:
            require_choice("entry", str(name), ("env", "arms"))
        env = require_choice("environment", str(content.get("env", "FeedingEnv")), ENVS)
    except RequestError as error:
        raise RequestError(f"'{path}': {error}") from None
    arms: list[ArmLine] = []
    for number, values in zip(lines, content["arms"], strict=True):
        try:
            arm = _to_arm(values)
            if arm.name in [other.name for other in arms]:
                raise RequestError(f"the name '{arm.name}' is there twice; choose another one")
        except RequestError as error:
            raise RequestError(f"'{path}', line {number}: {error}") from None
        arms.append(arm)
    if not arms:
        raise RequestError(f"'{path}' has no arms; give a line such as '- {{name: current, ...}}'")
    return env, tuple(arms)


def choose_arms(arms: Sequence[ArmLine], names: Sequence[str]) -> tuple[ArmLine, ...]:
    """Return the arms of these names, in the order of the file.

    Raises:
        RequestError: there is no such arm.
    """
    known = [arm.name for arm in arms]
    wanted = {require_choice("arm", name, known) for name in names}
    return tuple(arm for arm in arms if arm.name in wanted)


def _to_arm(values: Any) -> ArmLine:
    if not isinstance(values, dict):
        raise RequestError("an arm is a mapping such as {name: current, obs: current}")
    known = [field.name for field in fields(ArmLine)]
    for name, value in values.items():
        require_choice("key of an arm", str(name), known)
        wanted = _TYPES.get(name, (str,))
        if not isinstance(value, wanted) or isinstance(value, bool):
            what = {(str,): "text", (int,): "a whole number"}.get(wanted, "a number")
            raise RequestError(f"{name} must be {what}, not {value!r}")
    if "name" not in values:
        raise RequestError("the arm has no name; add 'name: ...'")
    return ArmLine(**values)


def _line_numbers(node: Any) -> list[int]:
    """Return in which line, from 1, each arm begins."""
    (arms,) = (value for key, value in node.value if key.value == "arms")
    return [arm.start_mark.line + 1 for arm in arms.value]
