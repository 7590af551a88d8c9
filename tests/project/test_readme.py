"""Commands, options, paths, links and Python in README.md and docs/ work."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image

from robo_manip_baselines.envs.mujoco.tasks.feeding import ENTRY
from robo_manip_baselines.observation import PRESETS

FENCE = re.compile(r"^```(\w+)\n(.*?)^```$", flags=re.MULTILINE | re.DOTALL)
INLINE = re.compile(r"`([^`\n]+)`")
LINK = re.compile(r"!?\[[^\]]*\]\(([^)#\s]+)(?:#[^)]*)?\)")
COMMAND = re.compile(r"(python bin/|face-prediction |make )\S+")


FIRST_PAGES = ("installation", "environments", "datasets", "examples")
"""Pages of docs/ whose commands and programs are tested as those of the README."""

MAX_LINES = 150
MAX_ANIMATION = 2_000_000  # bytes: it is loaded by everybody who looks at the project


@pytest.fixture(scope="module")
def readme(repository: Path) -> str:
    """Return the README and the pages that it leads to first, one after another."""
    pages = [repository / "README.md", *(repository / "docs" / f"{n}.md" for n in FIRST_PAGES)]
    return "\n\n".join(page.read_text(encoding="utf-8") for page in pages)


def test_the_readme_is_short_and_begins_with_an_animation(repository: Path) -> None:
    text = (repository / "README.md").read_text(encoding="utf-8")
    assert len(text.splitlines()) < MAX_LINES
    first = repository / LINK.findall(text)[0]
    assert first.suffix == ".webp"
    assert first.stat().st_size < MAX_ANIMATION
    with Image.open(first) as animation:
        assert getattr(animation, "n_frames", 1) > 50
    for page in FIRST_PAGES:
        assert f"docs/{page}.md" in text


def fenced(text: str, language: str) -> list[str]:
    return [body for name, body in FENCE.findall(text) if name == language]


def commands(text: str) -> list[list[str]]:
    """Words of every command in a bash block or between backticks."""
    blocks = [block.replace("\\\n", " ") for block in fenced(text, "bash")]
    lines = [line for block in blocks for line in block.splitlines()]
    prose = FENCE.sub("", text)
    lines += [code for code in INLINE.findall(prose) if COMMAND.match(code)]
    return [words for line in lines if (words := shlex.split(line, comments=True))]


def run(*words: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("MAKE", "MFLAGS"))}
    return subprocess.run(
        words, cwd=cwd, env=environment, capture_output=True, text=True, check=False
    )


def test_readme_names_the_commands_of_the_data_flow(readme: str) -> None:
    named = {" ".join(words[:3]) for words in commands(readme)}
    for start in (
        "make demo",
        "make test",
        "make wheelhouse PYTHON=3.12",
        "face-prediction extract clips/*.mp4",
        "python bin/Rollout.py FeedingEnv",
        "python bin/Dataset.py verify",
    ):
        assert start in named


def test_make_targets_exist(readme: str, repository: Path) -> None:
    targets = {words[1] for words in commands(readme) if words[0] == "make" and len(words) > 1}
    assert {"demo", "test", "check", "test-fast", "wheelhouse"} <= targets
    for target in sorted(targets):
        result = run("make", "--dry-run", target, cwd=repository)
        assert result.returncode == 0, result.stderr


@pytest.mark.long
def test_every_option_of_a_command_is_in_its_help(readme: str, repository: Path) -> None:
    checked = 0
    for words in commands(readme):
        if words[0] == "python" and words[1].startswith("bin/"):
            program = [words[1]]
            arguments = words[2:]
        elif words[0] == "face-prediction":
            program = ["-m", "face_prediction"]
            arguments = words[1:]
        else:
            continue
        subcommand = arguments[:1] if "Rollout" not in words[1] and "Replay" not in words[1] else []
        result = run(sys.executable, *program, *subcommand, "--help", cwd=repository)
        assert result.returncode == 0, (words, result.stderr)
        for option in (word for word in arguments if word.startswith("--")):
            assert re.search(rf"{option}\b", result.stdout), (words, option)
        checked += 1
    assert checked >= 6


def first_column(text: str, heading: str) -> set[str]:
    """Names in backticks at the start of the rows of a table below ``heading``."""
    section = text.partition(f"## {heading}\n")[2].partition("\n## ")[0]
    return set(re.findall(r"^\| `(\w+)`", section, flags=re.MULTILINE))


def test_tables_list_what_there_is(readme: str) -> None:
    assert first_column(readme, "Observations") == set(PRESETS)
    assert first_column(readme, "Experts") == set(ENTRY.experts)


@pytest.mark.gl
def test_python_in_the_readme_runs(readme: str, repository: Path, tmp_path: Path) -> None:
    snippets = fenced(readme, "python")
    assert len(snippets) >= 2
    for number, snippet in enumerate(snippets):
        script = tmp_path / f"snippet_{number}.py"
        script.write_text(snippet, encoding="utf-8")
        result = run(sys.executable, "-W", "error", str(script), cwd=tmp_path)
        assert result.returncode == 0, result.stderr
        assert result.stdout.strip()


def documents(project_files: list[Path]) -> list[Path]:
    return [f for f in project_files if f.suffix == ".md"]


def test_links_lead_somewhere(repository: Path, project_files: list[Path]) -> None:
    broken = [
        f"{page}: {target}"
        for page in documents(project_files)
        for target in LINK.findall((repository / page).read_text(encoding="utf-8"))
        if not target.startswith(("http:", "https:"))
        and not (repository / page.parent / target).exists()
    ]
    assert broken == []


def test_paths_in_backticks_exist(repository: Path, project_files: list[Path]) -> None:
    """Every path below a folder of the repository that a page names exists."""
    ours = re.compile(r"^(?:robo_manip_baselines|face_prediction|tests|docs|bin|benchmarks|\.ci)/")
    missing = [
        f"{page}: {code}"
        for page in documents(project_files)
        for code in INLINE.findall(FENCE.sub("", (repository / page).read_text(encoding="utf-8")))
        if re.fullmatch(r"[\w./-]+\.\w+", code)
        and ours.match(code)
        and not (repository / code).exists()
    ]
    assert missing == []


def test_every_page_is_in_the_index(repository: Path, project_files: list[Path]) -> None:
    for folder in (Path("docs"), Path("docs/decisions")):
        index = (repository / folder / "README.md").read_text(encoding="utf-8")
        linked = {(folder / target).as_posix() for target in LINK.findall(index)}
        pages = {f.as_posix() for f in documents(project_files) if f.parent == folder}
        assert pages - {(folder / "README.md").as_posix()} <= linked


def test_images_are_used(repository: Path, project_files: list[Path]) -> None:
    used = {
        os.path.normpath(page.parent / target)
        for page in documents(project_files)
        for target in LINK.findall((repository / page).read_text(encoding="utf-8"))
    }
    suffixes = (".png", ".webp")
    images = {str(f) for f in project_files if f.parts[0] == "docs" and f.suffix in suffixes}
    assert images <= used
