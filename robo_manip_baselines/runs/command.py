"""Command lines: options parsed into dataclasses, errors as one line, exit codes.

Exit codes: 0 done, 1 something failed that was not the user's doing (such as a full disk), 2 the
request was wrong, 130 interrupted (Ctrl-C, SIGTERM, SIGHUP).
"""

from __future__ import annotations

import codecs
import contextlib
import difflib
import inspect
import io
import logging
import os
import re
import select
import sys
import tempfile
import time
import traceback
import unicodedata
from collections.abc import Callable, Sequence
from pathlib import Path
from types import UnionType
from typing import Any, NoReturn, TypeVar, cast

import tyro

from robo_manip_baselines.runs.errors import (
    RequestError,
    WriteError,
    disk_problem,
    path_problem,
)
from robo_manip_baselines.runs.interrupt import signals_as_interrupt
from robo_manip_baselines.runs.ranges import require_ranges

Options = TypeVar("Options")

EXIT_FAILED = 1
EXIT_WRONG_REQUEST = 2
EXIT_INTERRUPTED = 130  # 128 + SIGINT, as shells report it

_ASCII = {
    **{"±": "+-", "×": "x", "–": "-", "—": "-", "−": "-", "…": "...", "°": " degrees"},
    **{"µ": "u", "μ": "u", "≤": "<=", "≥": ">=", "→": "->", "·": "*"},
    **dict.fromkeys("‘’", "'"),
    **dict.fromkeys("“”", '"'),
    **dict.fromkeys("│┃", "|"),
    **dict.fromkeys("─━", "-"),
    **dict.fromkeys("╭╮╰╯┌┐└┘├┤┬┴┼", "+"),
}
"""Replacement of characters for a terminal that cannot show them."""

_ANSI = re.compile(r"\x1b\[[0-9;]*m")
_BOX = re.compile(r"^[\s│|╭╰┌└+]+|[\s│|╮╯┐┘+]+$")
_RULE = re.compile(r"[\s│|╭╰╮╯┌┐└┘+─-]*")
_PLAINER = (
    (
        r"Error parsing (\S+): invalid literal for int\(\).*: ('.*')",
        r"\1 is a whole number, not \2",
    ),
    (
        r"Error parsing (\S+): Exceeds the limit .*",
        r"\1 is a whole number of fewer digits",
    ),
    (r"Error parsing (\S+): could not convert string to float: ('.*')", r"\1 is a number, not \2"),
    (r"Error parsing (\S+): ", r"\1: "),
    (
        r"Missing value for argument '?\(?'([^\s',]+)',?\)?'?\. Expected \d+ values?",
        r"\1 needs a value",
    ),
    (r"Missing from [^:]+: ", "missing: "),
    (r" \(required\)", ""),
    (
        r"invalid choice '(.*)' for argument '(.*)'. Expected one of \((.*)\)",
        r"\2 is one of \3, not '\1'",
    ),
)
_SECTIONS = re.compile(r"\n\n(?:Attributes|Raises):\n")  # of a docstring, no part of a description
_OPTION = re.compile(r"(?<![\w-])--[a-z][\w-]*")


def run_command(
    main: Callable[[], int | None], explain: Callable[[Exception], str | None] | None = None
) -> NoReturn:
    """Run ``main`` and end the process with the matching exit code.

    A `RequestError` becomes one line on stderr, without a traceback; so does a path that cannot be
    used, as one with a name that is too long; so does any other exception, whose traceback goes to
    a file that the line names.

    Args:
        main: the command; returns the exit code, None being 0.
        explain: returns the line for an exception whose cause is the request, else None.

    Raises:
        SystemExit: always.
    """
    _prepare_streams()
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    # PyOpenGL tells every user that an accelerator, which nothing here needs, is not installed.
    logging.getLogger("OpenGL").setLevel(logging.WARNING)
    try:
        with signals_as_interrupt():
            code = main() or 0
            sys.stdout.flush()
    except RequestError as error:
        code = _say(f"error: {_one_line(error)}", EXIT_WRONG_REQUEST)
    except WriteError as error:
        code = _say(f"error: {_one_line(error)}", EXIT_FAILED)
    except KeyboardInterrupt:
        code = _say("interrupted", EXIT_INTERRUPTED)
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    except BrokenPipeError:
        if not _is_reader_gone():
            traceback.print_exc()
        code = EXIT_FAILED
    except Exception as error:
        if problem := explain and explain(error):
            code = _say(f"error: {problem}", EXIT_WRONG_REQUEST)
        elif problem := path_problem(error):
            code = _say(f"error: {_one_line(problem)}", EXIT_WRONG_REQUEST)
        elif reason := disk_problem(error):
            file = getattr(error, "filename", None)
            what = f"read or write '{_text(file)}'" if file else "write the output"
            code = _say(f"error: cannot {what}: {reason}", EXIT_FAILED)
        else:
            code = _say(_unforeseen(error), EXIT_FAILED)
    sys.exit(_flush(code))


def parse(
    options_type: type[Options] | UnionType,
    example: str | None,
    *,
    description: str | None = None,
    args: Sequence[str] | None = None,
    default: Options | None = None,
    prog: str | None = None,
) -> Options:
    """Read the command line into ``options_type``.

    ``--help`` prints every option with its default, and the example. Options are written with
    underscores; hyphens work too.

    Args:
        options_type: a dataclass, or a union of dataclasses for subcommands. A `RequestError`
            from its ``__post_init__`` passes through unchanged.
        example: a command line that works, shown at the end of the description; None: the docstring
            of ``options_type`` has one.
        description: first words of the help; by default the docstring of ``options_type``.
        args: instead of ``sys.argv[1:]``.
        default: an instance whose values are the defaults, instead of those of ``options_type``.
        prog: name of the program, with the subcommand if any; by default ``sys.argv[0]``.

    Raises:
        RequestError: one line that names what was wrong and what is valid.
        SystemExit: with code 0 after ``--help``.
    """
    given = list(sys.argv[1:] if args is None else args)
    _refuse_empty(given)
    text = _SECTIONS.split(description or inspect.getdoc(options_type) or "")[0].strip()
    if example is not None:
        text += f"\n\nExample: {example}"
    program = sys.argv[0] if prog is None else prog
    result, unknown = _call_tyro(options_type, text, given, default, program)
    if unknown:
        # the options that --help lists after the known arguments, which may hold a subcommand
        page = io.StringIO()
        rest = [arg for arg in given if arg not in unknown]
        with contextlib.redirect_stdout(page), contextlib.suppress(SystemExit, RequestError):
            text = text.split("\n\nExample:")[0]
            _call_tyro(options_type, text, [*rest, "--help"], default, program)
        raise RequestError(_unknown_message(unknown, page.getvalue(), program))
    require_ranges(result, "--{} {}")
    return result


def _refuse_empty(args: Sequence[str]) -> None:
    """Refuse empty arguments: they come from shell variables that are not set.

    Raises:
        RequestError: naming the option.
    """
    name = "an argument"
    for arg in args:
        option, sign, value = arg.partition("=")
        is_option = option.startswith("--")
        if not arg.strip() or (is_option and sign and not value.strip()):
            what = option if is_option else name
            raise RequestError(
                f"{what} '': is empty; give a value (a variable of the shell may not be set), or "
                "leave it out"
            )
        name = option if is_option and not sign else name


def last_value(args: Sequence[str], name: str) -> str | None:
    """Return the value of an option that decides the defaults of others, before `parse`.

    Args:
        args: the command line.
        name: of the option, with underscores.

    Returns:
        What follows the last ``--name`` or ``--name=``; None where there is no value.
    """
    found = None
    for arg, following in zip(args, [*args, "--"][1:], strict=True):
        option, sign, value = arg.partition("=")
        if option.startswith("--") and option[2:].replace("-", "_") == name:
            found = value if sign else None if following.startswith("--") else following
    return found


def _call_tyro(
    options_type: Any, description: str, args: Sequence[str], default: Any, prog: str
) -> tuple[Any, list[str]]:
    errors = io.StringIO()
    try:
        with contextlib.redirect_stderr(errors):
            given = {} if default is None else {"default": default}
            found = tyro.cli(
                options_type,
                **{"prog": prog, "description": description, "args": args, **given},
                use_underscores=True,
                return_unknown_args=True,
                config=(tyro.conf.OmitSubcommandPrefixes,),
            )
            return cast("tuple[Any, list[str]]", found)
    except SystemExit as stop:
        if not stop.code:
            raise
        # tyro draws ValueErrors into a box that breaks long lines; the original is its context.
        cause: BaseException | None = stop
        while cause is not None:
            if isinstance(cause, RequestError):
                raise cause from None
            cause = cause.__cause__ or cause.__context__
        message = _box_to_line(errors.getvalue())
        if message.startswith("Expected one of") and args:  # a subcommand
            message = f"'{args[0]}' is no subcommand: {message[0].lower()}{message[1:]}"
        raise RequestError(f"{message}; {_help_hint(prog)}") from None


def _unknown_message(unknown: Sequence[str], help_page: str, prog: str) -> str:
    names = dict.fromkeys(_OPTION.findall(_ANSI.sub("", help_page)))
    known = [name for name in names if name != "--help"]
    name = next((arg for arg in unknown if arg.startswith("-")), unknown[0])
    if not name.startswith("-"):
        return f"'{name}' is one argument too many; {_help_hint(prog)}"
    name = name.split("=")[0]
    close = difflib.get_close_matches(name.replace("-", "_"), [k.replace("-", "_") for k in known])
    hint = f" (did you mean '--{close[0].lstrip('_')}'?)" if close else ""
    return f"unknown option '{name}'{hint}; valid: {', '.join(known)}; {_help_hint(prog)}"


def _box_to_line(text: str) -> str:
    """Return the text of tyro's box, without the box, the help text and the footer."""
    lines = _ANSI.sub("", text).splitlines()
    body: list[str] = []
    for line in lines[1:]:
        if body and _RULE.fullmatch(line):
            break
        body.append(_BOX.sub("", line))
    message = _one_line(" ".join(body)).rstrip(".;") or "these options are not valid"
    for pattern, plain in _PLAINER:
        message = re.sub(pattern, plain, message)
    return message


def _help_hint(prog: str) -> str:
    return f"'{prog} --help' lists what is valid"


def _unforeseen(error: Exception) -> str:
    """Return the line for an exception that nothing foresaw; its traceback goes to a file."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    name = f"error_{time.strftime('%Y%m%d_%H%M%S')}_{os.getpid()}.log"
    command = " ".join(sys.argv)
    text = f"{command}\n{traceback.format_exc()}".encode(errors="backslashreplace")
    where = "no log file could be written"
    for folder in (cache / "robo_manip_baselines", Path(tempfile.gettempdir())):
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with (folder / name).open("xb") as file:  # never over a file or link of somebody else
                file.write(text)
            where = f"the traceback is in '{folder / name}'"
            break
        except OSError:
            continue
    message = _one_line(error)[:300]
    kind = type(error).__name__
    return f"error: {kind}: {message}; {where}" if message else f"error: {kind}; {where}"


def _one_line(message: object) -> str:
    return " ".join(str(message).split())


def _say(line: str, code: int) -> int:
    with contextlib.suppress(OSError):  # whoever should read it has gone
        print(line, file=sys.stderr, flush=True)  # noqa: T201
    return code


def _text(path: object) -> str:
    return os.fsdecode(path) if isinstance(path, bytes) else str(path)


def _prepare_streams() -> None:
    """Make sure that every text can be written to stdout and stderr, whatever their encoding.

    A stream that the shell has closed becomes the null device.
    """
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, Path(os.devnull).open("w", encoding="utf-8"))  # noqa: SIM115
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors=_READABLE)


def _readable(error: UnicodeError) -> tuple[bytes | str, int]:
    """Replace characters that an encoding lacks; bytes of a path that is no UTF-8 stay as they are.

    The error handler of Python's codecs of the name ``_READABLE``.
    """
    if not isinstance(error, UnicodeEncodeError):  # a stream that is also read, as pytest does
        return codecs.replace_errors(error)
    replaced = b""
    for character in error.object[error.start : error.end]:
        if "\udc80" <= character <= "\udcff":  # how Python holds such a byte
            replaced += character.encode("ascii", "surrogateescape")
        else:
            plain = unicodedata.normalize("NFKD", _ASCII.get(character, character))
            replaced += plain.encode("ascii", "ignore") or b"?"
    return replaced, error.end


_READABLE = "readable"
codecs.register_error(_READABLE, _readable)


def _flush(code: int) -> int:
    """Write out what is left; return the exit code, which is 1 where that fails.

    As in `… | head`: what Python would still flush has no reader; an error about it helps nobody.
    """
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError) as error:
            if isinstance(error, OSError) and not isinstance(error, BrokenPipeError):
                _say(f"error: cannot write the output: {error.strerror or error}", code)
            code = code or EXIT_FAILED
            with contextlib.suppress(OSError, ValueError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
    return code


def _is_reader_gone() -> bool:
    """Return True if stdout or stderr is a pipe without a reader."""
    for stream in (sys.stdout, sys.stderr):
        try:
            poll = select.poll()
            poll.register(stream.fileno(), select.POLLOUT)
            if any(event & (select.POLLERR | select.POLLNVAL) for _, event in poll.poll(0)):
                return True
        except (AttributeError, OSError, ValueError):  # no poll here, or the stream is no file
            continue
    return False
