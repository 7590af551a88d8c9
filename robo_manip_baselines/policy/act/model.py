"""Where a token is: sines of its place in a sequence or in a picture.

Legend: L tokens of a sequence, D hidden size, H and W height and width of a feature map.
"""

from __future__ import annotations

import copy
import math

import torch
from torch import Tensor, nn

from robo_manip_baselines.policy.act.config import ActConfig
from robo_manip_baselines.policy.act.resnet import (
    ResNet18,
    feature_size,
    fold_for_inference,
    load_backbone,
)
from robo_manip_baselines.policy.interface import Batch, PolicyModel, Sizes, masked_mean

TEMPERATURE = 10_000.0
"""Longest wavelength over the shortest (Vaswani et al. 2017; DETR)."""


def sine_positions(length: int, size: int) -> Tensor:
    """Return (L, D) sines and cosines, alternating, of the places 0 ... L - 1.

    Args:
        length: L.
        size: D, even.
    """
    return _waves(torch.arange(length, dtype=torch.float64), size).float()


def sine_positions_2d(height: int, width: int, size: int) -> Tensor:
    """Return (H * W, D) positions of the cells of a feature map, row by row.

    The first half of D is the row, the second the column, both scaled to (0, 2 pi], as in DETR:
    a cell keeps its position when the resolution changes.

    Args:
        height: H.
        width: W.
        size: D, a multiple of 4.
    """
    rows = _waves(torch.arange(1, height + 1, dtype=torch.float64) * (math.tau / height), size // 2)
    columns = _waves(
        torch.arange(1, width + 1, dtype=torch.float64) * (math.tau / width), size // 2
    )
    grid = torch.cat(
        [rows[:, None].expand(-1, width, -1), columns[None].expand(height, -1, -1)], dim=-1
    )
    return grid.flatten(0, 1).float()


def _waves(places: Tensor, size: int) -> Tensor:
    """(n, size): sin(p w_0), cos(p w_0), sin(p w_1), ..., w_i = TEMPERATURE ** (-2 i / size)."""
    rates = TEMPERATURE ** (-torch.arange(0, size, 2, dtype=torch.float64) / size)
    angles = places[:, None] * rates
    return torch.stack([angles.sin(), angles.cos()], dim=-1).flatten(1)


_LEVELS = 1 << 16
"""Values of 16 bits: the probability is met to 1 in 65,536."""


class Dropout(nn.Module):
    """Sets elements to 0 in training and scales the others so that the mean stays.

    Randomness comes from PyTorch's default generator of the device.

    Attributes:
        probability: of an element to be dropped.
    """

    def __init__(self, probability: float) -> None:
        super().__init__()
        self.probability = probability

    def forward(self, x: Tensor) -> Tensor:
        """Return a tensor of the same shape and type."""
        if not self.training or self.probability == 0.0:
            return x
        if x.device.type != "cpu" or torch.compiler.is_compiling():
            return nn.functional.dropout(x, self.probability)
        dropped = round(self.probability * _LEVELS)
        # From the smallest number of 64 bits without an end: all 64 bits are random.
        words = torch.empty(-(-x.numel() // 4), dtype=torch.int64).random_(-(2**63), None)
        draws = words.view(torch.int16)[: x.numel()].view(x.shape)  # from -32,768 on
        kept = (draws >= dropped - _LEVELS // 2).to(x.dtype)
        return x * kept.mul_(_LEVELS / (_LEVELS - dropped))

    def extra_repr(self) -> str:
        """Return what `print` shows of it."""
        return f"{self.probability}"


class Linear(nn.Linear):
    """A linear layer that takes what comes in to the type of its weights, where that is smaller."""

    def forward(self, input: Tensor) -> Tensor:
        """Return (..., out_features)."""
        if self.weight.dtype != torch.float32:  # under autocast they are fp32: it does the casting
            input = input.to(self.weight.dtype)
        return nn.functional.linear(input, self.weight, self.bias)


class ExactLinear(nn.Linear):
    """A linear layer in fp32 also under autocast: at the ends, where numbers are positions.

    bf16 keeps 8 bits: of a joint that moves by a radian, steps of several milliradians.
    """

    def forward(self, input: Tensor) -> Tensor:
        """Return (..., out_features), fp32."""
        with torch.autocast(input.device.type, enabled=False):
            return nn.functional.linear(input.float(), self.weight, self.bias)


class Attention(nn.Module):
    """Multi-head attention that never holds its weights in memory."""

    def __init__(self, hidden_size: int, num_heads: int) -> None:
        super().__init__()
        self.num_heads = num_heads
        self.query = Linear(hidden_size, hidden_size)
        self.key = Linear(hidden_size, hidden_size)
        self.value = Linear(hidden_size, hidden_size)
        self.out = Linear(hidden_size, hidden_size)

    def forward(
        self, query_BLD: Tensor, key_BMD: Tensor, value_BMD: Tensor, keep_BM: Tensor | None = None
    ) -> Tensor:
        """Return (B, L, D).

        Args:
            query_BLD: tokens that ask, with their positions.
            key_BMD: tokens that are asked, with their positions.
            value_BMD: the same tokens without.
            keep_BM: bool, False for tokens that must not be seen; None to see all.
        """
        mask = None if keep_BM is None else keep_BM[:, None, None, :]
        attended_BGLE = nn.functional.scaled_dot_product_attention(
            self._heads(self.query(query_BLD)),
            self._heads(self.key(key_BMD)),
            self._heads(self.value(value_BMD)),
            attn_mask=mask,
        )
        return self.out(attended_BGLE.transpose(1, 2).flatten(2))

    def _heads(self, x_BLD: Tensor) -> Tensor:
        return x_BLD.unflatten(-1, (self.num_heads, -1)).transpose(1, 2)


class LayerNorm(nn.LayerNorm):
    """Layer normalisation in fp32, whatever comes in."""

    def forward(self, input: Tensor) -> Tensor:
        """Return fp32 of the same shape."""
        return nn.functional.layer_norm(
            input.float(), self.normalized_shape, self.weight, self.bias, self.eps
        )


class FeedForward(nn.Module):
    """Two linear layers with a rectifier and dropout between them, on every token."""

    def __init__(self, config: ActConfig) -> None:
        super().__init__()
        self.widen = Linear(config.hidden_size, config.feedforward_size)
        self.dropout = Dropout(config.dropout)
        self.narrow = Linear(config.feedforward_size, config.hidden_size)

    def forward(self, x_BLD: Tensor) -> Tensor:
        """Return (B, L, D)."""
        return self.narrow(self.dropout(nn.functional.relu(self.widen(x_BLD), inplace=True)))


class Residual(nn.Module):
    """Adds what a block makes of the tokens to the tokens; normalises before or after."""

    def __init__(self, config: ActConfig) -> None:
        super().__init__()
        self.pre_norm = config.pre_norm
        self.norm = LayerNorm(config.hidden_size)
        self.dropout = Dropout(config.dropout)

    def before(self, x_BLD: Tensor) -> Tensor:
        """Return what the block sees."""
        return self.norm(x_BLD) if self.pre_norm else x_BLD

    def after(self, x_BLD: Tensor, change_BLD: Tensor) -> Tensor:
        """Return the tokens with the block's change."""
        x_BLD = x_BLD + self.dropout(change_BLD)
        return x_BLD if self.pre_norm else self.norm(x_BLD)


class EncoderLayer(nn.Module):
    """Self-attention, then feed-forward."""

    def __init__(self, config: ActConfig) -> None:
        super().__init__()
        self.attention = Attention(config.hidden_size, config.num_heads)
        self.attention_residual = Residual(config)
        self.feed_forward = FeedForward(config)
        self.feed_forward_residual = Residual(config)

    def forward(self, x_BLD: Tensor, position_LD: Tensor, keep_BL: Tensor | None) -> Tensor:
        """Return (B, L, D)."""
        seen = self.attention_residual.before(x_BLD)
        placed = seen + position_LD
        x_BLD = self.attention_residual.after(x_BLD, self.attention(placed, placed, seen, keep_BL))
        seen = self.feed_forward_residual.before(x_BLD)
        return self.feed_forward_residual.after(x_BLD, self.feed_forward(seen))


class Encoder(nn.Module):
    """A stack of encoder layers."""

    def __init__(self, config: ActConfig, num_layers: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList(EncoderLayer(config) for _ in range(num_layers))
        self.norm = LayerNorm(config.hidden_size) if config.pre_norm else nn.Identity()
        _initialize(self)

    def forward(self, x_BLD: Tensor, position_LD: Tensor, keep_BL: Tensor | None = None) -> Tensor:
        """Return (B, L, D), fp32.

        Args:
            x_BLD: tokens.
            position_LD: added to queries and keys of every layer.
            keep_BL: bool, False for tokens that must not be seen; None to see all.
        """
        for layer in self.layers:
            x_BLD = layer(x_BLD, position_LD, keep_BL)
        return self.norm(x_BLD)


class DecoderLayer(nn.Module):
    """Self-attention of the queries, attention to the memory, feed-forward."""

    def __init__(self, config: ActConfig) -> None:
        super().__init__()
        self.attention = Attention(config.hidden_size, config.num_heads)
        self.attention_residual = Residual(config)
        self.memory_attention = Attention(config.hidden_size, config.num_heads)
        self.memory_residual = Residual(config)
        self.feed_forward = FeedForward(config)
        self.feed_forward_residual = Residual(config)

    def forward(
        self, x_BLD: Tensor, position_LD: Tensor, memory_BMD: Tensor, placed_memory_BMD: Tensor
    ) -> Tensor:
        """Return (B, L, D)."""
        seen = self.attention_residual.before(x_BLD)
        placed = seen + position_LD
        x_BLD = self.attention_residual.after(x_BLD, self.attention(placed, placed, seen))
        placed = self.memory_residual.before(x_BLD) + position_LD
        found = self.memory_attention(placed, placed_memory_BMD, memory_BMD)
        x_BLD = self.memory_residual.after(x_BLD, found)
        seen = self.feed_forward_residual.before(x_BLD)
        return self.feed_forward_residual.after(x_BLD, self.feed_forward(seen))


class Decoder(nn.Module):
    """A stack of decoder layers, of which perhaps only the first are run."""

    def __init__(self, config: ActConfig, num_layers: int, num_run: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList(DecoderLayer(config) for _ in range(num_layers))
        self.num_run = num_run
        self.norm = LayerNorm(config.hidden_size)
        _initialize(self)
        # What is never run has no gradient, and distributed training waits for every gradient.
        self.layers[num_run:].requires_grad_(False)

    def forward(self, query_LD: Tensor, memory_BMD: Tensor, position_MD: Tensor) -> Tensor:
        """Return (B, L, D), fp32.

        Args:
            query_LD: what stands for the place of each output; the tokens themselves start at 0.
            memory_BMD: tokens of the encoder.
            position_MD: their positions.
        """
        x_BLD = query_LD.new_zeros((memory_BMD.shape[0], *query_LD.shape))
        # The positions of the memory are the same in every layer: added once.
        placed_memory_BMD = memory_BMD + position_MD
        for layer in self.layers[: self.num_run]:
            x_BLD = layer(x_BLD, query_LD, memory_BMD, placed_memory_BMD)
        return self.norm(x_BLD)


def _initialize(module: nn.Module) -> None:
    """Xavier-uniform matrices (DETR), biases of 0."""
    for part in module.modules():
        if isinstance(part, nn.Linear):
            nn.init.xavier_uniform_(part.weight)
            nn.init.zeros_(part.bias)


class CvaeEncoder(nn.Module):
    """Proposes a distribution of the latent from the state and the demonstrated actions."""

    positions: Tensor

    def __init__(self, config: ActConfig, sizes: Sizes) -> None:
        super().__init__()
        width = config.hidden_size
        self.class_token = nn.Parameter(torch.randn(1, width))
        self.state_projection = ExactLinear(sizes.state, width)
        self.action_projection = ExactLinear(sizes.action, width)
        self.encoder = Encoder(config, config.cvae_layers)
        self.latent_projection = ExactLinear(width, 2 * config.latent_size)
        self.register_buffer(
            "positions", sine_positions(2 + config.chunk_size, width), persistent=False
        )

    def forward(self, state: Tensor, action: Tensor, is_pad: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and logarithm of the variance of the latent, each (B, Z) float32.

        Args:
            state: (B, S).
            action: (B, K, A), finite also where ``is_pad``.
            is_pad: (B, K) bool, actions that are not seen.
        """
        batch = state.shape[0]
        tokens = torch.cat(
            [
                self.class_token.expand(batch, 1, -1),
                self.state_projection(state)[:, None],
                self.action_projection(action),
            ],
            dim=1,
        )
        keep = torch.cat([is_pad.new_ones((batch, 2)), ~is_pad], dim=1)
        encoded = self.encoder(tokens, self.positions, keep)
        mean, log_variance = self.latent_projection(encoded[:, 0]).chunk(2, dim=-1)
        return mean, log_variance


def kl_divergence(mean: Tensor, log_variance: Tensor) -> Tensor:
    """Return KL(N(mean, exp(log_variance)) || N(0, 1)) of each example, (B,), summed over Z."""
    each = -0.5 * (1.0 + log_variance - mean.square() - log_variance.exp())
    return each.sum(dim=-1)


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
