"""The table of who is in a clip and whether its numbers may be given away."""

from __future__ import annotations

import unicodedata
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from face_prediction.motion.attribution import find_row, read_attributions
from face_prediction.motion.library import attributed_tracks, lift_clips
from face_prediction.motion.motion import MotionSettings
from face_prediction.tracking.tracks import save_track
from robo_manip_baselines.runs.errors import RequestError

CSV = """clip,subject,ship,licence,source,note
a.mp4,ann,yes,MIT,someone/somewhere,"nods, talks"
b,bob,no,unknown,elsewhere,
"""
MARKDOWN = """# Clips

| other | table |
|---|---|
| x | y |

| clip | subject | ship | s | licence | source | what |
|---|---|---|---|---|---|---|
| a.mp4 | ann | yes | 3.0 | MIT | someone/somewhere | nods |
| b.mp4 | bob | no | 4.0 | unknown | elsewhere | - |

| another | table |
|---|---|
| 1 | 2 |
"""
HEAD = "clip,subject,ship,licence,source\n"


def check_both(rows) -> None:
    assert sorted(rows) == ["a", "b"]
    assert rows["a"].ship
    assert not rows["b"].ship
    assert rows["a"].record() == {
        "subject": "ann", "licence": "MIT", "source": "someone/somewhere",
    }  # fmt: skip


@pytest.mark.parametrize(("name", "text"), [("t.csv", CSV), ("t.md", MARKDOWN)])
def test_both_forms(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    check_both(read_attributions(tmp_path / name))


SAVED_AS = {
    "Excel, UTF-8": b"\xef\xbb\xbf" + CSV.replace("\n", "\r\n").encode(),
    "Excel in Europe": b"\xef\xbb\xbf" + CSV.replace(",", ";").replace("\n", "\r\n").encode(),
    "with the separator named": b"sep=;\r\n" + CSV.replace(",", ";").replace("\n", "\r\n").encode(),
    "tabs": CSV.replace('"nods, talks"', "nods").replace(",", "\t").encode(),
    "spaces after commas": CSV.replace(",", ", ").encode(),
    "spaces around commas": CSV.replace(",", " , ").replace('"nods , talks"', "nods").encode(),
    "old line ends": CSV.replace("\n", "\r").encode(),
    "everything quoted": "\n".join(
        ",".join(f'"{cell}"' for cell in line.split(",")) for line in CSV.splitlines()[::2]
    ).encode() + b'\n"a.mp4","ann","yes","MIT","someone/somewhere","nods; talks"',
    "quoted and with semicolons": b'"clip";"subject";"ship";"licence";"source"\n'
    b'"a.mp4";"ann";"yes";"MIT";"someone/somewhere"\n'
    b'"b";"bob";"no";"unknown; perhaps";"elsewhere"',
    "empty rows and cells": CSV.replace("elsewhere,", "elsewhere,,,,").encode() + b",,,,,\n\n,,\n",
    "other letter case": CSV.replace("clip,subject,ship", "Clip,SUBJECT,Ship")
    .replace("yes", "Yes").replace("no,", "NO,").encode(),
    "the same row twice": CSV.encode() + b'a.mp4,ann,yes,MIT,someone/somewhere,"nods, talks"\n',
}  # fmt: skip


@pytest.mark.parametrize("name", ["t.csv", "T.CSV", "t.txt"])
@pytest.mark.parametrize("saved", SAVED_AS.values(), ids=SAVED_AS.keys())
def test_tables_as_people_save_them(tmp_path: Path, name: str, saved: bytes) -> None:
    (tmp_path / name).write_bytes(saved)
    check_both(read_attributions(tmp_path / name))


@pytest.mark.parametrize(
    ("row", "clip", "is_found"),
    [
        ("talk", "talk", True),
        ("talk.mp4", "talk", True),
        ("talk.MOV", "talk", True),
        ("clips/talk.mp4", "talk", True),
        ("C:\\clips\\talk.mp4", "talk", True),
        ("talk.2024", "talk.2024", True),
        ("talk.2024.mp4", "talk.2024", True),
        ("caf\u00e9.mp4", unicodedata.normalize("NFD", "caf\u00e9"), True),
        ("talk.v2", "talk", False),
        ("talk.2024", "talk", False),
        ("talk.v2.mp4", "talk", False),
        ("talk", "talk.v2", False),
        ("talk", "talk.mp4.v2", False),
        ("talk", "Talk", False),
        (".mp4", "", False),
    ],
)
def test_a_row_is_of_one_clip(tmp_path: Path, row: str, clip: str, is_found: bool) -> None:
    path = tmp_path / "t.csv"
    path.write_text(f"{HEAD}{row},ann,yes,MIT,x\n", encoding="utf-8")
    found = find_row(read_attributions(path), clip)
    assert (found is not None) == is_found
    if found is not None:
        assert found.clip == clip


@settings(max_examples=50)
@given(st.text(st.characters(codec="utf-8", exclude_categories=["C", "Z"]), min_size=1))
def test_any_name_finds_its_own_row(tmp_path_factory, name: str) -> None:
    """A name that is no path and has no video's suffix licenses the clip of that name only."""
    name = unicodedata.normalize("NFC", name.replace("/", "-").replace("\\", "-")).strip(".:")
    if not name or name != name.strip() or "." in name or ":" in name:
        return
    path = tmp_path_factory.getbasetemp() / "any.csv"
    quoted = name.replace('"', '""')
    path.write_text(f'{HEAD}"{quoted}",ann,yes,MIT,x\n', encoding="utf-8", newline="")
    assert list(read_attributions(path)) == [name]


@settings(max_examples=50)
@given(st.binary(), st.sampled_from(["t.csv", "t.md"]))
def test_any_bytes_are_a_table_or_one_line(tmp_path_factory, content: bytes, name: str) -> None:
    path = tmp_path_factory.getbasetemp() / name
    path.write_bytes(HEAD.encode() + content)
    problem = "none"
    try:
        read_attributions(path)
    except RequestError as error:
        problem = str(error)
    assert len(problem.splitlines()) == 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("clip,subject\na,b\n", "no table with the columns"),
        ("", "no table with the columns"),
        (CSV.replace("yes", "maybe"), "ship 'maybe' in the row of 'a.mp4'"),
        (CSV.replace("MIT", ""), "row 'a.mp4' has no licence"),
        (CSV + "a.mp4,ann,no,MIT,someone/somewhere,\n", "two rows for 'a' that disagree"),
        (CSV + "a.mov,eve,yes,MIT,someone/somewhere,\n", "two rows for 'a' that disagree"),
        (CSV + "c,cat,yes\n", "3 cells for 6 columns in the row of 'c'"),
        (CSV + "c,cat,yes,MIT,x,,more\n", "7 cells for 6 columns in the row of 'c'"),
        (HEAD.strip() + ",ship\na,ann,yes,MIT,x,no\n", "two columns named ship"),
        (HEAD + 'a,ann,yes,MIT,"x\nb,bob,no,MIT,x\n', "a line break in source of row 'a'"),
    ],
)
def test_bad_tables(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "t.csv"
    path.write_text(text)
    with pytest.raises(RequestError, match=message) as caught:
        read_attributions(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", [CSV.replace("ann", "J\xf6rg").encode("cp1252"), b"\xff\xfec\0l"])
def test_other_encodings_are_refused(tmp_path: Path, text: bytes) -> None:
    (tmp_path / "t.csv").write_bytes(text)
    with pytest.raises(RequestError, match="is not UTF-8 text; save it as 'CSV UTF-8'"):
        read_attributions(tmp_path / "t.csv")


def test_a_missing_table(tmp_path: Path) -> None:
    with pytest.raises(RequestError, match="cannot be read"):
        read_attributions(tmp_path / "t.csv")


def test_clips_that_may_not_ship(tmp_path: Path, make_track) -> None:
    """Without a row that says yes the reason is that, and no length of runs."""
    table = tmp_path / "t.csv"
    track = make_track(np.tile([0.0, 0.0, -0.5], (60, 1)))
    for name in ("talk", "talk.v2"):
        save_track(tmp_path / f"{name}.npz", track)
    table.write_text(f"{HEAD}talk,ann,no,MIT,x\ntalk.v2,ann,no,MIT,x\n")
    with pytest.raises(RequestError, match="none of the 2 clips given has ship=yes"):
        lift_clips([tmp_path], table, MotionSettings())
    table.write_text(f"{HEAD}talk.v2,ann,yes,MIT,x\n")
    with pytest.raises(RequestError, match=r"no row for 'talk' in .*add one"):
        attributed_tracks([tmp_path], table)
