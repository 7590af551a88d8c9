"""No command writes over what it did not make, or over what it reads: refused before any work."""

from __future__ import annotations

import os
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from face_prediction.commands import cli
from robo_manip_baselines.rollout.videos import VideoWriter
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.files import (
    FileKind,
    FolderKind,
    locked,
    locked_file,
    require_out_file,
    require_out_folder,
)
from robo_manip_baselines.runs.videos import METADATA, require_own_video

FILES = {
    "Replay.py": "replay IN --video OUT",
    "export-motion": "export-motion IN --out OUT",
    "export-motion --report": "export-motion IN --out library.npz --report OUT",
    "export-surface": "export-surface IN --out OUT",
    "export-stats": "export-stats --dataset folder --library IN --out OUT",
    "predict": "predict IN --attribution other --dataset folder --out OUT",
    "live": "live --video IN --out OUT",
}
"""Command lines that write a file OUT; they read IN."""

FOLDERS = {
    "Rollout.py": "rollout FeedingEnv --scripted --out OUT",
    "Train.py": "train Mlp --dataset IN --logger none --out OUT",
    "Benchmark.py": "benchmark feeding --preset smoke --out OUT",
    "build-dataset": "build-dataset tracks --videos IN --out OUT",
    "evaluate": "evaluate --dataset IN --out OUT",
    "train": "train simple_fusion --dataset IN --out OUT",
    "fit": "fit --dataset IN --out OUT",
}
"""Command lines that write a folder OUT; they read the folder IN, where there is one."""


def call(line: str, given: Path, out: str) -> None:
    words = [{"IN": str(given), "OUT": out}.get(word, word) for word in line.split()]
    if words[0] in cli.COMMANDS and words[1] != "Mlp":
        cli.main(words)
    else:
        import_module(f"robo_manip_baselines.commands.{words[0]}").main(words[1:])


def content(folder: Path) -> dict[str, bytes | str | None]:
    """Every path below a folder with its bytes, its link, or None for a folder or a pipe."""
    return {
        str(path.relative_to(folder)): str(path.readlink())
        if path.is_symlink()
        else path.read_bytes()
        if path.is_file()
        else None
        for path in folder.rglob("*")
    }


def write_video(path: Path) -> None:
    with VideoWriter(path, 25) as video:
        for _ in range(2):
            video.write(np.zeros((32, 32, 3), np.uint8))


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A video that is ours."""
    path = tmp_path_factory.mktemp("video") / "a.mp4"
    write_video(path)
    return path.read_bytes()


@pytest.fixture
def there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, video: bytes) -> Path:
    """The current folder, with inputs and things that somebody else has made."""
    monkeypatch.chdir(tmp_path)
    for folder in ("folder", "tracks", "full"):
        (tmp_path / folder).mkdir()
    (tmp_path / "tracks" / "a.npz").write_bytes(b"a track")
    (tmp_path / "full" / "notes.txt").write_text("notes")
    (tmp_path / "full" / "config.yaml").write_text("# mine\nsteps: 2\n")
    (tmp_path / "full" / "results.json").write_text('{"mine": 1}')
    (tmp_path / "full" / "summary.json").write_text("{}")
    (tmp_path / "in.mp4").write_bytes(video)
    (tmp_path / "other").write_text("clip,subject,ship,licence,source\na,a,yes,MIT,x\n")
    (tmp_path / "link.mp4").symlink_to("in.mp4")
    (tmp_path / "hard.mp4").hardlink_to(tmp_path / "in.mp4")
    for suffix in (".mp4", ".npz", ".json", ".md"):
        (tmp_path / f"foreign{suffix}").write_text("notes")
        (tmp_path / f"episode{suffix}").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(99))
        # a video without our metadata
        (tmp_path / f"video{suffix}").write_bytes(
            video.replace(METADATA["comment"].encode(), b"x" * len(METADATA["comment"]))
        )
    os.mkfifo(tmp_path / "pipe.mp4")
    return tmp_path


SUFFIXES = {"export-motion --report": ".md", "export-stats": ".json"} | dict.fromkeys(
    ("Replay.py", "live"), ".mp4"
)


@pytest.mark.parametrize("command", FILES)
@pytest.mark.parametrize(
    ("out", "message"),
    [
        ("in.mp4", "."),
        ("link.mp4", "."),
        ("hard.mp4", "."),
        ("foreign*", "."),
        ("episode*", "."),
        ("video*", "."),
        ("folder", "folder: is a folder; name a file"),
        (".", r"\.: is a folder; name a file"),
        ("", "'': is empty"),
        ("foreign.mp4/x*", "'foreign.mp4' is no folder"),
        ("pipe.mp4", "a device or a pipe"),
        ("/dev/null", "a device or a pipe"),
        ("/proc/x*", "cannot write to '/proc/x"),
        ("a" * 300 + "*", "File name too long"),
    ],
)
def test_a_file_in_the_way_stays(there: Path, command: str, out: str, message: str) -> None:
    before = content(there)
    out = out.replace("*", SUFFIXES.get(command, ".npz"))
    given = there / ("tracks" if command == "export-motion --report" else "in.mp4")
    with pytest.raises(RequestError, match=message) as caught:
        call(FILES[command], given, out)
    assert "\n" not in str(caught.value)
    assert content(there) == before


@pytest.mark.parametrize("command", ["export-motion", "export-surface", "predict"])
def test_nothing_is_written_among_the_inputs(there: Path, command: str) -> None:
    before = content(there)
    with pytest.raises(RequestError, match=r"tracks/b\.npz: is in '.*tracks', which is read"):
        call(FILES[command], there / "tracks", "tracks/b.npz")
    assert content(there) == before


@pytest.mark.parametrize("command", FOLDERS)
@pytest.mark.parametrize(
    ("out", "message"),
    [
        ("full", "full: holds config.yaml, notes.txt, results.json, |full/results.json|full: is"),
        ("tracks", r"tracks: holds a\.npz|tracks: is read"),
        ("other", "other: is a file; name a folder"),
        ("other/x", "'other' is no folder"),
        ("", "'': is empty"),
        (".", "holds"),
        ("/dev/null", "is a file"),
        ("pipe.mp4", "is a file"),
        ("/proc/x", "cannot write to '/proc/x"),
        ("a" * 300, "File name too long"),
    ],
)
def test_a_folder_in_the_way_stays(there: Path, command: str, out: str, message: str) -> None:
    before = content(there)
    with pytest.raises(RequestError, match=message) as caught:
        call(FOLDERS[command], there / "full", out)
    assert "\n" not in str(caught.value)
    assert content(there) == before


def test_a_glob_does_not_name_the_video(there: Path) -> None:
    names = [f"episode_{number:06d}.hdf5" for number in range(3)]
    for name in names:
        (there / name).write_text("an episode")
    before = content(there)
    with pytest.raises(RequestError, match=r"name an \.mp4 file"):
        import_module("robo_manip_baselines.commands.replay").main(["--video", *names])
    assert content(there) == before


def test_what_a_command_has_made_it_replaces(there: Path, video: bytes) -> None:
    require_own_video(there / "in.mp4")
    kind = FileKind("video", require_own_video, ".mp4")
    require_out_file(there / "in.mp4", kind)
    require_out_file(there / "new" / "a.mp4", kind)
    own = FolderKind("demo", lambda folder: (folder / "notes.txt").exists())
    require_out_folder(there / "full", own)
    require_out_folder(there / "folder", own)
    with pytest.raises(RequestError, match=r"holds a\.npz and no demo; name another folder"):
        require_out_folder(there / "tracks", own)
    assert not (there / "new").exists()


@pytest.mark.parametrize("hold", [locked, locked_file])
def test_a_lock_leaves_nothing_after_a_refused_request(
    there: Path, hold: Callable[..., object]
) -> None:
    before = content(there)
    with (
        pytest.raises(RequestError, match="no camera"),
        hold(there / "new" / "x"),  # pyright: ignore[reportGeneralTypeIssues]
    ):
        raise RequestError("no camera")
    assert content(there) == before
    with (
        locked_file(there / "a"),
        pytest.raises(RequestError, match="being written by another process"),
        locked_file(there / "a"),
    ):
        pass
    assert content(there) == before
