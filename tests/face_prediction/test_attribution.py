"""The table of who is in a clip and whether its numbers may be given away."""

from __future__ import annotations

from pathlib import Path

import pytest

from face_prediction.motion.library import read_attributions
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


@pytest.mark.parametrize(("name", "text"), [("t.csv", CSV), ("t.md", MARKDOWN)])
def test_both_forms(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    rows = read_attributions(tmp_path / name)
    assert sorted(rows) == ["a", "b"]
    assert rows["a"].ship
    assert not rows["b"].ship
    assert rows["a"].record() == {
        "subject": "ann", "licence": "MIT", "source": "someone/somewhere",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("clip,subject\na,b\n", "no table with the columns"),
        ("", "no table with the columns"),
        (CSV.replace("yes", "maybe"), "ship 'maybe' in the row of 'a.mp4'"),
        (CSV.replace("MIT", ""), "row 'a.mp4' has no licence"),
        (CSV + "a.mp4,ann,yes,MIT,x,\n", "two rows for 'a'"),
        (CSV + "c,cat,yes\n", "3 cells for 6 columns in the row of 'c'"),
    ],
)
def test_bad_tables(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "t.csv"
    path.write_text(text)
    with pytest.raises(RequestError, match=message) as caught:
        read_attributions(path)
    assert str(path) in str(caught.value)


def test_a_missing_table(tmp_path: Path) -> None:
    with pytest.raises(RequestError, match="cannot be read"):
        read_attributions(tmp_path / "t.csv")
