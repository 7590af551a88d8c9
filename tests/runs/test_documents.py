"""Text documents from outside: read as their type, or refused in one line."""

from __future__ import annotations

import ast
import dataclasses
import json
import math
import os
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import pytest
import yaml
from annotated_types import Interval, Len
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from typing_extensions import is_typeddict

from face_prediction.dataset.manifest import ManifestDocument
from face_prediction.dataset.sequences import SequenceSettings
from face_prediction.evaluation.error_stats import PredictorErrorStats
from face_prediction.models.learned import CheckpointRecord
from face_prediction.models.settings import (
    ApproachSettings,
    CrossAttentionSettings,
    FusionSettings,
)
from face_prediction.training.trainer import StoredTrainer
from robo_manip_baselines.benchmark.conditions import ConditionConfig, ConditionsDocument
from robo_manip_baselines.benchmark.work_item import ItemManifest
from robo_manip_baselines.data.demonstrations import Split
from robo_manip_baselines.data.normalization import StoredNormalization
from robo_manip_baselines.observation import Corruption, ObservationSpec
from robo_manip_baselines.observation.error_stats import DEFAULT_STATS, StoredErrorStats
from robo_manip_baselines.policy.act.config import ActConfig
from robo_manip_baselines.policy.checkpoint import (
    CheckpointDocument,
    CheckpointOrigin,
    TrainerDocument,
)
from robo_manip_baselines.policy.mlp.config import MlpConfig
from robo_manip_baselines.policy.presets import ActionExecution, TrainSettings
from robo_manip_baselines.rollout.results import row_type
from robo_manip_baselines.runs import documents
from robo_manip_baselines.runs.checkpoints import CheckpointManifest
from robo_manip_baselines.runs.documents import (
    MAX_DEPTH,
    Schema,
    convert,
    load_yaml,
    parse_json,
    parse_settings,
    parse_yaml,
    read_bytes,
    read_json,
    read_json_lines,
    read_yaml,
)
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.metrics import MetricsLine

KINDS: dict[str, Any] = {
    kind.__name__: kind
    for kind in (
        *(ActConfig, ActionExecution, ApproachSettings, CheckpointDocument, CheckpointManifest),
        *(CheckpointOrigin, CheckpointRecord, ConditionConfig, ConditionsDocument, Corruption),
        *(CrossAttentionSettings, FusionSettings, ItemManifest, ManifestDocument, MetricsLine),
        *(MlpConfig, ObservationSpec, PredictorErrorStats, SequenceSettings),
        *(Split, StoredErrorStats, StoredNormalization, StoredTrainer, TrainSettings),
        TrainerDocument,
    )
} | {"row_type": row_type("FeedingEnv")}
"""Every type that documents are converted to."""

PLAIN = {"dict", "str", "cls", "kind", "part", "kinds", "type", "network", "tuple", "hints"}
"""Types of the standard library, and names of types that are chosen at run time."""

REPOSITORY = Path(__file__).parents[2]


def anything(*, allow_nan: bool = True) -> st.SearchStrategy[Any]:
    """Values that a document may hold anywhere."""
    return st.recursive(
        st.none()
        | st.booleans()
        | st.integers()
        | st.floats(allow_nan=allow_nan)
        | st.text(max_size=5),
        lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner),
        max_leaves=5,
    )


ANYTHING = anything()
COMPARABLE = anything(allow_nan=False)
"""NaN is not equal to itself."""


def plain(kind: Any) -> st.SearchStrategy[Any]:
    """Plain values that a type declares to be valid."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is Annotated:
        base, *marks = arguments
        interval: Any = next((mark for mark in marks if isinstance(mark, Interval)), None)
        length = next((mark for mark in marks if isinstance(mark, Len)), None)
        if interval is not None:
            return _numbers(base, interval)
        if length is not None:
            (item, *_) = typing.get_args(base)
            return st.lists(plain(item), min_size=length.min_length, max_size=3)
        return plain(base)
    if origin is Literal:
        return st.sampled_from(arguments)
    if dataclasses.is_dataclass(kind) or is_typeddict(kind):
        hints = typing.get_type_hints(kind, include_extras=True)
        names = [n for n, hint in hints.items() if typing.get_origin(hint) is not ClassVar]
        return st.fixed_dictionaries({n: plain(hints[n]) for n in names if hints[n] != ClassVar})
    if origin is tuple and arguments[-1] is not ...:
        return st.tuples(*map(plain, arguments)).map(list)
    if origin in (list, tuple):
        return st.lists(plain(arguments[0]), max_size=3)
    if origin is dict:
        return st.dictionaries(st.text(max_size=5), plain(arguments[1]), max_size=3)
    if arguments:  # a union
        return st.one_of(*map(plain, arguments))
    simple: dict[Any, st.SearchStrategy[Any]] = {
        bool: st.booleans(),
        int: st.integers(-(2**63), 2**63 - 1),
        float: st.floats(allow_nan=False, allow_infinity=False),
        str: st.text(max_size=10) | st.sampled_from(("current", "Act", "FeedingEnv", "none")),
        type(None): st.none(),
        Path: st.just("some/path"),
    }
    return simple.get(kind, COMPARABLE)


def _numbers(kind: Any, ends: Any) -> st.SearchStrategy[Any]:
    low = ends.ge if ends.ge is not None else ends.gt
    high = ends.le if ends.le is not None else ends.lt
    if kind is int:
        return st.integers(low, high)
    excluded: Any = {"exclude_min": ends.gt is not None, "exclude_max": ends.lt is not None}
    return st.floats(low, high, allow_nan=False, allow_infinity=False, **excluded)


def examples() -> dict[str, Any]:
    """Documents that are valid, small enough to be changed at every place."""
    stats = json.loads(DEFAULT_STATS.read_text())
    stats["residuals"] = [{**stats["residuals"][0], "values": stats["residuals"][0]["values"][:2]}]
    del stats["schema"], stats["version"]
    vectors = {"state_mean": [0.0], "state_std": [1.0], "action_mean": [0.0], "action_std": [2.0]}
    training = documents.as_json(dataclasses.asdict(TrainSettings(steps=3)))
    checkpoint = {
        **{"policy": "Mlp", "env": "FeedingEnv", "control_period": 0.02, "xml_hash": "ab"},
        **{"step": 3, "train_seed": 0, "dataset": {"episodes": 3}, "versions": {"torch": "2"}},
        **{"config": {}, "action_names": ["a"], "split": {"train": [1], "validation": []}},
        "sizes": {"state": 1, "action": 1, "cameras": 0, "image": [480, 640]},
        **{"spec": {}, "acting": {}, "settings": training},
    }
    return {
        "StoredErrorStats": stats,
        "PredictorErrorStats": stats,
        "StoredNormalization": vectors,
        "CheckpointDocument": checkpoint,
        "TrainSettings": training,
        "ObservationSpec": {**ObservationSpec("current").to_json(), "corruption": {"delay": 3}},
        "ConditionsDocument": {"conditions": [{"name": "a"}], "presets": {"cpu": ["a"]}},
    }


EXAMPLES = examples()
del EXAMPLES["ObservationSpec"]["error"]


def require_one_line(error: RequestError) -> None:
    message = str(error)
    assert "\n" not in message
    assert len(message) < 3000


@pytest.mark.parametrize("name", KINDS)
def test_declared_documents_read_back(name: str) -> None:
    """Declared values are read, or break a promise between fields; nothing else happens."""
    kind = KINDS[name]

    @settings(max_examples=12, deadline=None, suppress_health_check=list(HealthCheck))
    @given(plain(kind))
    def read(value: Any) -> None:
        value = json.loads(json.dumps(documents.as_json(value), default=plain_value))
        try:
            found = convert(value, kind, "'file'")
        except RequestError as error:
            require_one_line(error)
            return
        again = json.loads(json.dumps(found, default=plain_value))
        assert convert(again, kind, "'file'") == found

    read()


def plain_value(value: Any) -> Any:
    """Return what JSON can hold of an object within a document."""
    return dataclasses.asdict(value) if dataclasses.is_dataclass(value) else str(value)  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("name", EXAMPLES)
def test_changed_documents_are_read_or_refused(name: str) -> None:
    kind, example = KINDS[name], EXAMPLES[name]
    convert(example, kind, "'file'")

    @settings(max_examples=40, deadline=None, suppress_health_check=list(HealthCheck))
    @given(st.data())
    def read(data: st.DataObject) -> None:
        changed = json.loads(json.dumps(example))
        place = changed
        while True:
            keys = list(place) if isinstance(place, dict) else list(range(len(place)))
            key = data.draw(st.sampled_from(keys))
            inner = place[key]
            if not (isinstance(inner, (dict, list)) and inner and data.draw(st.booleans())):
                break
            place = inner
        action = data.draw(st.sampled_from(("replace", "remove", "add")))
        if action == "remove":
            del place[key]
        elif action == "add" and isinstance(place, dict):
            place[data.draw(st.text(max_size=5))] = data.draw(ANYTHING)
        else:
            place[key] = data.draw(ANYTHING)
        try:
            convert(changed, kind, "'file'")
        except RequestError as error:
            require_one_line(error)

    read()


@settings(max_examples=150, deadline=None)
@given(
    st.binary(max_size=40)
    | st.text(alphabet='{}[]":,\\0123456789eE.-+ntrue&*!? \n#|>%', max_size=40)
)
def test_any_bytes_are_read_or_refused(
    tmp_path_factory: pytest.TempPathFactory, content: bytes | str
) -> None:
    path = tmp_path_factory.getbasetemp() / "document"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    for read in (read_json, read_yaml, lambda path: list(read_json_lines(path))):
        try:
            read(path)
        except RequestError as error:
            require_one_line(error)


DEEP = 100_000


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("[" * DEEP, "nested more than 64 deep"),
        ('{"a":' * DEEP, "nested more than 64 deep"),
        ("NaN", "NaN is no finite number"),
        ("[-Infinity]", "-Infinity is no finite number"),
        ("1e999", "1e999 is no finite number"),
        ("9" * 5000, "is an integer of more than 64 bits"),
        ("[9223372036854775808]", "9223372036854775808 is an integer of more than 64 bits"),
        ('{"a": 1, "a": 2}', "'a' is there twice"),
        (r'"\ud800"', "half of a surrogate pair"),
        ('"\ud800"', "half of a surrogate pair"),
        ('{"a": 1', "is damaged: "),
        ("{" + ",".join(f'"{i}":1' for i in range(10_001)) + "}", "more than 10000 names"),
        ("", "is damaged: "),
        ("[1] 2", "is damaged: "),
        ('"a\nb"', "is damaged: "),
    ],
)
def test_json_that_is_refused(text: str, problem: str) -> None:
    with pytest.raises(RequestError, match=r"^'file'") as caught:
        parse_json(text, "'file'")
    assert problem in str(caught.value)
    assert len(str(caught.value)) < 200


def test_json_that_is_read() -> None:
    text = '{"a": [1, -2.5e3, true, null, "\\\\\\"[{\\ud83d\\ude00", 9223372036854775807]}'
    assert parse_json(text, "'file'") == json.loads(text)
    assert parse_json("[" * MAX_DEPTH + "]" * MAX_DEPTH, "'file'")
    assert parse_json('"' + "[" * 1000 + '"', "'file'") == "[" * 1000


def test_settings_of_a_command_line() -> None:
    texts = ["steps=200", "rate=1e-4", "augment=true", "name=wide", "size=48x64", "empty=", "a=b=c"]
    assert parse_settings(texts, "--set") == {
        "steps": 200,
        "rate": 1e-4,
        "augment": True,
        "name": "wide",
        "size": "48x64",
        "empty": "",
        "a": "b=c",
    }
    for text in ("steps", "=3", ""):
        with pytest.raises(RequestError, match=f"^--set '{text}': must be NAME=VALUE"):
            parse_settings([text], "--set")


def test_a_large_text_is_refused_before_it_is_parsed() -> None:
    with pytest.raises(RequestError, match="too large: a text of its kind has 16 MiB or less"):
        parse_json(" " * (documents.MAX_BYTES + 1), "'file'")


BOMB = "a: &a [x, x]\n" + "".join(
    f"b{i}: &b{i} [*{'b' * (i > 0)}{i - 1 if i else 'a'}]\n" for i in range(9)
)


@pytest.fixture(params=["libyaml", "python"])
def loader(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both parsers of PyYAML; the faster one is not there everywhere."""
    if request.param == "python":
        monkeypatch.delattr(yaml, "CSafeLoader", raising=False)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("[" * DEEP, "line 1: nested more than 64 deep"),
        ("- " * DEEP, "line 1: nested more than 64 deep"),
        ("a: 1\nb: {a: 1, a: 2}", "line 2: 'a' is there twice"),
        (BOMB, "line 1: anchors and aliases are not read"),
        ("a: *b", "line 1: anchors and aliases are not read"),
        ("<<: {a: 1}", "'<<' is not read"),
        ("a: !!binary aGVsbG8=", "tags are not read"),
        ("a: !!set {b}", "tags are not read"),
        ("!!python/object/apply:os.system [x]", "tags are not read"),
        ("? [a]\n: b", "a name must be text"),
        ("a: " + "9" * 5000, "is an integer of more than 64 bits"),
        ("a: .nan", "is no finite number"),
        ("a: -.inf", "is no finite number"),
        ("--- a\n--- b", "more than one document"),
        ("a: [", "is no YAML"),
        ("a\x00", "is no YAML"),
        ('"\\UFFFFFFFF"', "is no YAML"),
        ("%YAML " + "9" * 5000 + ".1\n---\na", "is no YAML"),
    ],
)
@pytest.mark.usefixtures("loader")
def test_yaml_that_is_refused(text: str, problem: str) -> None:
    with pytest.raises(RequestError, match=r"^'file'") as caught:
        parse_yaml(text, "'file'")
    assert problem in str(caught.value)
    assert len(str(caught.value)) < 200


@pytest.mark.usefixtures("loader")
def test_yaml_that_is_read() -> None:
    text = "a: 1e-4\nb: [1, -2, yes, no, true, ~, 2026-01-31, '3', 1_0, 0x1, .5]\n1: {c: }\n"
    value, lines = parse_yaml(text, "'file'")
    assert value == {
        "a": 1e-4,
        "b": [1, -2, "yes", "no", True, None, "2026-01-31", "3", "1_0", "0x1", 0.5],
        "1": {"c": None},
    }
    assert (lines["b", 3], lines["1", "c"]) == (2, 3)


def test_what_yaml_writes_is_read(tmp_path: Path) -> None:
    values = {"a": 1e-5, "b": "yes", "c": ["1", 1, 1.5, None, True, "2026-01-31"], "d": "é$\n"}
    (tmp_path / "a.yaml").write_text(yaml.safe_dump(values, allow_unicode=True))
    assert load_yaml(tmp_path / "a.yaml").value == values
    (tmp_path / "empty.yaml").write_text("# nothing\n")
    assert read_yaml(tmp_path / "empty.yaml") == {}


def make_pipe(path: Path) -> None:
    os.mkfifo(path)


@pytest.mark.parametrize(
    ("make", "problem"),
    [
        (Path.mkdir, "a folder, pipe or device"),
        (make_pipe, "a folder, pipe or device"),
        (lambda path: path.symlink_to("/dev/zero"), "a folder, pipe or device"),
        (lambda path: None, "No such file"),
        (lambda path: path.symlink_to(path), "symbolic links"),
        (lambda path: path.write_bytes(b'"\xff"'), "no UTF-8 at byte 1"),
        (lambda path: path.write_bytes(b" " * (1 << 20 | 1)), "too large"),
    ],
)
def test_files_that_are_refused(
    tmp_path: Path, make: Callable[[Path], object], problem: str
) -> None:
    path = tmp_path / "document"
    make(path)
    for read in (lambda path: read_json(path, limit=1 << 20), read_yaml):
        with pytest.raises(RequestError, match=str(path)) as caught:
            read(path)
        assert problem in str(caught.value)


def test_a_path_with_a_null_character() -> None:
    with pytest.raises(RequestError, match="null"):
        read_bytes(Path("a\0b"))


def test_lines_that_were_cut_off_are_left_out(tmp_path: Path) -> None:
    path = tmp_path / "lines"
    path.write_bytes('{"a": 1}\n"é"\n"é'.encode()[:-1])
    assert list(read_json_lines(path)) == [(1, '{"a": 1}'), (2, '"é"')]


@dataclasses.dataclass(frozen=True)
class Inner:
    number: Annotated[int, Interval(ge=1, le=5)]
    values: tuple[float, ...] = ()
    path: Path | None = None


@dataclasses.dataclass(frozen=True)
class Outer:
    inner: Inner
    more: dict[str, Inner]
    choice: Literal["u", "v"] = "u"

    def __post_init__(self) -> None:
        if self.choice == "v":
            raise RequestError("choice v: not today; valid: u")


GOOD: dict[str, Any] = {
    "inner": {"number": 1, "values": [1, 2.5], "path": "a"},
    "more": {"k": {"number": 2}},
}


def test_types_are_converted() -> None:
    found = convert(GOOD, Outer, "'file'")
    assert found == Outer(Inner(1, (1.0, 2.5), Path("a")), {"k": Inner(2)})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"inner": 3}, "inner: must be an object, not 3"),
        ({"inner": {"number": "1"}}, "inner.number: must be a whole number, not '1'"),
        ({"inner": {"number": True}}, "inner.number: must be a whole number, not true"),
        ({"inner": {"number": 1.0}}, "inner.number: must be a whole number, not 1.0"),
        ({"inner": {"number": 9}}, "inner.number 9: must be 5 or less"),
        ({"inner": {"number": 1, "values": 5}}, "inner.values: must be a list, not 5"),
        (
            {"inner": {"number": 1, "values": [0, "a"]}},
            "inner.values[1]: must be a number, not 'a'",
        ),
        ({"inner": {}}, "inner.number: is missing"),
        (
            {"more": {"k": {"number": 1, "valeus": []}}},
            "more.k: unknown name 'valeus' (did you mean 'values'?); valid: number, values, path",
        ),
        ({"choice": "w"}, "choice 'w': unknown; valid: 'u' or 'v'"),
        ({"choice": "v"}, "choice v: not today; valid: u"),
        ({"x" * 10**6: 1}, f"unknown name '{'x' * 80}…'; valid: inner, more, choice"),
        ({"choice": "x" * 10**6}, f"choice '{'x' * 80}…': unknown; valid: 'u' or 'v'"),
    ],
)
def test_the_first_problem_is_named(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(RequestError) as caught:
        convert(GOOD | changes, Outer, "'file'")
    assert str(caught.value) == f"'file': {message}"


def test_problems_of_yaml_have_their_line(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_text("more: {}\ninner:\n  values:\n  - 1\n  - x\n  number: 3\n")
    with pytest.raises(RequestError, match=r"a\.yaml', line 5: inner\.values\[1\]: must be"):
        read_yaml(path, Outer)


def test_complete_documents_lack_no_default() -> None:
    with pytest.raises(RequestError, match=r"'file': inner\.values: is missing"):
        convert({"inner": {"number": 1}, "more": {}}, Outer, "'file'", complete=True)


@pytest.mark.parametrize("version", [2, "1", None, 1.0, True])
def test_other_schemas_are_refused(version: object) -> None:
    schema = Schema("kind", 1)
    assert schema.without({"schema": "kind", "version": 1, "a": 2}, "'file'") == {"a": 2}
    with pytest.raises(RequestError, match="'file': schema 'kind' version"):
        schema.without({"schema": "kind", "version": version}, "'file'")


def test_every_kind_of_document_is_tried_here() -> None:
    """Types given to the reader, in the code of both packages."""
    given: set[str] = set()
    for package in ("robo_manip_baselines", "face_prediction"):
        for path in (REPOSITORY / package).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if (
                    isinstance(node, ast.Call)
                    and getattr(node.func, "id", "") in ("convert", "read_json", "read_yaml")
                    and path.name != "documents.py"
                ):
                    kinds = [*node.args[1:2], *(k.value for k in node.keywords if k.arg == "kind")]
                    found = {
                        n.id for kind in kinds for n in ast.walk(kind) if isinstance(n, ast.Name)
                    }
                    given |= {name for name in found if name[0].isupper() or name in KINDS}
    lost = given - KINDS.keys() - {"Any"}
    assert not lost
    assert len(given) > 10


def test_numbers_are_finite_after_conversion() -> None:
    for value in (math.nan, math.inf):
        with pytest.raises(RequestError, match="finite"):
            convert({"number": 1, "values": [value]}, Inner, "'file'")
