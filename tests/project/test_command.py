"""One clear line and the right exit code, whatever is wrong with a command line."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import pytest
import tyro

from robo_manip_baselines.runs.command import last_value, parse, run_command
from robo_manip_baselines.runs.errors import RequestError


@dataclass(frozen=True)
class Options:
    """Try out a command line."""

    env: Annotated[str, tyro.conf.arg(metavar="ENV"), tyro.conf.Positional]
    """Name of the environment."""
    num_episodes: int = 50
    """Number of episodes."""
    ratio: float = 0.5
    """Proportion."""
    image_codec: Literal["jpeg", "png", "raw"] = "jpeg"
    """Codec of images."""
    out: Path = Path("dataset")
    """Output folder."""
    scripted: bool = False
    """Use the scripted expert."""

    def __post_init__(self) -> None:
        if self.num_episodes < 0:
            raise RequestError(f"num_episodes is 0 or more, not {self.num_episodes}; " + "x" * 200)


EXAMPLE = "python bin/Try.py FeedingEnv --num_episodes 3"


@pytest.mark.parametrize("spelling", ["--num_episodes", "--num-episodes"])
@pytest.mark.parametrize("sign", [" ", "="])
def test_underscores_and_hyphens(spelling: str, sign: str) -> None:
    options = parse(Options, EXAMPLE, args=["A", *f"{spelling}{sign}7".split(), "--scripted"])
    assert options == Options("A", num_episodes=7, scripted=True)


@pytest.mark.parametrize(
    ("args", "parts"),
    [
        ("", ["missing", "ENV", "Name of the environment"]),
        ("A B", ["'B'", "too many"]),
        ("A --nmu_episodes 3", ["'--nmu_episodes'", "mean '--num_episodes'", "--image_codec"]),
        ("A --nmu-episodes=3", ["'--nmu-episodes'", "mean '--num_episodes'"]),
        ("A --zzz", ["unknown option '--zzz'", "--num_episodes, --ratio, --image_codec, --out"]),
        ("A --num_episodes x", ["--num_episodes is a whole number, not 'x'"]),
        ("A --num_episodes " + "9" * 5000, ["--num_episodes is a whole number of fewer digits"]),
        ("A --num_episodes " + "9" * 100, ["num_episodes", "bits: must be of 64 bits"]),
        ("A --ratio nan", ["--ratio nan: must be finite"]),
        ("A --num_episodes 1.5", ["--num_episodes is a whole number, not '1.5'"]),
        ("A --ratio half", ["--ratio is a number, not 'half'"]),
        ("A --num_episodes", ["--num_episodes needs a value"]),
        ("A --image_codec gif", ["--image_codec", "'jpeg', 'png', 'raw'", "not 'gif'"]),
        ("A --out=", ["--out '': is empty"]),
        ("A --out= --ratio 1", ["--out '': is empty", "a variable of the shell"]),
        ("A --num_episodes -3", ["num_episodes is 0 or more, not -3; xxxx"]),
    ],
)
def test_wrong_options_are_one_line(
    args: str, parts: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(RequestError) as caught:
        parse(Options, EXAMPLE, args=args.split())
    message = str(caught.value)
    for part in parts:
        assert part in message
    assert "\n" not in message
    assert not set("│╭╰─\x1b") & set(message)
    output = capsys.readouterr()
    assert (output.out, output.err) == ("", "")


@pytest.mark.parametrize("args", [["A", "--out", ""], ["A", "--out", " "], ["A", "--out= "]])
def test_empty_values_are_refused_by_name(args: list[str]) -> None:
    with pytest.raises(RequestError, match=r"^--out '': is empty; give a value"):
        parse(Options, EXAMPLE, args=args)
    with pytest.raises(RequestError, match=r"^an argument '': is empty"):
        parse(Options, EXAMPLE, args=["", "--out", "a"])


def test_message_of_the_options_comes_through_unbroken() -> None:
    with pytest.raises(RequestError, match=r"^num_episodes is 0 or more, not -1; x{200}$"):
        parse(Options, EXAMPLE, args=["A", "--num_episodes", "-1"])


def test_help_shows_defaults_and_the_example(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        parse(Options, EXAMPLE, args=["--help"])
    assert not caught.value.code
    page = capsys.readouterr().out
    for part in (
        "Try out a command line.",
        EXAMPLE,
        "--num_episodes",
        "default: 50",
        "Number of episodes.",
    ):
        assert part in page


@dataclass(frozen=True)
class First:
    """The first."""

    alpha: int = 1


@dataclass(frozen=True)
class Second:
    """The second."""

    beta: int = 2


BOTH = (
    Annotated[First, tyro.conf.subcommand("first")]
    | Annotated[Second, tyro.conf.subcommand("second")]
)


def test_subcommands() -> None:
    assert parse(BOTH, "x", args=["second", "--beta", "3"]) == Second(3)
    with pytest.raises(RequestError, match=r"'third' is no subcommand.*first, second"):
        parse(BOTH, "x", args=["third"])
    with pytest.raises(RequestError, match=r"Expected one of \{first, second\}"):
        parse(BOTH, "x", args=[])
    with pytest.raises(RequestError, match=r"'--bata' .*mean '--beta'.*valid: --beta;"):
        parse(BOTH, "x", args=["second", "--bata", "3"])


def run(body: str) -> subprocess.CompletedProcess[str]:
    code = (
        "import logging, os, sys, time\n"
        "from robo_manip_baselines.runs.command import run_command\n"
        "from robo_manip_baselines.runs.errors import RequestError\n"
        f"def main():\n    {body}\n"
        "run_command(main)\n"
    )
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    ("body", "code", "out", "err"),
    [
        ("print('done')", 0, "done\n", ""),
        ("return 1", 1, "", ""),
        ("raise SystemExit(3)", 3, "", ""),
        ("raise RequestError('no camera\\n  \"tpo\"')", 2, "", 'error: no camera "tpo"\n'),
        (
            "open('a' * 300)",
            2,
            "",
            f"error: '{'a' * 300}': File name too long; name another path\n",
        ),
        ("raise KeyboardInterrupt", 130, "", "interrupted\n"),
        ("logging.getLogger('x').info('hello')", 0, "", "hello\n"),
    ],
)
def test_exit_codes(body: str, code: int, out: str, err: str) -> None:
    done = run(body)
    assert (done.returncode, done.stdout, done.stderr) == (code, out, err)


@pytest.mark.parametrize(
    ("body", "problem"),
    [
        ("raise ValueError('a bug\\n  in two lines')", "ValueError: a bug in two lines"),
        ("raise MemoryError", "MemoryError"),
        ("main()", "RecursionError: maximum recursion depth exceeded"),
        ("raise KeyError('\\udce9')", "KeyError: '\\udce9'"),
    ],
)
def test_unforeseen_failures_are_one_line_and_a_log_file(
    body: str, problem: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    done = run(body)
    assert done.returncode == 1
    assert done.stderr.startswith(f"error: {problem}")
    assert done.stderr.count("\n") == 1
    (log,) = (tmp_path / "robo_manip_baselines").iterdir()
    assert done.stderr.endswith(f"; the traceback is in '{log}'\n")
    assert "in main\n" in log.read_text()


def test_failures_without_a_place_for_the_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "file"
    file.touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(file))
    done = run("import tempfile; tempfile.tempdir = os.devnull; raise ValueError('a bug')")
    assert done.returncode == 1
    assert done.stderr == "error: ValueError: a bug; no log file could be written\n"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signals_end_a_command(number: signal.Signals) -> None:
    code = (
        "import time\nfrom robo_manip_baselines.runs.command import run_command\n"
        "def main():\n    print('ready', flush=True)\n    time.sleep(60)\nrun_command(main)\n"
    )
    command = [sys.executable, "-c", code]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.readline()
        process.send_signal(number)
        assert process.wait(30) == 130
        assert process.stderr.read() == "interrupted\n"


def test_nohup_outlives_the_terminal() -> None:
    body = "import signal; signal.signal(signal.SIGHUP, signal.SIG_IGN)"
    code = (
        f"import os\n{body}\nfrom robo_manip_baselines.runs.command import run_command\n"
        "def main():\n    os.kill(os.getpid(), signal.SIGHUP)\n    print('lives')\n"
        "run_command(main)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, b"lives\n", b"")


@pytest.mark.parametrize(
    ("encoding", "text", "expected"),
    [
        ("ascii", "0.5 ± 0.1 × 2 – a…b ü 顔 │", b"0.5 +- 0.1 x 2 - a...b u ? |\n"),
        ("latin-1", "± – ü", b"\xb1 - \xfc\n"),
        ("ascii", "caf\udce9", b"caf\xe9\n"),
        ("utf-8", "± caf\udce9", b"\xc2\xb1 caf\xe9\n"),
    ],
)
def test_every_terminal_can_show_every_text(encoding: str, text: str, expected: bytes) -> None:
    code = (
        "import sys\nfrom robo_manip_baselines.runs.command import run_command\n"
        f"def main():\n    print({text!a})\n    print({text!a}, file=sys.stderr)\n"
        "run_command(main)\n"
    )
    environment = {**os.environ, "PYTHONIOENCODING": encoding, "LC_ALL": "C"}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, env=environment, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, expected, expected)


@pytest.mark.skipif(sys.platform != "linux", reason="has no /dev/full")
@pytest.mark.parametrize(
    ("shell", "code", "message"),
    [
        ("> /dev/full", 1, "error: cannot write the output: No space left on device\n"),
        (">&-", 0, ""),
        ("2>&- >&-", 0, ""),
        ("2>&1 | true", 1, ""),
    ],
)
@pytest.mark.parametrize("arguments", ["--help", "train --help"])
def test_output_that_nobody_takes(arguments: str, shell: str, code: int, message: str) -> None:
    line = f"set -o pipefail; {sys.executable} -m face_prediction {arguments} {shell}"
    done = subprocess.run(["bash", "-c", line], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (code, message)


@pytest.mark.parametrize("lines", [1, 100_000])
def test_reader_that_leaves_is_no_traceback(lines: int) -> None:
    code = (
        "import time\nfrom robo_manip_baselines.runs.command import run_command\n"
        f"def main():\n    time.sleep(0.2)\n    for i in range({lines}):\n        print(i)\n"
        "run_command(main)\n"
    )
    reader, writer = os.pipe()
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", code], stdout=writer, stderr=pipe) as process:
        os.close(reader)
        os.close(writer)
        assert process.stderr is not None
        assert process.stderr.read() == b""
        assert process.wait(30) == 1


def test_broken_pipe_elsewhere_is_a_failure_that_is_seen() -> None:
    done = run("raise BrokenPipeError(32, 'a worker died')")
    assert done.returncode == 1
    assert "a worker died" in done.stderr


def test_run_command_always_ends_the_process() -> None:
    with pytest.raises(SystemExit) as caught:
        run_command(lambda: None)
    assert caught.value.code == 0


@pytest.mark.parametrize(
    ("line", "value"),
    [
        ("", None),
        ("--out a", None),
        ("--error_stats a", "a"),
        ("--error-stats=a=b", "a=b"),
        ("--error_stats a --error_stats b --out c", "b"),
        ("--error_stats --out c", None),
        ("--out c --error_stats", None),
    ],
)
def test_the_last_value_of_an_option(line: str, value: str | None) -> None:
    assert last_value(line.split(), "error_stats") == value
