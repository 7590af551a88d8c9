"""Write the golden numbers beside this file: ``python tests/golden/regenerate.py``.

One training step of each network on a fixed batch, from weights that no random generator draws.
Nothing else writes these files; look at the difference before you commit it.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from robo_manip_baselines.policy.act.config import ActConfig
from robo_manip_baselines.policy.act.model import ActModel
from robo_manip_baselines.policy.interface import Batch, PolicyDims, PolicyModel
from robo_manip_baselines.policy.mlp.config import MlpConfig
from robo_manip_baselines.policy.mlp.model import MlpModel
from robo_manip_baselines.runs.files import write_json

ACT_STEP = Path(__file__).with_name("act_step.json")
MLP_STEP = Path(__file__).with_name("mlp_step.json")

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
        elif name.endswith("bias"):
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


def act_step(paper_compat: bool) -> dict[str, Any]:
    """Return `training_step` of ACT."""
    model = ActModel(ActConfig(**CONFIG, paper_compat=paper_compat), DIMS)
    return training_step(model, fixed_batch(has_images=True), WATCHED)


def mlp_step() -> dict[str, Any]:
    """Return `training_step` of the perceptron."""
    config = MlpConfig(chunk_size=8, hidden_size=32, hidden_layers=2)
    model = MlpModel(config, replace(DIMS, cameras=0))
    watched = ("layers.0.weight", "layers.1.bias", "layers.3.weight", "layers.7.weight")
    return training_step(model, fixed_batch(has_images=False), watched)


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


def main() -> None:
    """Write every golden file."""
    golden = {
        "default": act_step(paper_compat=False),
        "paper_compat": act_step(paper_compat=True),
    }
    write_json(ACT_STEP, golden)
    write_json(MLP_STEP, mlp_step())


if __name__ == "__main__":
    main()
