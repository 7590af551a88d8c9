"""LeRobot itself loads an exported dataset, trains on it, and evaluates in our environment.

In an environment of its own, for LeRobot needs other releases of what this package uses:
``$RMB_LEROBOT_PYTHON``, or one that is made in the cache, which takes minutes and gigabytes.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pyarrow", reason="the format lerobot needs the extra formats")

from robo_manip_baselines.data import episode_path, write_episode
from robo_manip_baselines.data.demonstrations import load_demonstrations
from robo_manip_baselines.data.example import make_arrays, make_attributes, make_frames
from robo_manip_baselines.data.formats.lerobot import LeRobotRequest, export_lerobot
from robo_manip_baselines.observation import ObservationSpec
from robo_manip_baselines.runs.images import encode_image

pytestmark = pytest.mark.slow

LEROBOT = "lerobot[dataset,evaluation,training]==0.6.1"
PLUGIN = "lerobot_env_robo_manip_baselines"
NEEDED = 15_000_000_000
"""Bytes of disk for pip's downloads and the environment: 6 GB installed, with CUDA's libraries."""
LENGTHS, SIZE, CAMERAS = (40, 55, 30), (64, 96), ("front_close", "top")


def new_python() -> str | None:
    """Return a Python that LeRobot 0.6 supports, 3.12 or later; None where there is none."""
    pyenv = sorted(Path.home().glob(".pyenv/versions/3.1[2-9]*/bin/python"))
    found = [sys.executable, *map(str, pyenv)]
    found += filter(None, (shutil.which(f"python3.{minor}") for minor in (12, 13)))
    for python in found:
        code = "import sys; print(sys.version_info >= (3, 12))"
        done = subprocess.run([python, "-c", code], capture_output=True, text=True, check=False)
        if done.stdout.strip() == "True":
            return python
    return None


@pytest.fixture(scope="session")
def python(repository: Path) -> Path:
    """Return the Python of an environment with LeRobot and the plug-in; skip where it fails."""
    if given := os.environ.get("RMB_LEROBOT_PYTHON"):
        return Path(given)
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    folder = cache / "robo_manip_baselines" / "lerobot"
    made, ready = folder / "bin" / "python", folder / "ready"
    if ready.exists():
        return made
    base = new_python()
    if base is None:
        pytest.skip("LeRobot 0.6 needs Python 3.12 or later, and there is none")
    cache.mkdir(parents=True, exist_ok=True)
    if (free := shutil.disk_usage(cache).free) < NEEDED:
        pytest.skip(f"LeRobot needs {NEEDED / 1e9:.0f} GB of disk, and {free / 1e9:.0f} are free")
    plugin = repository / "integrations" / PLUGIN
    for command in (
        [base, "-m", "venv", "--clear", str(folder)],
        [str(made), "-m", "pip", "install", LEROBOT, "-e", str(repository), "-e", str(plugin)],
    ):
        try:
            done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=900)
        except subprocess.TimeoutExpired:
            pytest.skip("LeRobot was not installed within 15 minutes")
        if done.returncode:
            pytest.skip(f"LeRobot cannot be installed: {done.stderr.strip().splitlines()[-1]}")
    ready.touch()
    return made


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three demonstrations with images of 64 x 96."""
    folder = tmp_path_factory.mktemp("episodes")
    for seed, steps in enumerate(LENGTHS):
        frames = {c: make_frames(steps, i, SIZE) for i, c in enumerate(CAMERAS)}
        images = {c: [encode_image(image) for image in f] for c, f in frames.items()}
        arrays = make_arrays(steps, seed, version=4)
        write_episode(episode_path(folder, seed, True), arrays, images, make_attributes(seed))
    return folder


@pytest.fixture(scope="session")
def dataset(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder as a LeRobot dataset, with LeRobot's default encoding."""
    out = tmp_path_factory.mktemp("lerobot") / "dataset"
    export_lerobot(folder, out, LeRobotRequest(obs="current"))
    return out


def run(python: Path, repository: Path, *args: object) -> str:
    """Run a command of that environment, offline; return what it printed."""
    plugin = repository / "integrations" / PLUGIN
    env = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(repository), str(plugin)]),
        "HF_HUB_OFFLINE": "1",
        "MUJOCO_GL": os.environ.get("MUJOCO_GL", "egl"),
    }
    command, *rest = map(str, args)
    line = [str(python.parent / command), *rest]
    done = subprocess.run(line, capture_output=True, text=True, check=False, env=env)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


LOAD = """
import json, sys
import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
dataset = LeRobotDataset("local/test", root=sys.argv[1])
state, action, images = [], [], []
for index in range(len(dataset)):
    item = dataset[index]
    assert int(item["index"]) == index
    state.append(item["observation.state"].numpy())
    action.append(item["action"].numpy())
    images.append(item["observation.images.top"].numpy())
np.savez(sys.argv[2], state=state, action=action, images=np.stack(images))
part = LeRobotDataset(
    "local/test", root=sys.argv[1], episodes=[1], delta_timestamps={"action": [0.0, 0.02, 0.04]}
)
print(json.dumps({
    "frames": len(dataset), "episodes": dataset.num_episodes, "fps": dataset.fps,
    "task": dataset[0]["task"], "part": len(part), "chunk": list(part[0]["action"].shape),
    "stats": {k: np.ravel(dataset.meta.stats["action"][k]).tolist() for k in ("mean", "std")},
}))
"""


def test_lerobot_loads_every_frame(
    python: Path, repository: Path, folder: Path, dataset: Path, tmp_path: Path
) -> None:
    text = run(python, repository, "python", "-c", LOAD, dataset, tmp_path / "found.npz")
    found = json.loads(text.strip().splitlines()[-1])
    assert (found["frames"], found["episodes"], found["fps"]) == (sum(LENGTHS), 3, 50)
    assert found["task"] == "Bring the red cube to the mouth of the person and let go of it."
    assert (found["part"], found["chunk"]) == (LENGTHS[1], [3, 7])
    spec = ObservationSpec("current", cameras=("top",), image_size=SIZE)
    given = load_demonstrations(folder, spec)
    with np.load(tmp_path / "found.npz") as arrays:
        np.testing.assert_array_equal(arrays["state"], given.state)
        np.testing.assert_array_equal(arrays["action"], given.action)
        images = np.moveaxis(arrays["images"], 1, -1) * 255.0
    np.testing.assert_allclose(found["stats"]["mean"], given.action.mean(axis=0), atol=1e-5)
    original = np.concatenate([make_frames(steps, 1, SIZE) for steps in LENGTHS])
    # AV1 at its default quality errs by a few grey levels. A frame of the wrong step would have
    # the square elsewhere, which is an error of about 0.5 more at a distance of 8 pixels.
    assert np.abs(images - original).mean(axis=(1, 2, 3)).max() < 4.0


def test_lerobot_trains_and_evaluates(
    python: Path, repository: Path, dataset: Path, tmp_path: Path
) -> None:
    small = {
        "chunk_size": 10,
        "n_action_steps": 10,
        "dim_model": 32,
        "n_heads": 2,
        "dim_feedforward": 32,
        "pretrained_backbone_weights": "null",
        "push_to_hub": "false",
        "device": "cpu",
    }
    run(
        python,
        repository,
        "lerobot-train",
        "--dataset.repo_id=local/test",
        f"--dataset.root={dataset}",
        "--policy.type=act",
        *(f"--policy.{name}={value}" for name, value in small.items()),
        *("--batch_size=2", "--steps=3", "--save_freq=3", "--num_workers=0"),
        *("--env_eval_freq=0", "--wandb.enable=false", f"--output_dir={tmp_path / 'run'}"),
    )
    weights = tmp_path / "run/checkpoints/last/pretrained_model"
    assert (weights / "model.safetensors").is_file()
    run(
        python,
        repository,
        "lerobot-eval",
        f"--env.discover_packages_path={PLUGIN}",
        "--env.type=robo_manip_baselines_feeding",
        *("--env.obs=current", '--env.cameras=["front_close","top"]'),
        *(f"--env.observation_height={SIZE[0]}", f"--env.observation_width={SIZE[1]}"),
        "--env.episode_length=20",
        f"--policy.path={weights}",
        *("--policy.device=cpu", "--eval.n_episodes=2", "--eval.batch_size=2"),
        *("--eval.use_async_envs=false", "--seed=0", f"--output_dir={tmp_path / 'eval'}"),
    )
    found = json.loads((tmp_path / "eval/eval_info.json").read_text())
    assert found["overall"]["n_episodes"] == 2
    assert found["per_task"][0]["task_group"] == "robo_manip_baselines_feeding"
    assert found["per_task"][0]["metrics"]["successes"] == [False, False]
