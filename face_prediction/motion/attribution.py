"""Attribution tables: who is in a clip, its licence, and whether its numbers may be redistributed.

Tables are read as spreadsheets save them: separated by commas, semicolons or tabs, with or without
a byte-order mark.
"""

from __future__ import annotations

import csv
import unicodedata
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path, PureWindowsPath

from robo_manip_baselines.runs.errors import RequestError

COLUMNS = ("clip", "subject", "ship", "licence", "source")
"""Columns of an attribution table."""
OPTIONAL_COLUMNS = ("kind", "what")
SEPARATED_SUFFIXES = (".csv", ".tsv", ".txt")
"""Suffixes of tables of separated values; other files hold Markdown."""
SEPARATORS = ",;\t"
VIDEO_SUFFIXES = frozenset(
    {".3gp", ".asf", ".avi", ".dv", ".flv", ".gif", ".h264", ".hevc", ".m2ts", ".m4v", ".mjpeg"}
    | {".mkv", ".mov", ".mp4", ".mpeg", ".mpg", ".mts", ".mxf", ".ogg", ".ogv", ".ts", ".vob"}
    | {".webm", ".wmv"}
)
"""Suffixes that are no part of a clip's name; ``talk.v2`` is another clip than ``talk``."""


@dataclass(frozen=True)
class Attribution:
    """Row of one clip.

    Attributes:
        clip: name without suffix.
        subject: the person.
        ship: numbers measured on the clip may be redistributed.
        licence: terms of use.
        source: origin.
        kind: kind of footage, from the optional column ``kind``.
        what: content, from the optional column ``what``.
    """

    clip: str
    subject: str
    ship: bool
    licence: str = "not stated"
    source: str = "not stated"
    kind: str = ""
    what: str = ""

    def record(self) -> dict[str, str]:
        """Subject, licence and source, which a library keeps."""
        return {"subject": self.subject, "licence": self.licence, "source": self.source}


def read_attributions(path: Path) -> dict[str, Attribution]:
    """Rows, by clip, of a table with the columns clip, subject, ship (yes or no), licence, source.

    Columns ``kind`` and ``what`` are read where there are any. The file holds separated values
    (``.csv``, ``.tsv``, ``.txt``) under a header line, or is a Markdown file with such a table in
    it; other columns, text and tables are passed over. A clip is named with or without the suffix
    of its video; see `find_row`.

    Raises:
        RequestError: the file cannot be read, has no such table, a row is incomplete, or two rows
            of one clip disagree.
    """

    def wrong(problem: str) -> RequestError:
        return RequestError(f"--attribution {path}: {problem}")

    try:
        text = path.read_bytes().decode(encoding="utf-8-sig")
    except OSError as error:
        raise wrong(f"cannot be read ({error.strerror})") from None
    except UnicodeDecodeError:
        raise wrong("is not UTF-8 text; save it as 'CSV UTF-8'") from None
    header: list[str] | None = None
    is_found = False
    attributions: dict[str, Attribution] = {}
    try:
        for cells in _rows(path, text):
            names = [cell.lower() for cell in cells or ()]
            if cells is None:
                header = None
            elif set(COLUMNS) <= set(names):
                header, is_found = names, True
                if twice := [n for n in (*COLUMNS, *OPTIONAL_COLUMNS) if names.count(n) > 1]:
                    raise wrong(f"two columns named {', '.join(twice)}")
            elif header is not None and any(cells):
                row = _attribution(header, cells, wrong)
                clip = row.clip
                if attributions.setdefault(clip, row) != row:
                    raise wrong(f"two rows for '{clip}' that disagree; keep one")
    except csv.Error as error:
        raise wrong(f"is damaged ({error})") from None
    if not is_found:
        raise wrong(f"no table with the columns {', '.join(COLUMNS)} in it")
    return attributions


def find_row(rows: Mapping[str, Attribution], clip: str) -> Attribution | None:
    """The row of ``clip``, the name of a track file without ``.npz``; None: there is none.

    The whole name counts: a row ``talk.v2`` is of ``talk.v2.npz`` and not of ``talk.npz``, while
    ``talk.mp4``, which names a video, is of ``talk.npz``.
    """
    row = rows.get(unicodedata.normalize("NFC", clip))
    return None if row is None else replace(row, clip=clip)


def _attribution(
    header: list[str], cells: list[str], wrong: Callable[[str], RequestError]
) -> Attribution:
    """The row with these ``cells`` under this ``header``."""
    while len(cells) > len(header) and not cells[-1]:  # spreadsheets fill rows up
        cells = cells[:-1]
    needed = 1 + max(header.index(name) for name in COLUMNS)
    if not needed <= len(cells) <= len(header):
        raise wrong(f"{len(cells)} cells for {len(header)} columns in the row of '{cells[0]}'")
    row = dict.fromkeys(OPTIONAL_COLUMNS, "") | dict(zip(header, cells, strict=False))
    if missing := [name for name in COLUMNS if not row[name]]:
        raise wrong(f"row '{row['clip']}' has no {', '.join(missing)}")
    if broken := [name for name in COLUMNS if "\n" in row[name]]:
        begin = row["clip"].splitlines()[0]
        raise wrong(f"a line break in {broken[0]} of row '{begin}'; is a quote not closed?")
    ship = row["ship"].lower()
    if ship not in ("yes", "no"):
        raise wrong(f"ship '{row['ship']}' in the row of '{row['clip']}'; yes or no")
    kept = {name: row[name] for name in (*COLUMNS[3:], *OPTIONAL_COLUMNS)}
    return Attribution(_clip_name(row["clip"]), row["subject"], ship == "yes", **kept)


def _clip_name(cell: str) -> str:
    """Name of a clip from a cell: without folders, and without the suffix of a video."""
    name = PureWindowsPath(unicodedata.normalize("NFC", cell)).name  # takes both slashes
    stem, dot, suffix = name.rpartition(".")
    return stem if stem and f"{dot}{suffix}".lower() in VIDEO_SUFFIXES else name


def _rows(path: Path, text: str) -> Iterator[list[str] | None]:
    """Cells of the rows in ``text``, without space around them; None between tables."""
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    if path.suffix.lower() not in SEPARATED_SUFFIXES:
        return _markdown_rows(lines)
    for line in lines:
        for separator in SEPARATORS:
            header = next(_separated_rows([line], separator), [])
            if set(COLUMNS) <= {cell.lower() for cell in header}:
                return _separated_rows([f"{line}\n" for line in lines], separator)
    return iter(())


def _separated_rows(lines: Iterable[str], separator: str) -> Iterator[list[str]]:
    for row in csv.reader(lines, delimiter=separator, skipinitialspace=True):
        yield [cell.strip() for cell in row]


def _markdown_rows(lines: Iterable[str]) -> Iterator[list[str] | None]:
    """Cells of the lines of tables, without the rules below their headers; None for other text."""
    for line in lines:
        text = line.strip()
        cells = [cell.strip() for cell in text.strip("|").split("|")]
        if not text.startswith("|"):
            yield None
        elif not set("".join(cells)) <= set("-: "):
            yield cells
