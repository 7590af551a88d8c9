"""Command lines: options parsed into dataclasses, errors as one line, exit codes.

Exit codes: 0 done, 1 something failed that was not the user's doing, 2 the request was wrong,
130 interrupted.
"""

from __future__ import annotations

import contextlib
import difflib
import inspect
import io
import logging
import os
import re
import select
import sys
import traceback
from collections.abc import Callable, Sequence
from typing import Any, NoReturn, TypeVar, cast, overload

import tyro

from robo_manip_baselines.runs.errors import RequestError

Options = TypeVar("Options")

EXIT_FAILED = 1
EXIT_WRONG_REQUEST = 2
EXIT_INTERRUPTED = 130  # 128 + SIGINT, as shells report it

_ANSI = re.compile(r"\x1b\[[0-9;]*m")
_BOX = re.compile(r"^[\s│|╭╰┌└+]+|[\s│|╮╯┐┘+]+$")
_RULE = re.compile(r"[\s│|╭╰╮╯┌┐└┘+─-]*")
_PLAINER = (
    (
        r"Error parsing (\S+): invalid literal for int\(\).*: ('.*')",
        r"\1 is a whole number, not \2",
    ),
    (r"Error parsing (\S+): could not convert string to float: ('.*')", r"\1 is a number, not \2"),
    (r"Error parsing (\S+): ", r"\1: "),
    (
        r"Missing value for argument '?\(?'([^\s',]+)',?\)?'?\. Expected \d+ values?",
        r"\1 needs a value",
    ),
    (r"Missing from \S+?: ", "missing: "),
    (r" \(required\)", ""),
    (
        r"invalid choice '(.*)' for argument '(.*)'. Expected one of \((.*)\)",
        r"\2 is one of \3, not '\1'",
    ),
)
_OPTION = re.compile(r"(?<![\w-])--[a-z][\w-]*")


def run_command(
    main: Callable[[], int | None], explain: Callable[[Exception], str | None] | None = None
) -> NoReturn:
    """Run ``main`` and end the process with the matching exit code.

    A `RequestError` becomes one line on stderr, without a traceback.

    Args:
        main: the command; returns the exit code, None being 0.
        explain: returns the line for an exception whose cause is the request, else None.

    Raises:
        SystemExit: always.
    """
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    # PyOpenGL tells every user that an accelerator, which nothing here needs, is not installed.
    logging.getLogger("OpenGL").setLevel(logging.WARNING)
    try:
        code = main() or 0
        sys.stdout.flush()
    except RequestError as error:
        code = _say(f"error: {_one_line(error)}", EXIT_WRONG_REQUEST)
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
        else:
            traceback.print_exc()
            code = EXIT_FAILED
    if _is_reader_gone():
        # As in `… | head`: what Python would still flush has no reader; an error about it helps
        # nobody.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    sys.exit(code)


@overload
def parse(
    options_type: type[Options],
    example: str,
    *,
    description: str | None = None,
    args: Sequence[str] | None = None,
    default: Options | None = None,
) -> Options: ...


@overload
def parse(
    options_type: Any,
    example: str,
    *,
    description: str | None = None,
    args: Sequence[str] | None = None,
    default: Any = None,
) -> Any: ...


def parse(
    options_type: Any,
    example: str,
    *,
    description: str | None = None,
    args: Sequence[str] | None = None,
    default: Any = None,
) -> Any:
    """Read the command line into ``options_type``.

    ``--help`` prints every option with its default, and the example. Options have
    underscores; hyphens work too.

    Args:
        options_type: a dataclass, or a union of dataclasses for subcommands. A `RequestError`
            from its ``__post_init__`` passes through unchanged.
        example: a command line that works, shown at the end of the description.
        description: first words of the help; by default the docstring of ``options_type``.
        args: instead of ``sys.argv[1:]``.
        default: an instance whose values are the defaults, instead of those of ``options_type``.

    Raises:
        RequestError: one line that names what was wrong and what is valid.
        SystemExit: with code 0 after ``--help``.
    """
    given = list(sys.argv[1:] if args is None else args)
    text = description or inspect.getdoc(options_type) or ""
    text = f"{text.strip()}\n\nExample: {example}"
    result, unknown = _call_tyro(options_type, text, given, default)
    if unknown:
        raise RequestError(_unknown_message(unknown, options_type, text, given, default))
    return result


def _call_tyro(
    options_type: Any, description: str, args: Sequence[str], default: Any
) -> tuple[Any, list[str]]:
    errors = io.StringIO()
    try:
        with contextlib.redirect_stderr(errors):
            return cast(
                "tuple[Any, list[str]]",
                tyro.cli(
                    options_type,
                    description=description,
                    args=args,
                    **({} if default is None else {"default": default}),
                    use_underscores=True,
                    return_unknown_args=True,
                    config=(tyro.conf.OmitSubcommandPrefixes,),
                ),
            )
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
        raise RequestError(f"{message}; {_help_hint()}") from None


def _unknown_message(
    unknown: Sequence[str],
    options_type: Any,
    description: str,
    args: Sequence[str],
    default: Any,
) -> str:
    known = _known_options(
        options_type, description, [a for a in args if a not in unknown], default
    )
    name = next((arg for arg in unknown if arg.startswith("-")), unknown[0])
    if not name.startswith("-"):
        return f"'{name}' is one argument too many; {_help_hint()}"
    name = name.split("=")[0]
    close = difflib.get_close_matches(name.replace("-", "_"), [k.replace("-", "_") for k in known])
    hint = f" (did you mean '--{close[0].lstrip('_')}'?)" if close else ""
    return f"unknown option '{name}'{hint}; valid: {', '.join(known)}; {_help_hint()}"


def _known_options(
    options_type: Any, description: str, args: Sequence[str], default: Any
) -> list[str]:
    """The options that ``--help`` lists after ``args``, which may hold a subcommand."""
    page = io.StringIO()
    with contextlib.redirect_stdout(page), contextlib.suppress(SystemExit, RequestError):
        _call_tyro(options_type, description.split("\n\nExample:")[0], [*args, "--help"], default)
    names = _OPTION.findall(_ANSI.sub("", page.getvalue()))
    return list(dict.fromkeys(name for name in names if name != "--help"))


def _box_to_line(text: str) -> str:
    """Extract the message from tyro's box: no box, help text or footer."""
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


def _help_hint() -> str:
    return f"'{sys.argv[0]} --help' lists what is valid"


def _one_line(message: object) -> str:
    return " ".join(str(message).split())


def _say(line: str, code: int) -> int:
    print(line, file=sys.stderr)  # noqa: T201
    return code


def _is_reader_gone() -> bool:
    """Return whether stdout is a pipe without a reader."""
    try:
        poll = select.poll()
        poll.register(sys.stdout.fileno(), select.POLLOUT)
        return any(event & (select.POLLERR | select.POLLNVAL) for _, event in poll.poll(0))
    except (AttributeError, OSError, ValueError):  # no poll here, or stdout is no file
        return False
