"""Hook of MkDocs: navigation from ``docs/README.md``, start page, reference of commands and API.

``docs/README.md`` stays the only list of pages: a bold line begins a section of the site, and the
links of the list below it are its pages. The start page is the project's ``README.md``.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import sys
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

if TYPE_CHECKING:  # the package is an extra
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.files import Files
    from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parent.parent

START, CHANGES = "start.md", "changes.md"
COMMANDS, API = "reference/commands.md", "reference/api.md"

LINK = re.compile(r"\[([^\]]+)\]\(([^)#\s]+\.md)(#[^)\s]*)?\)")
SECTION = re.compile(r"\*\*(.+?)\*\*")

API_MODULES = {
    "Tasks": "robo_manip_baselines.envs.mujoco.tasks.registry",
    "FeedingEnv": "robo_manip_baselines.envs.mujoco.tasks.feeding.env",
    "Base of all tasks": "robo_manip_baselines.envs.mujoco.tasks.face_env",
    "Motions by name": "robo_manip_baselines.envs.mujoco.face.motions",
    "Observation specification": "robo_manip_baselines.observation.spec",
    "Observation corruption": "robo_manip_baselines.observation.corruption",
    "Episode files": "robo_manip_baselines.data.episode",
    "Interface of policies": "robo_manip_baselines.policy.interface",
    "Registry of policies": "robo_manip_baselines.policy.registry",
    "Execution of policies": "robo_manip_baselines.policy.execution",
    "Evaluation": "robo_manip_baselines.rollout.evaluation",
    "Predictors of faces": "face_prediction.prediction.interface",
}
"""Titles -> modules that users build on."""

SEARCH_SHIM = "https://unpkg.com/iframe-worker/shim"
"""Address from which Material's plugin ``offline`` would load it."""

os.environ["COLUMNS"] = "80"  # of the pages of help


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Make the navigation."""
    sections = read_sections((ROOT / "docs" / "README.md").read_text())
    for title, pages in sections.items():
        if title == "To read results and reasons":
            sections[title] = [page for index in pages for page in with_subpages(index)]
    config.nav = [
        {"Start": START},
        {"Documentation": "README.md"},
        *({title.removeprefix("To ").capitalize(): pages} for title, pages in sections.items()),
        {"Reference": [{"Commands": COMMANDS}, {"API": API}, {"Changes": CHANGES}]},
    ]
    return config


def read_sections(text: str) -> dict[str, list[str]]:
    """Return the pages under each bold line of a list of pages; a page is listed where it is first.

    Args:
        text: Markdown.
    """
    sections: dict[str, list[str]] = {}
    listed: set[str] = set()
    pages: list[str] = []
    for line in text.splitlines():
        if heading := SECTION.fullmatch(line.strip()):
            pages = sections.setdefault(heading[1], [])
        for _, page, _ in LINK.findall(line):
            if sections and page not in listed and not page.startswith(".."):
                listed.add(page)
                pages.append(page)
    return sections


def with_subpages(index: str) -> list[Any]:
    """Return an index page with the pages of the folder that it is in, for the navigation."""
    folder = ROOT / "docs" / Path(index).parent
    if folder.name not in ("results", "decisions"):
        return [index]
    found = sorted(folder.glob("*/README.md")) + sorted(folder.glob("[0-9]*.md"))
    pages = [index, *(path.relative_to(ROOT / "docs").as_posix() for path in found)]
    return [{folder.name.capitalize(): pages}]


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages."""
    from mkdocs.structure.files import File

    start = without_folder((ROOT / "README.md").read_text())
    start = start.replace("](CHANGELOG.md)", f"]({CHANGES})")
    pages = {
        START: re.sub(r"\[([^\]]+)\]\(LICENSE\)", r"\1", start),
        CHANGES: without_folder((ROOT / "CHANGELOG.md").read_text()),
        COMMANDS: commands_page(),
        API: api_page(),
    }
    for name, content in pages.items():
        files.append(File.generated(config, name, content=content))
    return files


def without_folder(text: str) -> str:
    """Return Markdown of the project's root with links as from ``docs/``."""
    return text.replace("](docs/", "](")


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Let links to the project's README lead to the start page."""
    return re.sub(r"\]\((?:\.\./)*\.\./README\.md", f"]({START}", markdown)


def on_post_page(output: str, page: Page, **_: Any) -> str:
    """Let search, in pages that are opened as files, use the script that lies with the site.

    Raises:
        PluginError: the page loads anything else from the network.
    """
    from mkdocs.exceptions import PluginError

    to_root = "../" * page.url.count("/")
    output = output.replace(SEARCH_SHIM, f"{to_root}assets/iframe-worker.js")
    if found := re.search(r'src="https?://[^"]*', output):
        raise PluginError(f"{page.url} loads {found[0]} from the network")
    return output


def api_page() -> str:
    """Return the page that lists the documented modules."""
    parts = [
        f"## {title}\n\n::: {module}\n    options: {{heading_level: 3}}\n"
        for title, module in API_MODULES.items()
    ]
    intro = (
        "# API\n\nGenerated from the docstrings. Shapes, units and frames are in each of them.\n\n"
    )
    return intro + "\n".join(parts)


def commands_page() -> str:
    """Return the ``--help`` of every command, which its options' dataclass generates."""
    from face_prediction.commands.cli import COMMANDS as FACE_COMMANDS
    from robo_manip_baselines.commands.dataset import COMMANDS as DATASET_COMMANDS
    from robo_manip_baselines.policy.registry import policy_names

    dataset_names = [command.__name__.lower() for command in get_args(DATASET_COMMANDS)]
    subcommands = {"Train": policy_names(), "Dataset": dataset_names, "Benchmark": ["foresight"]}
    pages = ["# Commands\n\nGenerated from the options of the commands themselves.\n"]
    for script in sorted((ROOT / "bin").glob("*.py")):
        main = import_module(f"robo_manip_baselines.commands.{script.stem.lower()}").main
        for names in [[], *([name] for name in subcommands.get(script.stem, []))]:
            pages.append(help_section(f"bin/{script.name}", main, names))
    face_main = import_module("face_prediction.commands.cli").main
    for names in [[], *([name] for name in FACE_COMMANDS)]:
        pages.append(help_section("face-prediction", face_main, names))
    return "\n".join(pages)


def help_section(program: str, main: Callable[[list[str]], object], names: list[str]) -> str:
    """Return a section with the help of a command or, with its name, of a subcommand."""
    page = io.StringIO()
    with contextlib.redirect_stdout(page), contextlib.suppress(SystemExit):
        main([*names, "--help"])
    text = re.sub(r"\x1b\[[0-9;]*m", "", page.getvalue()).strip()
    text = text.replace(sys.argv[0], program)
    level = "###" if names else "##"
    return f"{level} {' '.join([program, *names])}\n\n```text\n{text}\n```\n"
