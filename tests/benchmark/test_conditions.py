"""Files of conditions: those that ship, and what is refused in a user's."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from robo_manip_baselines.benchmark.conditions import (
    CONDITIONS,
    ConditionConfig,
    DrawnPeople,
    find_references,
    read_conditions,
)
from robo_manip_baselines.benchmark.plan import PRESETS
from robo_manip_baselines.envs.mujoco.tasks.registry import task_entry
from robo_manip_baselines.observation import Corruption, ObservationSpec
from robo_manip_baselines.runs.errors import RequestError


def write(folder: Path, text: str) -> Path:
    path = folder / "mine.yaml"
    path.write_text(text)
    return path


def condition(**values: object) -> ConditionConfig:
    return ConditionConfig.from_yaml(values)


def test_the_shipped_conditions_are_the_papers_twelve_and_four_more() -> None:
    file = read_conditions(CONDITIONS / "feeding.yaml")
    assert file.env == "FeedingEnv"
    published = task_entry("FeedingEnv").load_study().published
    assert [c.name for c in file.conditions[:12]] == list(published)
    assert [c.name for c in file.conditions[:12]] == [c.spec.name for c in file.conditions[:12]]
    shown = [(c.spec.corruption.error, c.spec.corruption.prediction) for c in file.conditions]
    assert [(*pair, c.expert) for pair, c in zip(shown, file.conditions, strict=True)][12:] == [
        ("model", "truth", "reactive"),
        ("none", "persistence", "reactive"),
        ("none", "shuffled", "reactive"),
        ("none", "truth", "anticipatory"),
    ]


def test_the_conditions_of_delay_are_a_whole_grid_and_share_their_runs_with_feeding() -> None:
    late = read_conditions(CONDITIONS / "delay.yaml").conditions
    cells = [(c.spec.corruption.delay, c.spec.frames - 1) for c in late]
    assert cells == [(delay, horizon) for delay in (0, 4, 8) for horizon in (0, 2, 5)]
    assert set(late[:3]) <= set(read_conditions(CONDITIONS / "feeding.yaml").conditions)


def test_the_conditions_of_foresight_policies_are_a_grid_and_one_control() -> None:
    file = read_conditions(CONDITIONS / "foresight_policies.yaml")
    assert (file.headline, file.people) == ("success_strict", DrawnPeople("train", "test"))
    *grid, control = file.conditions
    assert {c.expert for c in file.conditions} == {"servo"}
    cells: dict[tuple[str, int], list[str]] = {}
    for c in grid:
        spec, corruption = c.spec, c.spec.corruption
        assert spec.relative == (spec.obs != "current")
        shown = spec.obs
        if spec.obs == "current_pred":
            shown = "residual" if corruption.error == "model" else corruption.prediction
            assert spec.horizon == corruption.delay + 12
        cell = c.motion, corruption.delay
        cells.setdefault(cell, []).append(shown)
        assert c.name == f"{c.motion}_delay{corruption.delay}_{shown}"
    shown_of_each = ["current", "history", "truth", "persistence", "autoregression", "residual"]
    assert cells == {
        (motion, delay): shown_of_each
        for motion in ("dyskinetic", "sway", "recorded")
        for delay in (4, 8)
    }
    (like,) = (c for c in grid if c.name == "dyskinetic_delay4_truth")
    assert control == replace(
        like, name="dyskinetic_delay4_truth_absolute", spec=replace(like.spec, relative=False)
    )
    assert len(file.choose(file.presets["smoke"])) == 3


def test_what_a_condition_is_compared_with() -> None:
    file = read_conditions(CONDITIONS / "foresight_policies.yaml")
    assert file.compare_within == ("motion", "delay")
    found = find_references(file.conditions, file.compare_within)
    assert len(found) == len(file.conditions)
    for c in file.conditions:
        assert found[c.name] == f"{c.motion}_delay{c.spec.corruption.delay}_current"
    # Without `current`, the first one.
    some = file.choose(["sway_delay4_truth", "sway_delay4_history", "sway_delay8_current"])
    assert find_references(some, ("motion", "delay")) == {
        "sway_delay4_history": "sway_delay4_history",
        "sway_delay4_truth": "sway_delay4_history",
        "sway_delay8_current": "sway_delay8_current",
    }
    # Keys of the condition, of the observation and of its corruption.
    assert set(find_references(file.conditions, ("policy",)).values()) == {file.conditions[0].name}
    by_horizon = find_references(file.conditions, ("horizon", "prediction"))
    assert by_horizon["sway_delay8_truth"] == "dyskinetic_delay8_truth"


def test_the_conditions_of_foresight_horizons_are_a_grid_of_true_futures() -> None:
    file = read_conditions(CONDITIONS / "foresight_horizons.yaml")
    assert (file.headline, file.people) == ("success_strict", DrawnPeople("train", "test"))
    assert {(c.policy, c.expert) for c in file.conditions} == {("Mlp", "servo")}
    cells = []
    for c in file.conditions:
        corruption = c.spec.corruption
        assert (corruption.error, corruption.prediction) == ("none", "truth")
        horizon = c.spec.frames - 1
        shown = f"h{horizon}" if horizon else "current"
        assert c.name == f"{c.motion}_delay{corruption.delay}_{shown}"
        cells.append((c.motion, corruption.delay, horizon))
    assert cells == [
        (motion, delay, horizon)
        for motion in ("dyskinetic", "sway", "recorded")
        for delay in (0, 4, 8)
        for horizon in (0, 2, 5, 8, 12, 16, 24)
    ]
    assert len(file.choose(file.presets["smoke"])) == 3


def test_the_conditions_of_the_presets_are_there() -> None:
    file = read_conditions(CONDITIONS / "feeding.yaml")
    assert {name: len(file.choose(names)) for name, names in file.presets.items()} == {
        "cpu_images": 4,
        "paper": 12,
        "smoke": 3,
    }
    assert set(file.presets) <= set(PRESETS)
    assert read_conditions(CONDITIONS / "delay.yaml").presets == {}


@pytest.mark.parametrize(
    ("given", "spec"),
    [
        (condition(name="baseline", obs="baseline"), {"obs": "baseline"}),
        (condition(name="current", obs="current"), {"obs": "current"}),
        (
            condition(name="a", horizon=3, error="uniform", delay=2),
            {"horizon": 3, "corruption": Corruption("uniform", delay=2)},
        ),
        (
            condition(name="a", prediction="shuffled", motion="sway", delay=4, relative=True),
            {"corruption": Corruption(prediction="shuffled", delay=4), "relative": True},
        ),
        (condition(name="a", prediction="model"), {"corruption": Corruption("model")}),
        (condition(name="a", prediction="truth"), {}),
        (
            condition(
                name="a",
                obs="current",
                face_dropout=0.1,
                face_dropout_length=4,
                detector_rate=10,
                corruption_seed=7,
            ),
            {
                "obs": "current",
                "corruption": Corruption(
                    face_dropout=0.1, face_dropout_length=4, detector_rate=10, seed=7
                ),
            },
        ),
    ],
)
def test_a_condition_is_what_its_policy_observes(
    given: ConditionConfig, spec: dict[str, object]
) -> None:
    preset = ObservationSpec("current_pred", cameras=(), object_pose=True)
    assert given.observation(preset) == replace(preset, **spec)  # type: ignore[arg-type]


def test_the_default_expert_is_the_first_of_the_task() -> None:
    assert condition(name="a").for_task(task_entry("FeedingEnv")).expert == "reactive"


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ("dyskinetic", "dyskinetic"),
        ({"name": "sway", "amplitude": 0.03}, "sway:amplitude=0.03"),
        (["recorded", "tremor"], "recorded+tremor"),
    ],
)
def test_a_motion_is_a_name_a_mapping_or_a_list(given: object, text: str) -> None:
    assert condition(name="a", motion=given).motion == text
    assert condition(name="a").motion == "recorded"


@pytest.mark.parametrize(
    ("lines", "words"),
    [
        ("- {name: a, horizn: 3}", ["line 3", "horizn", "did you mean 'horizon'"]),
        ("- {name: a, horizon: three}", ["line 3", "horizon: must be a whole number", "'three'"]),
        ("- {name: a, horizon: true}", ["line 3", "a whole number"]),
        ("- {name: a, horizon: 25}", ["line 3", "horizon 25", "24 or less"]),
        ("- {name: a, error: unifrom}", ["line 3", "unifrom", "did you mean 'uniform'"]),
        ("- {name: a, obs: curent}", ["line 3", "did you mean 'current'"]),
        ("- {name: a, obs: current, error: uniform}", ["line 3", "forecasts"]),
        ("- {name: a, obs: history, error: uniform}", ["line 3", "'history' shows none"]),
        ("- {name: a, obs: baseline, delay: 2}", ["line 3", "baseline"]),
        ("- {name: a, policy: Atc}", ["line 3", "did you mean 'Act'"]),
        ("- {name: a, expert: quick}", ["line 3", "anticipatory, reactive"]),
        ("- {name: a, prediction: frozen}", ["line 3", "residual, shuffled, truth"]),
        ("- {name: a, prediction: 3}", ["line 3", "prediction '3'"]),
        ("- {name: a, prediction: shuffled, error: uniform}", ["line 3", "without an error"]),
        ("- {name: a, prediction: model, error: uniform}", ["line 3", "without an error"]),
        ("- {name: a, prediction: shuffled, obs: current}", ["line 3", "current_pred"]),
        ("- {name: a, motion: swai}", ["line 3", "did you mean 'sway'"]),
        ("- {name: a, motion: {amplitude: 1}}", ["line 3", "no name", "sway"]),
        ("- {name: a, motion: sway, prediction: model}", ["line 3", "'sway'", "recorded motion"]),
        ("- {name: a, motion: sway, error: model}", ["line 3", "recorded motion"]),
        ("- {name: current, obs: current, motion: sway}", ["line 3", "of the paper"]),
        ("- {obs: current}", ["line 3", "no name"]),
        ("- {name: a b}", ["line 3", "'a b'", "letters"]),
        ("- {name: ../a}", ["line 3", "letters"]),
        ("- current", ["line 3", "must be an object"]),
        ("- {name: a}\n  - {name: b}\n  - {name: a}", ["line 5", "'a' is there twice"]),
        ("- {name: current, obs: current_pred}", ["line 3", "'current'", "of the paper"]),
        (
            "- {name: current_pred_h2, expert: anticipatory}",
            ["line 3", "of the paper", "another name"],
        ),
        ('- {name: a, title: "a\\nb"}', ["line 3", "title 'a\\nb': must be one line"]),
        ("- {name: a, title: 3}", ["line 3", "title: must be text, not 3"]),
        ("- {name: a, name: b}", ["line 3", "'name' is there twice"]),
        (
            "- {name: a, horizon: 2026-01-31}",
            ["line 3", "must be a whole number, not '2026-01-31'"],
        ),
        ("- {name: a, delay: " + "9" * 5000 + "}", ["line 3", "of more than 64 bits"]),
        ("- {name: a, detector_rate: .nan}", ["line 3", "no finite number"]),
        ("- &a {name: a, title: *a}", ["line 3", "anchors and aliases are not read"]),
        ("- " * 100_000, ["line 3", "nested more than 64 deep"]),
        ("- [[[a]]]", ["line 3", "must be an object, not a list of 1"]),
        ("[]", ["conditions: must have 1 elements or more"]),
    ],
)
def test_what_is_wrong_is_said_in_one_line_with_its_number(
    lines: str, words: list[str], tmp_path: Path
) -> None:
    with pytest.raises(RequestError) as refused:
        read_conditions(write(tmp_path, f"env: FeedingEnv\nconditions:\n  {lines}\n"))
    message = str(refused.value)
    assert "mine.yaml" in message
    assert "\n" not in message
    for word in words:
        assert word in message


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("conditions: 3", "conditions: must be a list, not 3"),
        ("- {name: a}", "must be an object, not a list of 1"),
        ("conditions: [{name: a}", "no YAML"),
        ("env: FedingEnv\nconditions: [{name: a}]", "did you mean 'FeedingEnv'"),
        ("envs: FeedingEnv\nconditions: [{name: a}]", "did you mean 'env'"),
        ("presets: {smoke: [b]}\nconditions: [{name: a}]", "unknown condition 'b'"),
        ("presets: {smoke: b}\nconditions: [{name: a}]", "presets.smoke: must be a list, not 'b'"),
        ("presets: [b]\nconditions: [{name: a}]", "presets: must be an object"),
        ("headline: strict\nconditions: [{name: a}]", "unknown headline 'strict'"),
        ("headline: 3\nconditions: [{name: a}]", "headline: must be text"),
        ("compare_within: [speed]\nconditions: [{name: a}]", "key to compare within 'speed'"),
        ("people: test\nconditions: [{name: a}]", "people: must be an object"),
        (
            "people: {evaluation: tests}\nconditions: [{name: a}]",
            "unknown people of evaluation 'tests'",
        ),
        ("people: {training: train}\nconditions: [{name: a}]", "'training'"),
        (
            "people: {evaluation: test}\nconditions: [{name: current, obs: current}]",
            "'current' is that of a condition of the paper",
        ),
        ("presets: {paper: published}\nconditions: [{name: a}]", "unknown condition 'baseline'"),
    ],
)
def test_a_file_of_another_shape_is_refused(text: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(RequestError, match=r"mine\.yaml") as refused:
        read_conditions(write(tmp_path, text))
    assert words in str(refused.value)


def test_an_end_point_and_people_are_declared(tmp_path: Path) -> None:
    plain = read_conditions(write(tmp_path, "conditions: [{name: a}]"))
    assert (plain.headline, bool(plain.people)) == ("success", False)
    text = "headline: success_strict\npeople: {demonstrations: train, evaluation: test}\n"
    file = read_conditions(write(tmp_path, f"{text}conditions: [{{name: a}}]"))
    assert file.headline == "success_strict"
    assert (file.people.demonstrations, file.people.evaluation) == ("train", "test")
    assert str(file.people) == "train in demonstrations, test in evaluation"
    for name in ("feeding", "delay"):
        assert read_conditions(CONDITIONS / f"{name}.yaml").headline == "success"


def test_a_file_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RequestError, match=r"none\.yaml"):
        read_conditions(tmp_path / "none.yaml")


def test_conditions_are_chosen_in_the_order_of_the_file() -> None:
    file = read_conditions(CONDITIONS / "feeding.yaml")
    chosen = file.choose(["current_pred_h2", "baseline"])
    assert [c.name for c in chosen] == ["baseline", "current_pred_h2"]
    with pytest.raises(RequestError, match="did you mean 'current_pred_h1'"):
        file.choose(["current_pred_h11"])


def test_a_file_of_an_earlier_release_is_read_with_a_note(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO")
    file = read_conditions(
        write(tmp_path, "env: FeedingEnv\narms: [{name: a}, {name: b, delay: 3}]")
    )
    assert [c.name for c in file.conditions] == ["a", "b"]
    assert "'arms:' is called 'conditions:' now" in caplog.text
