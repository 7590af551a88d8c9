"""ACT, Action Chunking with Transformers (Zhao et al. 2023): pictures and state in, K actions out.

Legend: B batch, S elements of the state, N cameras, H and W image height and width, h and w those
of the feature map, K actions of a chunk, A elements of an action, Z numbers of the latent, D
hidden size, M = 2 + N h w tokens of the encoder.
"""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn

from robo_manip_baselines.policy.act.backbone import (
    ResNet18,
    feature_size,
    fold_for_inference,
)
from robo_manip_baselines.policy.act.backbone_weights import load_backbone
from robo_manip_baselines.policy.act.config import ActConfig
from robo_manip_baselines.policy.act.cvae import CvaeEncoder, kl_divergence
from robo_manip_baselines.policy.act.positions import sine_positions_2d
from robo_manip_baselines.policy.act.transformer import Decoder, Encoder, ExactLinear, Linear
from robo_manip_baselines.policy.interface import Batch, PolicyModel, Sizes, masked_mean


class ActModel(PolicyModel):
    """The whole network.

    Initial weights are drawn from PyTorch's default generator: seed it for a run that can be
    repeated.

    Attributes:
        chunk_size: K.
        noise_size: Z, or 0 without the latent.

    Raises:
        RequestError: ``backbone_weights`` without cameras, or not those of a ResNet-18.
    """

    def __init__(self, config: ActConfig, sizes: Sizes) -> None:
        super().__init__()
        width = config.hidden_size
        self.config = config
        self.chunk_size = config.chunk_size
        self.noise_size = config.latent_size if config.use_cvae else 0
        self.cvae = CvaeEncoder(config, sizes) if config.use_cvae else None
        self.latent_projection = ExactLinear(config.latent_size, width)
        self.state_projection = _state_projection(config, sizes)
        # Learned positions of latent and state, of unit variance like those of the sines.
        self.token_positions = nn.Parameter(torch.randn(2, width))
        self.vision = Vision(config, sizes) if sizes.cameras else None
        self.encoder = Encoder(config, config.encoder_layers)
        self.queries = nn.Parameter(torch.randn(config.chunk_size, width))
        self.decoder = Decoder(
            config, config.decoder_layers, 1 if config.paper_compat else config.decoder_layers
        )
        self.action_head = ExactLinear(width, sizes.action)
        if config.backbone_weights is not None:
            load_backbone(self.vision and self.vision.backbone, config.backbone_weights)

    def loss(self, batch: Batch) -> dict[str, Tensor]:
        """Return ``loss``, the sum of ``l1`` and weighted ``kl``, and these two."""
        # Whatever stands in padded steps, infinities too, must not reach a sum.
        action = torch.where(batch.is_pad[..., None], 0.0, batch.action)
        kl = batch.state.new_zeros(())
        latent = None
        if self.cvae is not None:
            mean, log_variance = self.cvae(batch.state, action, batch.is_pad)
            latent = mean + (0.5 * log_variance).exp() * batch.noise
            kl = kl_divergence(mean, log_variance).sum() / batch.num_examples
        actions = self._actions(batch.state, batch.images, latent)
        error = nn.functional.l1_loss(actions, action, reduction="none")
        if self.config.paper_compat:
            kept = error.masked_fill(batch.is_pad[..., None], 0.0)
            l1 = kept.sum() / (batch.num_examples * kept[0].numel())
        else:
            l1 = masked_mean(error, batch.is_pad, batch.num_valid)
        return {"loss": l1 + self.config.kl_weight * kl, "l1": l1, "kl": kl}

    def predict(self, state: Tensor, images: Tensor | None) -> Tensor:
        """Return normalised actions (B, K, A) for the mean of the latent's prior, 0."""
        return self._actions(state, images, None)

    def for_inference(self, dtype: torch.dtype) -> ActModel:
        """Return a copy that predicts the same, faster, and cannot be trained.

        Frozen normalisation is folded into the kernels once, and the weights are held in
        ``dtype`` where autocast would cast all of them on every call: no autocast is needed.

        Args:
            dtype: of the matrix products: ``torch.float32`` or ``torch.bfloat16``; the layer
                norms and the layers at both ends are float32 in any case.
        """
        model = copy.deepcopy(self).eval().requires_grad_(False)
        if model.vision is not None:
            fold_for_inference(model.vision.backbone)
        for module in model.modules():
            if isinstance(module, Linear | nn.Conv2d):
                module.to(dtype)
        return model.requires_grad_(False)

    def parameter_groups(self, learning_rate: float) -> list[dict[str, object]]:
        """Return two groups: everything else, and the backbone with its own learning rate."""
        backbone = list(self.vision.backbone.parameters()) if self.vision is not None else []
        inside = {id(parameter) for parameter in backbone}
        trained = [p for p in self.parameters() if p.requires_grad and id(p) not in inside]
        groups: list[dict[str, object]] = [{"params": trained, "lr": learning_rate}]
        slow = [p for p in backbone if p.requires_grad]
        if slow:
            factor = self.config.backbone_learning_rate_factor
            groups.append({"params": slow, "lr": learning_rate * factor})
        return groups

    def _actions(self, state: Tensor, images: Tensor | None, latent: Tensor | None) -> Tensor:
        """(B, K, A) float32 from (B, S), (B, N, H, W, 3) and (B, Z), None being 0."""
        if latent is None:
            latent = state.new_zeros((state.shape[0], self.config.latent_size))
        tokens = [
            self.latent_projection(latent)[:, None],
            self.state_projection(state)[:, None],
        ]
        positions: list[Tensor] = [self.token_positions]
        if self.vision is not None:
            seen, places = self.vision(images)
            tokens.append(seen)
            positions.append(places)
        position_MD = torch.cat(positions)
        memory_BMD = self.encoder(torch.cat(tokens, dim=1), position_MD)
        return self.action_head(self.decoder(self.queries, memory_BMD, position_MD))


def _state_projection(config: ActConfig, sizes: Sizes) -> nn.Module:
    """From the state (B, S) to its token (B, D)."""
    layers: list[nn.Module] = []
    size = sizes.state
    for _ in range(config.state_layers):
        wide = config.feedforward_size
        layers += [ExactLinear(size, wide), nn.LayerNorm(wide), nn.GELU()]
        size = wide
    last = ExactLinear(size, config.hidden_size)
    return nn.Sequential(*layers, last) if layers else last


class Vision(nn.Module):
    """From the pictures of all cameras to tokens."""

    positions: Tensor

    def __init__(self, config: ActConfig, sizes: Sizes) -> None:
        super().__init__()
        self.shape = (sizes.cameras, *sizes.image, 3)
        self.backbone = ResNet18()
        if config.backbone_learning_rate_factor == 0.0:
            self.backbone.requires_grad_(False)
        self.projection = nn.Conv2d(self.backbone.features, config.hidden_size, 1)
        self.cameras = (
            None
            if config.paper_compat
            else nn.Parameter(torch.randn(sizes.cameras, 1, config.hidden_size))
        )
        self.register_buffer(
            "positions",
            sine_positions_2d(*feature_size(sizes.image), config.hidden_size).repeat(
                sizes.cameras, 1, 1
            ),
            persistent=False,
        )

    def forward(self, images: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return tokens (B, N h w, D) fp32 and their positions (N h w, D).

        Raises:
            ValueError: the images are not (B, N, H, W, 3).
        """
        if images is None or tuple(images.shape[1:]) != self.shape:
            given = None if images is None else tuple(images.shape[1:])
            raise ValueError(f"images of {self.shape} are needed for each example, not {given}")
        # One pass over the pictures of all cameras and examples.
        features = self.projection(self.backbone(images.flatten(0, 1)))
        tokens = features.flatten(2).transpose(1, 2).unflatten(0, images.shape[:2]).flatten(1, 2)
        places = self.positions if self.cameras is None else self.positions + self.cameras
        return tokens.float(), places.flatten(0, 1)
