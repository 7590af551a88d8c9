"""``export-motion`` from the command line: tracks and a table in, a library and a report out."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from face_prediction.motion import report
from face_prediction.motion.library import load_motion, save_motion
from face_prediction.motion.report import BEGIN, END
from face_prediction.tracking.tracks import save_track

pytestmark = pytest.mark.long

TABLE = """clip,subject,ship,licence,source
steady.mp4,ann,yes,MIT,here
lively.mp4,bob,yes,CC BY 4.0,there
secret.mp4,eve,no,unknown,elsewhere
"""


def sway(frames: int, amplitude: float) -> np.ndarray:
    time = np.arange(frames)[:, None] / 30
    return np.array([0.0, 0.0, -0.5]) + amplitude * np.sin(2 * np.pi * time * [0.5, 0.3, 0.2])


@pytest.fixture
def folder(tmp_path: Path, make_track) -> Path:
    tracks = tmp_path / "tracks"
    valid = np.ones(200, dtype=bool)
    valid[100] = False
    save_track(tracks / "steady.npz", make_track(sway(100, 0.0), name="steady.mp4"))
    save_track(tracks / "lively.npz", make_track(sway(200, 0.02), valid=valid, name="lively.mp4"))
    save_track(tracks / "secret.npz", make_track(sway(100, 0.02), name="secret.mp4"))
    (tmp_path / "clips.csv").write_text(TABLE)
    return tmp_path


@pytest.fixture
def run(folder: Path, caplog, exit_code):
    caplog.set_level(logging.INFO)

    def export(*arguments: object, tracks: Path | None = None, min_run: float = 1) -> int:
        words = ["export-motion", str(tracks or folder / "tracks"), *map(str, arguments)]
        return exit_code([*words, "--out", str(folder / "motion.npz"), "--min_run", str(min_run)])

    return export


def test_only_clips_that_may_ship_are_in_the_library(folder: Path, run) -> None:
    assert run("--attribution", folder / "clips.csv") == 0
    library = load_motion(folder / "motion.npz")
    assert library.run_clip.tolist() == ["lively", "lively", "steady"]
    assert library.run_subject.tolist() == ["bob", "bob", "ann"]
    assert library.run_length.tolist() == [100, 99, 100]
    assert "secret" not in str(library.metadata)
    assert library.metadata["withheld_clips"] == 1
    assert library.metadata["attribution"]["lively"] == {
        "subject": "bob", "licence": "CC BY 4.0", "source": "there",
    }  # fmt: skip
    assert library.metadata["clips"]["lively"]["no_face"] == 1
    assert library.metadata["settings"]["min_run"] == 1.0
    assert "63 degrees" in library.metadata["camera_model"]
    assert library.metadata["detectors"] == [{"name": "synthetic", "settings": {"zoom": False}}]


def test_the_same_tracks_give_the_same_file(folder: Path, run) -> None:
    files = []
    for _ in range(2):
        assert run("--attribution", folder / "clips.csv") == 0
        with np.load(folder / "motion.npz") as stored:
            files.append({key: stored[key].tolist() for key in stored.files})
    assert files[0] == files[1]


def test_a_split_of_the_people_is_stored(folder: Path, run, caplog) -> None:
    table = ("--attribution", folder / "clips.csv", "--test_people")
    assert run(*table, "ann") == 0
    people = load_motion(folder / "motion.npz").metadata["people"]
    assert people == {"train": ["bob"], "test": ["ann"]}
    assert run(*table, "eve") == 2
    assert "unknown subject 'eve'; valid: ann, bob" in caplog.text
    assert run(*table, "ann", "bob") == 2
    assert "names everybody; leave somebody for demonstrations" in caplog.text


def test_without_a_table_nothing_is_claimed(folder: Path, run) -> None:
    assert run() == 0
    attribution = load_motion(folder / "motion.npz").metadata["attribution"]
    assert {row["licence"] for row in attribution.values()} == {"not stated"}


def test_the_report(folder: Path, run) -> None:
    page = folder / "docs" / "page.md"
    page.parent.mkdir()
    page.write_text(f"# Title\n\n{BEGIN}\nold\n{END}\n\nlast line\n")
    assert run("--attribution", folder / "clips.csv", "--report", page) == 0
    text = page.read_text()
    assert text.startswith("# Title\n")
    assert text.endswith("\n\nlast line\n")
    assert "old" not in text
    # two runs of (100 - 1) + (99 - 1) steps, and one of 99, at 30 a second
    assert "9.9 s of continuous motion in 3 runs, of 2 people" in text
    assert "| lively | 200 | 199 | 1 | 0 | 0 | 0 | 0 | 0 |" in text
    assert "| steady | MIT | here |" in text
    for clip in ("lively", "steady"):
        picture = page.parent / "images" / f"motion_{clip}.png"
        assert picture.read_bytes().startswith(b"\x89PNG")
        assert picture.stat().st_size < 80_000
        assert f"(images/motion_{clip}.png)" in text


def test_a_report_that_was_killed_is_written_again(folder: Path, run, monkeypatch) -> None:
    page = folder / "page.md"
    arguments = ("--attribution", folder / "clips.csv", "--report", page)
    write = report.atomic_file

    @contextmanager
    def killed(path: Path) -> Iterator[Path]:
        if path.name == "motion_steady.png":
            raise KeyboardInterrupt
        with write(path) as temporary:
            yield temporary

    with monkeypatch.context() as patch:
        patch.setattr(report, "atomic_file", killed)
        assert run(*arguments) == 130
    assert [path.name for path in (folder / "images").iterdir()] == ["motion_lively.png"]
    assert run(*arguments) == 0
    assert len(list((folder / "images").iterdir())) == 2


def test_a_plot_that_a_report_no_longer_shows_is_removed(folder: Path, make_track, run) -> None:
    save_track(folder / "tracks" / "steady.npz", make_track(sway(60, 0.0), name="steady.mp4"))
    arguments = ("--attribution", folder / "clips.csv", "--report", folder / "page.md")
    for min_run, plots in ((1, {"steady", "lively"}), (3, {"lively"}), (3, {"lively"})):
        assert run(*arguments, min_run=min_run) == 0
        found = {path.name for path in (folder / "images").iterdir()}
        assert found == {f"motion_{name}.png" for name in plots}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--attribution", "absent.csv"), "absent.csv: cannot be read"),
        (("--min_run", "-1"), "--min_run -1.0: must be more than 0, and finite"),
        (("--max_displacement", "0"), "--max_displacement 0.0: must be more than 0, and finite"),
        (("--max_rotation", "nan"), "--max_rotation nan: must be more than 0, and finite"),
        (("--depth_cutoff", "0"), "--depth_cutoff 0.0: must be more than 0, and finite"),
        (("--min_run", "100"), "no run is long enough"),
    ],
)
def test_bad_requests(folder: Path, caplog, exit_code, arguments, message) -> None:
    caplog.set_level(logging.INFO)
    words = ["export-motion", str(folder / "tracks"), "--out", str(folder / "m.npz"), *arguments]
    assert exit_code(words) == 2
    assert message in caplog.text
    assert len(caplog.messages) == 1
    assert not (folder / "m.npz").exists()


def test_tracks_that_are_not_there(folder: Path, run, caplog) -> None:
    assert run(tracks=folder / "absent") == 2
    (folder / "empty").mkdir()
    assert run(tracks=folder / "empty") == 2
    assert run(folder / "tracks") == 2  # the same folder twice
    assert [text.split(": ", 2)[-1] for text in caplog.messages][:2] == [
        "no such file or folder; make tracks with extract",
        "no .npz file in it; make tracks with extract",
    ]
    assert "two tracks named" in caplog.messages[2]


def test_a_clip_without_a_row(folder: Path, run, caplog) -> None:
    (folder / "clips.csv").write_text(TABLE.replace("lively", "other"))
    assert run("--attribution", folder / "clips.csv") == 2
    assert "no row for 'lively'" in caplog.text


def test_a_damaged_track_is_named(folder: Path, run, caplog) -> None:
    path = folder / "tracks" / "steady.npz"
    path.write_bytes(path.read_bytes()[:2000])
    assert run("--attribution", folder / "clips.csv") == 2
    assert "steady.npz: damaged" in caplog.text


def test_other_files_are_not_overwritten(folder: Path, run, caplog) -> None:
    (folder / "motion.npz").write_text("precious")
    assert run() == 2
    assert (folder / "motion.npz").read_text() == "precious"
    assert "in the way" in caplog.text
    page = folder / "page.md"
    page.write_text("a page without marks")
    (folder / "motion.npz").unlink()
    assert run("--report", page) == 2
    assert page.read_text() == "a page without marks"
    assert not (folder / "motion.npz").exists()


def test_a_clip_of_which_nothing_can_be_lifted(folder: Path, make_track, run) -> None:
    """A face found in one decoded frame alone, between two of the track, or seen from the side."""
    lost = make_track(sway(100, 0.0), valid=np.zeros(100, dtype=bool), name="lost.mp4")
    save_track(folder / "tracks" / "lost.npz", lost)
    assert run("--report", folder / "page.md") == 0
    statistics = load_motion(folder / "motion.npz").metadata["clips"]["lost"]
    assert statistics["distance_m"] is None
    assert (statistics["frames"], statistics["no_face"], statistics["runs"]) == (100, 100, 0)
    assert "motion_lost.png" in (folder / "page.md").read_text()


def test_a_run_has_a_step_however_short_it_may_be(folder: Path, make_track, run) -> None:
    valid = np.ones(100, dtype=bool)
    valid[[40, 42]] = False  # frame 41 is alone
    save_track(folder / "tracks" / "lively.npz", make_track(sway(100, 0.0), valid=valid))
    assert run(min_run=0.01) == 0
    assert load_motion(folder / "motion.npz").run_length.min() >= 2


def test_what_is_left_over_is_spliced(folder: Path, run) -> None:
    """Clips of 100 frames of one person, too short alone for runs of 4 s, give one together."""
    page = folder / "docs" / "page.md"
    table = ("--attribution", folder / "clips.csv", "--report", page)
    assert run(*table, min_run=4) == 2  # no run is long enough
    (folder / "clips.csv").write_text(TABLE.replace("ann", "bob"))
    assert run(*table, "--splice", min_run=4) == 0
    library = load_motion(folder / "motion.npz")
    assert library.run_clip.tolist() == ["bob_spliced"]
    assert library.blended is not None
    assert library.blended.any()
    assert library.mirrored is not None
    assert not library.mirrored.any()
    splice = library.metadata["splices"]["bob_spliced"]
    assert {stretch["clip"] for stretch in splice["stretches"]} == {"lively", "steady"}
    assert library.metadata["attribution"]["bob_spliced"] == {
        "subject": "bob", "licence": "CC BY 4.0; MIT", "source": "there; here",
    }  # fmt: skip
    text = page.read_text()
    assert "| bob_spliced | CC BY 4.0; MIT | there; here |" in text
    assert (page.parent / "images" / "motion_bob_spliced.png").is_file()


def test_runs_of_a_base_come_first_as_they_are(folder: Path, run, caplog) -> None:
    table = ("--attribution", folder / "clips.csv")
    assert run(*table) == 0
    older = load_motion(folder / "motion.npz")
    nudged = replace(older, mouth=older.mouth + np.float32(1e-5))  # another machine's last digits
    save_motion(folder / "base.npz", nudged)
    assert run(*table, "--base", folder / "base.npz", "--splice", "--min_stretch", "9") == 0
    np.testing.assert_array_equal(load_motion(folder / "motion.npz").mouth, nudged.mouth)
    save_motion(folder / "base.npz", replace(older, mouth=older.mouth + np.float32(1e-3)))
    assert run(*table, "--base", folder / "base.npz") == 2
    assert "--base: these tracks give other runs" in caplog.text
