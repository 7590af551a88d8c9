"""A disk that takes no more: one line, exit code 1, and whole files or none."""

from __future__ import annotations

import errno
import subprocess
import sys
from pathlib import Path

import pytest

from robo_manip_baselines.runs.errors import RequestError, WriteError, disk_problem
from robo_manip_baselines.runs.files import AppendFile, atomic_file, prepare_folder

LIMIT = 4096
"""Bytes that a file may have in the subprocess of these tests."""

WRITERS = {
    "text": "files.write_text(out / 'a.txt', 'x' * 9999)",
    "json": "files.write_json(out / 'a.json', list(range(9999)))",
    "npz": "npz.write_npz(out / 'a.npz', {'a': noise})",
    "hdf5": (
        "with files.atomic_hdf5(out / 'a.hdf5', ('v110', 'v110')) as file:\n"
        "    file.create_dataset('a', data=noise)"
    ),
    "video": (
        "from robo_manip_baselines.rollout.videos import VideoWriter\n"
        "with VideoWriter(out / 'a.mp4', 25) as video:\n"
        "    for _ in range(3):\n"
        "        video.write(noise.reshape(100, 100, 3))"
    ),
    "face video": (
        "from face_prediction.evaluation.video import h264_file\n"
        "with h264_file(out / 'a.mp4', 25, preset='fast') as append:\n"
        "    for _ in range(3):\n"
        "        append(noise.reshape(100, 100, 3))"
    ),
    "checkpoint": (
        "import safetensors.numpy\n"
        "from robo_manip_baselines.runs.checkpoints import checkpoint_folder\n"
        "with checkpoint_folder(out / 'step') as folder:\n"
        "    safetensors.numpy.save_file({'a': noise}, folder / 'a.safetensors')"
    ),
    "curves": (
        "from robo_manip_baselines.runs.metrics import write_curves\n"
        "lines = [{'kind': 'train', 'step': i, 'loss': 1.0 + i} for i in range(9)]\n"
        "write_curves(out / 'a.png', lines, 'a')"
    ),
}

SCRIPT = """
import resource, sys
from pathlib import Path
import numpy as np
from robo_manip_baselines.runs import files, npz
from robo_manip_baselines.runs.command import run_command
noise = np.random.default_rng(0).integers(0, 256, 30000).astype(np.uint8)
out = Path(sys.argv[1])
def main():
    resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, {limit}))
    exec({body!r}, globals())
run_command(main)
"""


@pytest.mark.long
@pytest.mark.parametrize("kind", WRITERS)
def test_every_writer_ends_in_one_line(kind: str, tmp_path: Path) -> None:
    script = SCRIPT.format(limit=LIMIT, body=WRITERS[kind])
    command = [sys.executable, "-c", script, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    line = done.stderr.splitlines()[-1]
    assert line.startswith(f"error: cannot write '{tmp_path}/"), done.stderr
    assert "File too large; make room" in line
    assert "Traceback" not in done.stderr
    assert done.returncode == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.long
def test_what_grows_stays_whole(tmp_path: Path) -> None:
    body = (
        "from robo_manip_baselines.runs.metrics import MetricsLog, open_board\n"
        "board = open_board('tensorboard', out, 0, {})\n"
        "with MetricsLog(out / 'metrics.jsonl', 0, board) as log:\n"
        "    for step in range(1, 999):\n"
        "        log.write('train', step, {'loss': 1.5})"
    )
    script = SCRIPT.format(limit=LIMIT, body=body)
    command = [sys.executable, "-c", script, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1, done.stderr
    assert (tmp_path / "metrics.jsonl").read_text().endswith("}\n")
    (events,) = (tmp_path / "tensorboard").iterdir()
    from tensorboard.backend.event_processing.event_file_loader import RawEventFileLoader

    assert len(list(RawEventFileLoader(str(events)).Load())) > 5


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO])
def test_errors_of_the_disk_are_told_from_others(number: int, tmp_path: Path) -> None:
    path = tmp_path / "a"
    with pytest.raises(WriteError, match=r"cannot write '.*a': "), atomic_file(path):
        raise OSError(number, "the disk says no")
    with pytest.raises(WriteError, match=r"cannot write '.*a': "), atomic_file(path):
        raise RuntimeError(f"I/O error (os error {number})")  # safetensors
    with pytest.raises(ValueError, match="a bug"), atomic_file(path):
        raise ValueError("a bug")
    assert not list(tmp_path.iterdir())
    assert disk_problem(OSError(errno.EACCES, "no")) is None


def test_a_folder_that_cannot_be_made_is_the_requests_or_the_disks_fault(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number, kind in ((errno.EACCES, RequestError), (errno.ENOSPC, WriteError)):

        def fail(*_: object, number: int = number, **__: object) -> None:
            raise OSError(number, "no")

        monkeypatch.setattr(Path, "mkdir", fail)
        with pytest.raises(kind, match="cannot write"):
            prepare_folder(tmp_path / "a")


def test_a_record_is_appended_whole_or_not_at_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = AppendFile(tmp_path / "a", is_flushed=True)
    file.append(b"one\n")

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("os.fsync", full)
        with pytest.raises(WriteError, match="No space left"):
            file.append(b"two\n")
    assert (tmp_path / "a").read_bytes() == b"one\n"
    file.append(b"three\n")
    file.close()
    assert (tmp_path / "a").read_bytes() == b"one\nthree\n"
