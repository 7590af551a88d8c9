"""Who is in a clip, where it is from, and whether numbers measured on it may be given away."""

from __future__ import annotations

import csv
from dataclasses import asdict, dataclass
from pathlib import Path

from face_prediction.errors import RequestError

COLUMNS = ("clip", "subject", "ship", "licence", "source")


@dataclass(frozen=True)
class Attribution:
    """One clip's row: its name without suffix, its person, and the terms it comes under."""

    clip: str
    subject: str
    #: whether numbers measured on the clip may be redistributed
    ship: bool
    licence: str
    source: str
    #: kind of footage, from the optional column ``kind``
    kind: str = ""
    #: what is to be seen, from the optional column ``what``
    what: str = ""

    def record(self) -> dict[str, str]:
        """What is kept in a library: everything but the clip's name and ``ship``."""
        return {k: v for k, v in asdict(self).items() if k in ("subject", "licence", "source")}


def read_attributions(path: Path) -> dict[str, Attribution]:
    """Rows of a table with the columns clip, subject, ship (yes or no), licence and source.

    Columns ``kind`` and ``what`` are read where there are any. The file is a ``.csv`` with a header
    line, or a Markdown file with such a table in it; other columns, text and tables are passed
    over.

    Raises:
        RequestError: the file cannot be read, has no such table, or a row is incomplete.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise RequestError(f"--attribution {path}: cannot be read ({error})") from None
    lines = text.splitlines()
    rows = list(csv.reader(lines)) if path.suffix == ".csv" else _markdown_rows(lines)
    header: list[str] | None = None
    attributions: dict[str, Attribution] = {}
    for cells in rows:
        if set(COLUMNS) <= {cell.lower() for cell in cells}:
            header = [cell.lower() for cell in cells]
        elif header is not None and len(cells) == len(header):
            row = dict(zip(header, cells, strict=True))
            attribution = _attribution(path, row)
            if attribution.clip in attributions:
                raise RequestError(f"--attribution {path}: two rows for '{attribution.clip}'")
            attributions[attribution.clip] = attribution
        elif header is not None and cells:
            raise RequestError(
                f"--attribution {path}: {len(cells)} cells for {len(header)} columns in the row "
                f"of '{cells[0]}'"
            )
    if header is None:
        raise RequestError(
            f"--attribution {path}: no table with the columns {', '.join(COLUMNS)} in it"
        )
    return attributions


def _attribution(path: Path, row: dict[str, str]) -> Attribution:
    missing = [name for name in COLUMNS if not row[name]]
    if missing:
        raise RequestError(f"--attribution {path}: row '{row['clip']}' has no {', '.join(missing)}")
    ship = row["ship"].lower()
    if ship not in ("yes", "no"):
        raise RequestError(
            f"--attribution {path}: ship '{row['ship']}' in the row of '{row['clip']}'; yes or no"
        )
    clip = Path(row["clip"]).stem
    return Attribution(
        clip,
        row["subject"],
        ship == "yes",
        row["licence"],
        row["source"],
        kind=row.get("kind", ""),
        what=row.get("what", ""),
    )


def _markdown_rows(lines: list[str]) -> list[list[str]]:
    """Cells of the table lines that have the wanted columns; other tables are skipped."""
    rows: list[list[str]] = []
    inside = False
    for line in lines:
        text = line.strip()
        if not text.startswith("|"):
            inside = False
            continue
        cells = [cell.strip() for cell in text.strip("|").split("|")]
        if set(COLUMNS) <= {cell.lower() for cell in cells}:
            inside = True
        elif set("".join(cells)) <= set("-: "):
            continue  # the rule below the header
        if inside:
            rows.append(cells)
    return rows
