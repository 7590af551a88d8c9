"""Result lines and where they stand, so that every figure can be traced to them."""

from __future__ import annotations

import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from robo_manip_baselines.errors import RequestError
from robo_manip_baselines.evaluation.result import EpisodeResult


@dataclass(frozen=True)
class Line:
    """A line of a results file.

    Attributes:
        file: path of the file, with forward slashes, as a link from the report spells it.
        number: of the line, from 1.
        result: what it says.
    """

    file: str
    number: int
    result: EpisodeResult


@dataclass(frozen=True)
class Selection:
    """Which result lines a figure comes from. ``None`` selects everything.

    Attributes:
        arm: name of the arm.
        train_seed: of the policy.
        is_success: only successes, or only failures.
        is_strict: only strict successes.
        within: only successes within so many s of the lift.
        failure: only this kind of failure.
        versus: names of other arms; then the lines of all are meant, for training and evaluation
            seeds that all of them have, and that all of them managed where ``is_success``.
        is_different: with ``versus``: only seeds that one arm managed and another did not.
    """

    arm: str
    train_seed: int | None = None
    is_success: bool | None = None
    is_strict: bool | None = None
    within: float | None = None
    failure: str | None = None
    versus: tuple[str, ...] = ()
    is_different: bool = False


def read_lines(files: Iterable[Path], root: Path | None = None) -> tuple[Line, ...]:
    """Read results files of any number of arms; a torn last line is left out.

    Args:
        files: paths of ``results.jsonl`` files.
        root: folder that the paths are told relative to, usually that of the report.

    Raises:
        RequestError: a file is missing or damaged, holds results of another environment, or an
            episode (arm, training seed, seed) is there twice.
    """
    lines: list[Line] = []
    seen: dict[tuple[str, int | None, int], Line] = {}
    for path in files:
        try:
            text = path.read_text(encoding="utf-8", errors="replace")
        except OSError as error:
            raise RequestError(
                f"'{path}' cannot be read: {error.strerror}; name a results.jsonl file"
            ) from error
        name = _relative(path, root)
        for number, content in enumerate(text[: text.rfind("\n") + 1].splitlines(), start=1):
            try:
                line = Line(name, number, EpisodeResult.from_line(content))
            except ValueError as error:
                raise RequestError(
                    f"'{path}', line {number} is damaged: {error}; remove that line"
                ) from error
            key = (line.result.arm, line.result.train_seed, line.result.seed)
            if there := seen.get(key):
                raise RequestError(
                    f"'{path}', line {number}: arm {key[0]}, training seed {key[1]}, seed {key[2]} "
                    f"is also in '{there.file}', line {there.number}; give one of them only"
                )
            seen[key] = line
            lines.append(line)
    environments = sorted({line.result.env for line in lines})
    if len(environments) > 1:
        raise RequestError(
            f"results of {' and '.join(environments)} do not compare; give those of one environment"
        )
    return tuple(lines)


def _relative(path: Path, root: Path | None) -> str:
    """Return a path as a link from a folder would spell it, or as it is."""
    if root is None:
        return path.as_posix()
    return Path(os.path.relpath(path.resolve(), root.resolve())).as_posix()
