"""Files of arms: the one that ships, and what is refused in a user's."""

from __future__ import annotations

from pathlib import Path

import pytest

from robo_manip_baselines.benchmark.conditions import ARMS, ArmLine, choose_arms, read_arms
from robo_manip_baselines.benchmark.presets import PRESETS
from robo_manip_baselines.benchmark.statistics.conditions import FURTHER, PREDICTION
from robo_manip_baselines.envs.mujoco.tasks.feeding.paper import PAPER
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.training.options import parse_options


def write(folder: Path, text: str) -> Path:
    path = folder / "mine.yaml"
    path.write_text(text)
    return path


def test_the_shipped_arms_are_the_papers_twelve_and_four_more() -> None:
    env, arms = read_arms(ARMS / "feeding.yaml")
    assert env == "FeedingEnv"
    assert [arm.name for arm in arms[:12]] == list(PAPER)
    assert [(arm.error, arm.prediction, arm.expert) for arm in arms[12:]] == [
        ("model", "truth", "reactive"),
        ("none", "persistence", "reactive"),
        ("none", "shuffled", "reactive"),
        ("none", "truth", "anticipatory"),
    ]
    assert {arm.described.group for arm in arms[12:]} == {FURTHER}


def test_the_arms_of_delay_are_a_whole_grid_and_share_their_runs_with_feeding() -> None:
    _, late = read_arms(ARMS / "delay.yaml")
    cells = [(arm.delay or 0, arm.described.horizon) for arm in late]
    assert cells == [(delay, horizon) for delay in (0, 4, 8) for horizon in (0, 2, 5)]
    assert [arm.described.delay for arm in late] == [delay for delay, _ in cells]
    _, feeding = read_arms(ARMS / "feeding.yaml")
    assert set(late[:3]) <= set(feeding)


def test_the_names_of_the_presets_arms_are_there() -> None:
    _, arms = read_arms(ARMS / "feeding.yaml")
    sizes = {name: len(choose_arms(arms, preset.arms)) for name, preset in PRESETS.items()}
    assert sizes == {"cpu": 0, "paper": 12, "smoke": 3}  # cpu names none: all of the file


@pytest.mark.parametrize(
    ("arm", "given"),
    [
        (ArmLine("baseline", obs="baseline"), "--obs baseline"),
        (ArmLine("current", obs="current", horizon=5), "--obs current"),
        (
            ArmLine("a", horizon=3, error="uniform", delay=2),
            "--obs current_pred --horizon 3 --error uniform --delay 2",
        ),
        (
            ArmLine("a", prediction="shuffled"),
            "--obs current_pred --horizon 2 --error model",
        ),
        (
            ArmLine("a", obs="current", face_dropout=0.1, face_dropout_length=4, detector_rate=10),
            "--obs current --face_dropout 0.1 --face_dropout_length 4 --detector_rate 10",
        ),
    ],
)
def test_an_arm_is_what_training_is_told(arm: ArmLine, given: str) -> None:
    assert " ".join(arm.train_args) == given
    options = parse_options(["Mlp", "--preset", "cpu", *arm.train_args], has_gpu=False)
    assert (options.obs, options.detection.error or "none") == (arm.obs, arm.shown_error)


def test_a_title_is_shown_and_names_speak_otherwise() -> None:
    assert ArmLine("current_pred_h4", horizon=4).described.label == "Prediction, 4 frames"
    assert ArmLine("current_pred_h4", horizon=4).described.group == PREDICTION
    assert ArmLine("mine", delay=2, title="My arm").described.label == "My arm"


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ("- {name: a, horizn: 3}", ["line 3", "horizn", "did you mean 'horizon'"]),
        ("- {name: a, horizon: three}", ["line 3", "horizon must be a whole number", "'three'"]),
        ("- {name: a, horizon: true}", ["line 3", "a whole number"]),
        ("- {name: a, horizon: 6}", ["line 3", "horizon 6", "1 to 5"]),
        ("- {name: a, error: unifrom}", ["line 3", "unifrom", "did you mean 'uniform'"]),
        ("- {name: a, obs: curent}", ["line 3", "did you mean 'current'"]),
        ("- {name: a, obs: current, error: uniform}", ["line 3", "forecasts"]),
        ("- {name: a, obs: baseline, delay: 2}", ["line 3", "baseline"]),
        ("- {name: a, policy: Atc}", ["line 3", "did you mean 'Act'"]),
        ("- {name: a, expert: quick}", ["line 3", "anticipatory, reactive"]),
        ("- {name: a, prediction: frozen}", ["line 3", "persistence, shuffled, truth"]),
        ("- {name: a, prediction: shuffled, error: uniform}", ["line 3", "without an error"]),
        ("- {name: a, prediction: shuffled, obs: current}", ["line 3", "current_pred"]),
        ("- {obs: current}", ["line 3", "no name"]),
        ("- {name: a b}", ["line 3", "'a b'", "letters"]),
        ("- {name: ../a}", ["line 3", "letters"]),
        ("- current", ["line 3", "mapping"]),
        ("- {name: a}\n  - {name: b}\n  - {name: a}", ["line 5", "'a' is there twice"]),
        ("- {name: current, obs: current_pred}", ["line 3", "'current'", "of the paper"]),
        (
            "- {name: current_pred_h2, expert: anticipatory}",
            ["line 3", "of the paper", "another name"],
        ),
        ("[]", ["no arms"]),
    ],
)
def test_what_is_wrong_is_said_in_one_line_with_its_number(
    lines: str, words: list[str], tmp_path: Path
) -> None:
    with pytest.raises(RequestError) as refused:
        read_arms(write(tmp_path, f"env: FeedingEnv\narms:\n  {lines}\n"))
    message = str(refused.value)
    assert "mine.yaml" in message
    assert "\n" not in message
    for word in words:
        assert word in message


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("arms: 3", "a list 'arms:'"),
        ("- {name: a}", "a list 'arms:'"),
        ("arms: [{name: a}", "no YAML"),
        ("env: FedingEnv\narms: [{name: a}]", "did you mean 'FeedingEnv'"),
        ("envs: FeedingEnv\narms: [{name: a}]", "did you mean 'env'"),
    ],
)
def test_a_file_of_another_shape_is_refused(text: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(RequestError, match=r"mine\.yaml") as refused:
        read_arms(write(tmp_path, text))
    assert words in str(refused.value)


def test_a_file_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RequestError, match=r"none\.yaml"):
        read_arms(tmp_path / "none.yaml")


def test_arms_are_chosen_in_the_order_of_the_file() -> None:
    _, arms = read_arms(ARMS / "feeding.yaml")
    chosen = choose_arms(arms, ["current_pred_h2", "baseline"])
    assert [arm.name for arm in chosen] == ["baseline", "current_pred_h2"]
    with pytest.raises(RequestError, match="did you mean 'current_pred_h1'"):
        choose_arms(arms, ["current_pred_h11"])
