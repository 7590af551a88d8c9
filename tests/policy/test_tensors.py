"""Files of tensors: headers that do not fit the data are refused before memory is taken."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from safetensors.torch import save, save_file

from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.tensors import read_tensors, require_alike, require_finite

TENSORS = {
    "a": torch.arange(6.0).reshape(2, 3),
    "b": torch.tensor([1, 2], dtype=torch.int64),
    "c": torch.tensor(True),
    "d": torch.zeros(0, 4, dtype=torch.bfloat16),
}


def packed(header: Any, data: bytes = b"", length: int | None = None) -> bytes:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return struct.pack("<Q", len(text) if length is None else length) + text + data


def entry(dtype: Any = "F32", shape: Any = (2,), offsets: Any = (0, 8)) -> dict[str, Any]:
    return {"dtype": dtype, "shape": shape, "data_offsets": offsets}


def test_what_is_written_is_read(tmp_path: Path) -> None:
    path = tmp_path / "a.safetensors"
    save_file(TENSORS, path, {"note": "text"})
    tensors, metadata = read_tensors(path)
    assert metadata == {"note": "text"}
    assert tensors.keys() == TENSORS.keys()
    for name, tensor in TENSORS.items():
        torch.testing.assert_close(tensors[name], tensor, rtol=0, atol=0)


CASES: list[tuple[bytes, str]] = [
    (b"", "does not fit into the file"),
    (b"text, not tensors, but long enough", "does not fit into the file"),
    (b"PK\3\4" + bytes(50), "pickled objects"),
    (b"\x80\x02}q\x00." + bytes(50), "pickled objects"),
    (packed({}, length=2**63), "does not fit into the file"),
    (packed(b"{" * 100), "its header is damaged"),
    (packed(b"[" * 100_000), "nested more than 64 deep"),
    (packed(b"\xff\xfe"), "utf-8"),
    (packed([1]), "must be an object"),
    (packed({"a": 3}, bytes(8)), "'a' is not described by"),
    (packed({"a": entry("F31")}, bytes(8)), "'a' has type 'F31'"),
    (packed({"a": entry(None)}, bytes(8)), "'a' has type 'None'"),
    (packed({"a": entry(shape=[-2])}, bytes(8)), "'a' has shape"),
    (packed({"a": entry(shape=[2**62, 4])}, bytes(8)), "'a' has shape"),
    (packed({"a": entry(shape="ab")}, bytes(8)), "'a' has shape"),
    (packed({"a": entry(shape=[2.0])}, bytes(8)), "'a' has shape"),
    (packed({"a": entry(shape=[10**9])}, bytes(8)), "does not fit into"),
    (packed({"a": entry(offsets=[8, 0])}, bytes(8)), "does not fit into"),
    (packed({"a": entry(offsets=[0])}, bytes(8)), "'a' has data_offsets"),
    (packed({"a": entry(offsets=[4, 12])}, bytes(12)), "begins at byte 4, not at 0"),
    (packed({"a": entry(), "b": entry(offsets=[4, 12])}, bytes(12)), "'b' begins at byte 4"),
    (packed({"a": entry()}, bytes(7)), "tensors of 8 bytes in 7"),
    (packed({"a": entry()}, bytes(9)), "tensors of 8 bytes in 9"),
    (packed({"__metadata__": {"x": 1}, "a": entry()}, bytes(8)), "no object of texts"),
]


@pytest.mark.parametrize(("content", "message"), CASES)
def test_a_malformed_file_is_refused_in_one_line(
    tmp_path: Path, content: bytes, message: str
) -> None:
    path = tmp_path / "a.safetensors"
    path.write_bytes(content)
    with pytest.raises(RequestError, match=message) as caught:
        read_tensors(path)
    assert str(caught.value).startswith(f"{path}: damaged or no safetensors file")
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < len(str(path)) + 300


def test_a_missing_file_and_a_folder_are_refused(tmp_path: Path) -> None:
    with pytest.raises(RequestError, match="no such file"):
        read_tensors(tmp_path / "nothing")
    with pytest.raises(RequestError, match="damaged or no safetensors file"):
        read_tensors(tmp_path)


def test_tensors_that_do_not_fit_are_named() -> None:
    wanted = {"a": torch.zeros(2), "b": torch.zeros(3)}
    require_alike(wanted, wanted, "file")
    cases: list[tuple[Callable[[dict[str, Any]], Any], str]] = [
        (lambda t: t.pop("a"), "file: tensor 'a' is missing"),
        (lambda t: t.update(c=torch.zeros(1)), "file: tensor 'c' is none of this network"),
        (lambda t: t.update(b=torch.zeros(4)), r"'b' is torch.float32 \(4,\), expected"),
        (lambda t: t.update(b=torch.zeros(3, dtype=torch.float64)), "'b' is torch.float64"),
    ]
    for change, message in cases:
        tensors: dict[str, Any] = dict(wanted)
        change(tensors)
        with pytest.raises(RequestError, match=message):
            require_alike(tensors, wanted, "file")
    require_finite({"a": torch.ones(3), "b": torch.tensor([1])}, "file")
    for value in (float("nan"), float("-inf")):
        with pytest.raises(RequestError, match="file: tensor 'b' holds NaN or infinity"):
            require_finite({"a": torch.ones(3), "b": torch.tensor([0.0, value])}, "file")


FUZZ = settings(
    max_examples=200,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)


@FUZZ
@given(
    changes=st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), max_size=3),
    share=st.one_of(st.just(1.0), st.floats(0, 1)),
)
def test_a_damaged_header_gives_tensors_or_one_line(
    tmp_path: Path, changes: list[tuple[float, int]], share: float
) -> None:
    data = bytearray(save(TENSORS))
    end = len(data) - sum(t.numel() * t.element_size() for t in TENSORS.values())
    for place, value in changes:
        data[int(place * end)] = value
    path = tmp_path / "fuzz.safetensors"
    path.write_bytes(bytes(data[: int(share * len(data))]))
    try:
        tensors, _ = read_tensors(path)
    except RequestError as error:
        assert "\n" not in str(error)  # noqa: PT017
        return
    assert sum(t.numel() * t.element_size() for t in tensors.values()) == len(data) - end
