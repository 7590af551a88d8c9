"""Files of arrays: nothing is read that was not declared and checked before."""

from __future__ import annotations

import hashlib
import io
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from robo_manip_baselines.runs import npz
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.npz import (
    ArrayType,
    FileType,
    add_array,
    read_json_array,
    read_npz,
    write_npz,
)

KIND = FileType(
    "test",
    1,
    {
        "time": ArrayType("f", ("N",), "increasing"),
        "place": ArrayType("f", ("N", 3)),
        "raw": ArrayType("f", ("N",), "any", is_optional=True),
        "name": ArrayType("U", ("R",)),
        "is_good": ArrayType("b", ("N",)),
        "metadata": ArrayType("U"),
    },
    limits={"N": 1000, "R": 10},
)


def content(**changes: Any) -> dict[str, Any]:
    arrays = {
        "schema": np.array("test"),
        "version": np.array(1),
        "time": np.arange(5) / 30,
        "place": np.arange(15, dtype=np.float32).reshape(5, 3),
        "name": np.array(["Ann", "Zoë"]),
        "is_good": np.array([True, False, True, True, False]),
        "metadata": np.array('{"a": 1}'),
        **changes,
    }
    return {name: value for name, value in arrays.items() if value is not None}


def save(path: Path, **changes: Any) -> Path:
    np.savez(path, **content(**changes))
    return path


def member(header: str, data: bytes = b"") -> bytes:
    """Bytes of a .npy file with any header."""
    return b"\x93NUMPY\1\0" + struct.pack("<H", len(header)) + header.encode() + data


def zipped(path: Path, method: int = zipfile.ZIP_DEFLATED, **members: bytes) -> Path:
    """Write the usual file with some members replaced by these bytes."""
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, value in content().items():
            stream = io.BytesIO()
            np.save(stream, value)
            archive.writestr(f"{name}.npy", members.pop(name, stream.getvalue()))
        for name, data in members.items():
            archive.writestr(f"{name}.npy", data)
    return path


def patched(path: Path, name: bytes, offset: int, value: bytes) -> Path:
    """Change a field of a member's entry in the directory at the end of a zip file."""
    data = bytearray(path.read_bytes())
    start = data.rindex(b"PK\1\2", 0, data.rindex(name)) + offset
    data[start : start + len(value)] = value
    path.write_bytes(bytes(data))
    return path


@pytest.mark.parametrize("order", ["C", "F"])
@pytest.mark.parametrize("byte_order", ["<", ">"])
def test_what_is_written_is_read(tmp_path: Path, order: Any, byte_order: str) -> None:
    place = np.arange(15, dtype=f"{byte_order}f4").reshape(5, 3)
    arrays = content(place=np.asarray(place, order=order))
    path = tmp_path / "a.npz"
    write_npz(path, arrays)
    read = read_npz(path, KIND)
    assert list(read) == ["time", "place", "name", "is_good", "metadata"]
    for name, array in read.items():
        np.testing.assert_array_equal(array, arrays[name])
        assert array.dtype.isnative
    assert read_json_array(read, "metadata", path) == {"a": 1}


HEADER = "{'descr': '%s', 'fortran_order': False, 'shape': %s, }\n"
HUGE = "(10000000000000,)"  # 73 TiB of float64

CASES: list[tuple[Callable[[Path], Any], str]] = [
    (lambda p: p.write_text("hello\n" * 100), "does not begin as a zip archive does"),
    (lambda p: p.write_bytes(b""), "does not begin as a zip archive does"),
    (lambda p: p.write_bytes(b"PK\3\4 and no more"), "damaged or not an .npz file"),
    (lambda p: p.write_bytes(member(HEADER % ("<f8", "(3,)"), bytes(24))), "a single array"),
    (lambda p: p.mkdir(), "no such file"),
    (lambda p: zipped(p, zipfile.ZIP_LZMA), "compressed by method 14, not deflate"),
    (lambda p: zipped(p, zipfile.ZIP_BZIP2), "compressed by method 12, not deflate"),
    (lambda p: patched(save(p), b"place.npy", 8, b"\1\0"), "'place' is encrypted"),
    (lambda p: patched(save(p), b"place.npy", 10, b"\x63\0"), "compressed by method 99"),
    (lambda p: zipped(p, place=member(HEADER % ("<f8", HUGE))), "'place' declares 80000000000000"),
    (lambda p: zipped(p, time=member(HEADER % ("<f8", "(5,)"), bytes(39))), "'time' declares 40"),
    (lambda p: zipped(p, time=member(HEADER % ("|O", "(5,)"), bytes(40))), "Python objects"),
    (lambda p: zipped(p, time=member(HEADER % ("|V8", "(5,)"), bytes(40))), "no plain numbers"),
    (lambda p: zipped(p, time=member(HEADER % ("<f3", "(5,)"), bytes(15))), "f3"),
    (lambda p: zipped(p, time=member("{'descr': " + "(" * 3000, b"")), "no plain numbers"),
    (lambda p: zipped(p, time=member(HEADER % ("<f8", f"({'9' * 5000},)"))), "a header of 5"),
    (lambda p: zipped(p, time=member(HEADER % ("<f8", "(-5,)"), bytes(40))), "no plain numbers"),
    (lambda p: zipped(p, time=b"no array"), "'time' is no array"),
    (lambda p: zipped(p, time=b""), "'time' is no array"),
    (lambda p: zipped(p, is_good=member(HEADER % ("|b1", "(5,)"), b"\1\0\7\0\1")), "neither true"),
    (lambda p: zipped(p, name=member(HEADER % ("<U1", "(2,)"), b"\xff" * 8)), "no valid text"),
    (lambda p: zipped(p, name=member(HEADER % ("<U1", "(1,)"), b"\0\xd8\0\0")), "no valid text"),
    (
        lambda p: zipped(p, name=member(HEADER % ("<U99999999", "(1,)"))),
        "'name' declares 399999996 bytes",
    ),
    (lambda p: zipped(p, zipfile.ZIP_STORED, **{f"x{i}": b"" for i in range(80)}), "at most 64"),
    (lambda p: save(p, junk=np.zeros(3)), "unknown array 'junk.npy'; a 'test' file has none"),
    (lambda p: save(p, schema=np.array("other")), "schema 'other', expected 'test'"),
    (lambda p: save(p, schema=np.zeros(3)), "schema 'none'"),
    (lambda p: save(p, version=np.array(2), junk=np.zeros(3)), "version 2 of 'test'"),
    (lambda p: save(p, time=None), "'time' is missing"),
    (lambda p: save(p, time=np.arange(4.0)), r"'place' is float32 \(5, 3\), expected .*\(4, 3\)"),
    (lambda p: save(p, time=np.arange(5)), "'time' is int64"),
    (lambda p: save(p, time=np.arange(2000.0)), "at most 1000 N"),
    (lambda p: save(p, time=np.array([0, 1, 2, 2, 3.0])), "'time' does not increase at row 3"),
    (lambda p: save(p, time=np.array([0, 1, np.inf, 2, 3])), "'time' holds NaN or infinity"),
    (lambda p: save(p, name=np.array(["x" * 2000])), "'name' holds texts of 2000 characters"),
]


@pytest.mark.parametrize(("make", "message"), CASES)
def test_a_malformed_file_is_refused_in_one_line(
    tmp_path: Path, make: Callable[[Path], Any], message: str
) -> None:
    path = tmp_path / "file.npz"
    make(path)
    with pytest.raises(RequestError, match=message) as caught:
        read_npz(path, KIND)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)
    assert "allow_pickle" not in str(caught.value)


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_a_name_that_is_there_twice_is_refused(tmp_path: Path) -> None:
    path = save(tmp_path / "file.npz")
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("time.npy", b"another")
    with pytest.raises(RequestError, match="'time' is there twice"):
        read_npz(path, KIND)


def test_an_unknown_array_is_refused_without_being_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = save(tmp_path / "file.npz", junk=np.zeros(3))
    opened: list[str] = []
    before = zipfile.ZipFile.open

    def watched(self: zipfile.ZipFile, info: Any, *rest: Any) -> Any:
        opened.append(info.filename)
        return before(self, info, *rest)

    monkeypatch.setattr(zipfile.ZipFile, "open", watched)
    with pytest.raises(RequestError, match="junk"):
        read_npz(path, KIND)
    assert "junk.npy" not in opened


def test_arrays_beyond_the_limit_of_a_file_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = save(tmp_path / "file.npz")
    monkeypatch.setattr(npz, "MAX_FILE_BYTES", 100)
    with pytest.raises(RequestError, match="at most 100 are read"):
        read_npz(path, KIND)


def test_a_digest_is_of_the_numbers() -> None:
    numbers = np.arange(6.0).reshape(2, 3)

    def digest_of(name: str, array: np.ndarray) -> str:
        digest = hashlib.sha256()
        add_array(digest, name, array)
        return digest.hexdigest()

    digest = digest_of("a", numbers)
    assert digest_of("a", np.asfortranarray(numbers)) == digest
    assert digest_of("a", numbers.astype(">f8")) == digest
    others = [("b", numbers), ("a", numbers.T), ("a", numbers.astype("f4")), ("a", numbers + 1)]
    assert len({digest, *(digest_of(*other) for other in others)}) == 5


FUZZ = settings(
    max_examples=150,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)


@FUZZ
@given(
    changes=st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)), max_size=4),
    share=st.one_of(st.just(1.0), st.floats(0, 1)),
    compressed=st.booleans(),
)
def test_a_damaged_file_gives_equal_values_or_one_line(
    tmp_path: Path, changes: list[tuple[float, int]], share: float, compressed: bool
) -> None:
    path = tmp_path / "fuzz.npz"
    (np.savez_compressed if compressed else np.savez)(path, **content())
    data = bytearray(path.read_bytes())
    for place, value in changes:
        data[int(place * len(data))] = value
    path.write_bytes(bytes(data[: int(share * len(data))]))
    try:
        read = read_npz(path, KIND)
    except RequestError as error:
        assert "\n" not in str(error)  # noqa: PT017
        return
    for name, array in read.items():
        np.testing.assert_array_equal(array, content()[name])
