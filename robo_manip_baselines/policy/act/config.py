"""Settings and presets of ACT. Importing this needs no PyTorch."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal

from annotated_types import Interval

from robo_manip_baselines.policy.presets import (
    IMAGE_TRAINING,
    STATE_ONLY_TRAINING,
    ActionExecution,
    Chunk,
    Layers,
    PolicyDims,
    PolicyPreset,
    TrainSettings,
    Width,
)
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.ranges import Amount, Fraction, require_ranges

RESNET18_PARAMETERS = 11_200_000


@dataclass(frozen=True)
class ActConfig:
    """Architecture of the network (Zhao et al. 2023, "ACT"; the paper's Table III).

    Attributes:
        chunk_size: K, actions predicted at once (Table III: 100).
        hidden_size: D, width of every token (Table III: 512); a multiple of 4 for the positions
            of image features, and of ``num_heads``.
        feedforward_size: width inside the feed-forward blocks (Table III: 3200).
        num_heads: attention heads (public ACT: 8).
        encoder_layers: of the Transformer over latent, state and image features (public ACT: 4).
        decoder_layers: of the Transformer over the queries (public ACT: 7, of which it reads
            the first; see ``paper_compat``).
        actions_per_query: successive actions that are read off one query of the decoder (public
            ACT: 1); what the last query gives beyond the chunk is left out.
            Without images the queries are nearly all of the work of a training.
        state_layers: hidden layers, as wide as ``feedforward_size``, of the perceptron that makes
            the token of the state (public ACT: 0, one linear layer). Without images that token
            is the only observation; ``docs/act.md`` has the effect of hidden layers.
        latent_size: Z, numbers of the latent style variable (public ACT: 32).
        cvae_layers: of the Transformer over class token, state and actions that proposes the
            latent in training (public ACT: 4).
        use_cvae: whether there is a latent at all; without, it is 0 in training too and the KL
            divergence is left out.
        kl_weight: weight of the KL divergence in the loss (Table III: 10).
        dropout: on the residual branches and inside the feed-forward blocks in training (public
            ACT: 0.1). Attention weights are not dropped: that would need them in memory.
        pre_norm: layer normalisation before each block instead of after it (public ACT: False).
        vision: features of the images: resnet18, one for all cameras, whose feature maps are tokens
            (public ACT); or small, four convolutions for each camera and a linear layer, whose
            features are observed beside the state: a twentieth of a ResNet's work.
        backbone_width: channels of the first stage of the ResNet-18 (He et al. 2016: 64).
        camera_features: of each camera with ``vision`` small.
        backbone_learning_rate_factor: learning rate of the ResNet-18 as a multiple of the others'
            (public ACT: 1e-5 for both, so 1); 0 keeps it as it is.
        backbone_weights: file with the state dict of a torchvision ResNet-18 to start from,
            ``.safetensors`` or ``.pth``; None starts from random weights.
        paper_compat: compute what the public ACT code computes: actions are read off the first
            decoder layer, padded steps count in the denominator of the L1 loss, and cameras have
            no embedding. Otherwise the last layer, valid steps only, and a learned embedding for
            each camera.

    Raises:
        RequestError: a value that is not valid.
    """

    chunk_size: Chunk = 100
    hidden_size: Width = 512
    feedforward_size: Width = 3200
    num_heads: Annotated[int, Interval(ge=1, le=1024)] = 8
    encoder_layers: Layers = 4
    decoder_layers: Layers = 7
    actions_per_query: Chunk = 1
    state_layers: Annotated[int, Interval(ge=0, le=256)] = 0
    latent_size: Width = 32
    cvae_layers: Layers = 4
    use_cvae: bool = True
    kl_weight: Amount = 10.0
    dropout: Fraction = 0.1
    pre_norm: bool = False
    vision: Literal["resnet18", "small"] = "resnet18"
    backbone_width: Annotated[int, Interval(ge=1, le=1024)] = 64
    camera_features: Width = 64
    backbone_learning_rate_factor: Amount = 1.0
    backbone_weights: str | None = None
    paper_compat: bool = False

    def __post_init__(self) -> None:
        require_ranges(self)
        if self.backbone_width % 8:
            # With fewer, oneDNN of PyTorch 2.13 corrupts memory on processors with AVX2 alone.
            raise RequestError(f"backbone_width {self.backbone_width}: must be a multiple of 8")
        for divisor, why in ((4, "4"), (self.num_heads, f"num_heads {self.num_heads}")):
            if self.hidden_size % divisor:
                raise RequestError(f"hidden_size {self.hidden_size}: must be a multiple of {why}")

    @property
    def num_queries(self) -> int:
        """Queries of the decoder."""
        return -(-self.chunk_size // self.actions_per_query)

    def num_parameters(self, dims: PolicyDims) -> int:
        """Return about how many weights the network has: its matrices, and the ResNet-18."""
        width, forward = self.hidden_size, self.feedforward_size
        attention, blocks = 4 * width**2, 2 * width * forward
        layers = self.encoder_layers + (self.cvae_layers if self.use_cvae else 0)
        count = layers * (attention + blocks) + self.decoder_layers * (2 * attention + blocks)
        if self.state_layers:
            count += (self.state_layers - 1) * forward**2 + forward * (dims.state + width)
        if dims.cameras and self.vision == "resnet18":
            count += RESNET18_PARAMETERS * self.backbone_width**2 // 64**2
            count += 8 * self.backbone_width * width
        elif dims.cameras:
            cells = 48 * dims.image[0] * dims.image[1] // 16**2
            each = 64_680 + cells * self.camera_features  # four convolutions and a linear layer
            beside = forward if self.state_layers else width
            count += dims.cameras * (each + self.camera_features * beside)
        ends = 2 * self.latent_size + dims.state + dims.action * self.actions_per_query
        return count + width * (self.num_queries + ends)


_SMALL = ActConfig(
    chunk_size=30,
    hidden_size=128,
    feedforward_size=256,
    num_heads=4,
    encoder_layers=1,
    decoder_layers=1,
    actions_per_query=5,
    state_layers=2,
    use_cvae=False,
    dropout=0.0,
)
"""Sizes in the presets for a processor without a GPU."""

PRESETS = {
    "paper": PolicyPreset(
        config=ActConfig(),
        training=TrainSettings(epochs=2000, validation_fraction=0.0),  # the paper trains on all 50
        execution=ActionExecution(),
    ),
    "cpu": PolicyPreset(
        config=_SMALL,
        training=replace(STATE_ONLY_TRAINING, steps=3000),
        execution=ActionExecution(),
        cameras=(),
        object_pose=True,
    ),
    "cpu_images": PolicyPreset(
        config=replace(_SMALL, vision="small"),
        training=replace(IMAGE_TRAINING, batch_size=16, steps=30000),
        # Images are drawn and encoded for every tenth step only.
        execution=ActionExecution(temporal_ensemble=False, n_action_steps=10),
        image_size=(96, 128),
    ),
}
