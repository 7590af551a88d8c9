# %% [markdown]
# # Reading episodes with h5py alone
#
# Nothing of this repository is imported: an episode is a plain HDF5 file whose arrays carry unit,
# frame and description. `docs/episode_format.md` is its specification. Run it cell by cell, or as
# a program: `python examples/read_episodes.py`, after `python bin/Rollout.py FeedingEnv
# --scripted`.

# %%
import json
import os
from pathlib import Path

import h5py
import numpy as np

FOLDER = Path(os.environ.get("FOLDER", "dataset/FeedingEnv"))
paths = sorted(FOLDER.glob("episode_*.hdf5"))
print(f"{len(paths)} demonstrations in {FOLDER}")


# %% [markdown]
# Text attributes are UTF-8 bytes; lists and objects are JSON.


# %%
def attribute(file, name):
    """Return an attribute as text, number or vector."""
    value = file.attrs[name]
    return value.decode() if isinstance(value, bytes) else value


with h5py.File(paths[0]) as file:
    for name in ("schema", "schema_version", "env_id", "expert", "seed", "is_success"):
        print(f"{name:16} {attribute(file, name)}")
    print("env_kwargs      ", json.loads(attribute(file, "env_kwargs")))
    joints = json.loads(attribute(file, "joint_names"))
    print("joint_names     ", joints)

# %% [markdown]
# Every array has a row for each control step. Row t was observed before `action[t]` was given.

# %%
with h5py.File(paths[0]) as file:
    for name, item in file.items():
        if isinstance(item, h5py.Dataset):
            unit = attribute(item, "unit")
            print(f"{name:26} {item.shape!s:16} {unit:10} {attribute(item, 'description')[:60]}")

# %% [markdown]
# Images lie one after another in one array of bytes; `offset` says where each begins. Any JPEG
# decoder reads them.

# %%
with h5py.File(paths[0]) as file:
    for camera, group in file.get("images", {}).items():
        offset = group["offset"][:]
        first = group["data"][offset[0] : offset[1]].tobytes()
        print(f"{camera}: {len(offset) - 1} images, the first of {len(first)} bytes")
        Path(f"{camera}.jpg").write_bytes(first)

# %% [markdown]
# A table over all episodes: how long each took, and how near the gripper came to the mouth.

# %%
for path in paths:
    with h5py.File(path) as file:
        gripper, mouth = file["end_effector_position"][:], file["mouth_position"][:, 0]
        nearest = np.linalg.norm(gripper - mouth, axis=1).min()
        seconds = file["time"][-1] + file.attrs["control_period"]
        print(f"{path.name}: {seconds:.2f} s, nearest {100 * nearest:.1f} cm")
