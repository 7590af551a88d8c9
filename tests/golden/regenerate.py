"""Write the golden numbers beside this file: ``python tests/golden/regenerate.py``.

One training step of each network, of policies and of predictors of faces, on a fixed batch, from
weights that no random generator draws. Nothing else writes these files; look at the difference
before you commit it.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from face_prediction.forecast.interface import LandmarkSequences
from face_prediction.models.interface import Future, History
from face_prediction.models.settings import make_predictor_model, settings_class
from robo_manip_baselines.policy.act.config import ActConfig
from robo_manip_baselines.policy.act.model import ActModel
from robo_manip_baselines.policy.diffusion.config import DiffusionConfig
from robo_manip_baselines.policy.diffusion.model import DiffusionModel
from robo_manip_baselines.policy.flow.config import FlowConfig
from robo_manip_baselines.policy.flow.model import FlowModel
from robo_manip_baselines.policy.interface import Batch, PolicyDims, PolicyModel
from robo_manip_baselines.policy.mlp.config import MlpConfig
from robo_manip_baselines.policy.mlp.model import MlpModel
from robo_manip_baselines.policy.sarnn.config import SarnnConfig
from robo_manip_baselines.policy.sarnn.model import SarnnModel
from robo_manip_baselines.runs.files import write_json

ACT_STEP = Path(__file__).with_name("act_step.json")
DENOISING_STEP = Path(__file__).with_name("denoising_step.json")
FACE_STEP = Path(__file__).with_name("face_step.json")
MLP_STEP = Path(__file__).with_name("mlp_step.json")
SARNN_STEP = Path(__file__).with_name("sarnn_step.json")

DIMS = PolicyDims(state=14, action=7, cameras=2, image=(48, 72))
CONFIG = {
    "chunk_size": 8,
    "hidden_size": 32,
    "feedforward_size": 48,
    "num_heads": 4,
    "encoder_layers": 2,
    "decoder_layers": 3,
    "latent_size": 6,
    "cvae_layers": 2,
    "dropout": 0.0,
}

WATCHED = (
    "cvae.class_token",
    "cvae.action_projection.weight",
    "cvae.encoder.layers.1.attention.value.weight",
    "cvae.latent_projection.weight",
    "vision.backbone.conv1.weight",
    "vision.backbone.layer4.1.conv2.weight",
    "vision.projection.weight",
    "vision.cameras",
    "small_vision.backbone.convolutions.0.0.weight",
    "small_vision.backbone.convolutions.1.6.weight",
    "small_vision.backbone.projections.1.0.weight",
    "state_projection.0.weight",
    "encoder.layers.0.attention.query.weight",
    "decoder.layers.0.memory_attention.key.weight",
    "decoder.layers.2.feed_forward.narrow.weight",
    "queries",
    "action_head.bias",
)
"""Parameters from one end of the network to the other. No biases of keys: they cancel in the
softmax, so their gradient is rounding alone, and AdamW's first step follows its sign."""


def fill(shape: torch.Size | tuple[int, ...], start: int, scale: float) -> Tensor:
    """Numbers in [-scale, scale] without pattern or generator: sines of steps of a radian."""
    count = math.prod(shape)
    angles = torch.arange(count, dtype=torch.float64) * 1.0 + 0.37 * start
    return (scale * torch.sin(angles * angles * 0.1 + angles)).float().reshape(shape)


def fill_parameters(model: nn.Module) -> None:
    """Fill every matrix with its number of inputs in mind, biases a little; norms stay at 1."""
    for index, (name, parameter) in enumerate(model.named_parameters()):
        if parameter.dim() > 1:
            inputs = parameter[0].numel()
            parameter.data = fill(parameter.shape, index, math.sqrt(3.0 / inputs))
        elif "bias" in name:  # "bias_ih_l0" of a GRU too
            parameter.data = fill(parameter.shape, index, 0.1)


def fixed_batch(has_images: bool) -> Batch:
    """Three examples of 8, 5 and 1 valid steps."""
    is_pad = torch.arange(8)[None] >= torch.tensor([[8], [5], [1]])
    images = (127.5 + fill((3, 1, 2, 48, 72, 3), 2, 127.5)).to(torch.uint8)
    return Batch(
        state=fill((3, 1, 14), 1, 1.5),
        images=images if has_images else None,
        action=fill((3, 8, 7), 3, 1.5),
        is_pad=is_pad,
        noise=fill((3, 6), 4, 1.5),
        num_valid=(~is_pad).sum().float(),
        num_examples=torch.tensor(3.0),
    )


ACT_SETTINGS: dict[str, dict[str, Any]] = {
    "default": {},
    "paper_compat": {"paper_compat": True},
    "small_vision": {
        "vision": "small",
        "camera_features": 6,
        "state_layers": 1,
        "use_cvae": False,
        "actions_per_query": 3,
    },
}


def act_step(name: str) -> dict[str, Any]:
    """Return `training_step` of ACT."""
    model = ActModel(ActConfig(**{**CONFIG, **ACT_SETTINGS[name]}), DIMS)
    return training_step(model, fixed_batch(has_images=True), WATCHED)


def mlp_step() -> dict[str, Any]:
    """Return `training_step` of the perceptron."""
    config = MlpConfig(chunk_size=8, hidden_size=32, hidden_layers=2)
    model = MlpModel(config, replace(DIMS, cameras=0))
    watched = ("layers.0.weight", "layers.1.bias", "layers.3.weight", "layers.7.weight")
    return training_step(model, fixed_batch(has_images=False), watched)


def sarnn_step() -> dict[str, Any]:
    """Return `training_step` of the recurrent policy, with images."""
    model = SarnnModel(SarnnConfig(chunk_size=8, n_obs_steps=3, hidden_size=16), DIMS)
    batch = fixed_batch(has_images=True)
    assert batch.images is not None
    images = batch.images.repeat(1, 3, 1, 1, 1, 1)
    batch = replace(batch, state=fill((3, 3, 14), 1, 1.5), images=images)
    watched = tuple(n for n, _ in model.named_parameters() if "weight" in n)
    return training_step(model, batch, watched)


DENOISING_STEPS = (
    ("diffusion", "unet"),
    ("flow", "unet"),
    ("flow", "transformer"),
    ("flow", "perceptron"),
)
"""Policy and backbone of each golden step of theirs."""

DENOISING: dict[str, Any] = {"chunk_size": 8, "channels": (8, 16), "hidden_size": 16}
"""Sizes of the networks of Diffusion and Flow."""


def denoising_step(policy: str, backbone: Any) -> dict[str, Any]:
    """Return `training_step` of ``diffusion`` or ``flow``, with a backbone and without images."""
    target = "action" if backbone == "perceptron" else "noise"
    settings: dict[str, Any] = {**DENOISING, "backbone": backbone, "target": target}
    settings, dims = {**settings, "num_layers": 1}, replace(DIMS, cameras=0)
    model = (
        FlowModel(FlowConfig(**settings, max_prefix=3), dims)
        if policy == "flow"
        else DiffusionModel(DiffusionConfig(**settings), dims)
    )
    batch = fixed_batch(has_images=False)
    noise = fill((3, model.noise_size), 4, 1.5)
    state = fill((3, 2, 14), 1, 1.5)
    # no biases of attention, whose keys' cancel, nor of what a normalisation takes off
    watched = tuple(n for n, _ in model.named_parameters() if n.endswith("weight"))
    return training_step(model, replace(batch, state=state, noise=noise), watched)


def training_step(model: PolicyModel, batch: Batch, watch: tuple[str, ...]) -> dict[str, Any]:
    """Losses before and after one step of AdamW; norms of gradients and of weights after it."""
    fill_parameters(model)
    optimizer = torch.optim.AdamW(model.parameter_groups(1e-3), weight_decay=1e-4)
    before = model.loss(batch)
    before["loss"].backward()
    parameters = dict(model.named_parameters())
    watched = [name for name in watch if name in parameters and parameters[name].requires_grad]
    gradients = {name: parameters[name].grad for name in watched}
    norms = {name: g.norm().item() for name, g in gradients.items() if g is not None}
    optimizer.step()
    return {
        "before": {name: value.item() for name, value in before.items()},
        "gradient_norms": norms,
        "weight_norms": {name: parameters[name].norm().item() for name in watched},
        "after": {name: value.item() for name, value in model.loss(batch).items()},
    }


APPROACH = {
    "size": 32,
    "channels": [8, 16],
    "width": 16,
    "heads": 2,
    "layers": 2,
    "feedforward": 24,
    "dropout": 0.0,
    "history": 6,
    "horizon": 3,
}
FACE_SETTINGS: dict[str, dict[str, Any]] = {
    "image_only": APPROACH,
    "simple_fusion": {**APPROACH, "landmark_width": 10},
    "cross_attention": {**APPROACH, "landmark_width": 10, "attention_width": 12},
}
"""Sizes of the networks; convolutions have multiples of 8 channels, because oneDNN of PyTorch 2.13
corrupts memory in the backward pass of smaller ones."""


def moving_faces(count: int, frames: int) -> Tensor:
    """Landmarks (count, frames, 468, 2) of faces that sway and open their mouths."""
    face = 0.5 + fill((1, 1, 468, 2), 5, 0.3)
    time = torch.arange(frames, dtype=torch.float64)[None, :, None, None]
    person = torch.arange(count, dtype=torch.float64)[:, None, None, None]
    sway = 0.02 * torch.sin(0.3 * time + person + torch.tensor([0.0, 1.0]))
    stretch = 1 + 0.05 * torch.sin(0.7 * time + 2 * person)
    return (0.5 + (face - 0.5) * stretch + sway).float()


def face_step(name: str) -> dict[str, Any]:
    """Losses before and after one step of Adam; norms of all gradients and of weights after it."""
    model = make_predictor_model(name, settings_class(name)().changed(FACE_SETTINGS[name]))
    fill_parameters(model)
    faces = LandmarkSequences(moving_faces(4, 9).numpy(), tuple("abcd"))
    model.prepare(faces)
    landmarks = moving_faces(2, model.history + model.horizon)
    frames = model.needs.frames
    images = (127.5 + fill((2, frames + model.horizon, 32, 32, 3), 6, 127.5)).to(torch.uint8)
    seen = History(landmarks[:, : model.history], images[:, :frames])
    future = Future(landmarks[:, model.history :], images[:, frames:])
    optimizer = torch.optim.Adam(model.parameters(), 1e-3)
    before = model.loss(seen, future)
    before.total.backward()
    # biases of keys cancel in the softmax: their gradient is rounding alone (see `WATCHED`)
    hidden = ("in_proj_bias", "key.bias")
    parameters = {n: p for n, p in model.named_parameters() if not n.endswith(hidden)}
    norms = {n: p.grad.norm().item() for n, p in parameters.items() if p.grad is not None}
    optimizer.step()
    after = model.loss(seen, future)
    return {
        "before": {n: x.item() for n, x in {"loss": before.total, **before.terms}.items()},
        "gradient_norms": norms,
        "weight_norms": {n: p.norm().item() for n, p in parameters.items()},
        "after": {n: x.item() for n, x in {"loss": after.total, **after.terms}.items()},
    }


def main() -> None:
    """Write every golden file."""
    write_json(FACE_STEP, {name: face_step(name) for name in FACE_SETTINGS})
    write_json(ACT_STEP, {name: act_step(name) for name in ACT_SETTINGS})
    write_json(MLP_STEP, mlp_step())
    write_json(SARNN_STEP, sarnn_step())
    write_json(DENOISING_STEP, {f"{p} {b}": denoising_step(p, b) for p, b in DENOISING_STEPS})


if __name__ == "__main__":
    main()
