"""The network of ACT: action chunking with Transformers (Zhao et al. 2023).

Legend: B batch, L query tokens, M tokens of the memory, D hidden size, G attention heads, E size of
a head, K actions of a chunk, S elements of the state, A elements of an action, N cameras, H and W
image height and width, h and w those of a feature map, Z latent size.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor, nn

from robo_manip_baselines.policy.act.cameras import CameraEncoder
from robo_manip_baselines.policy.act.config import ActConfig
from robo_manip_baselines.policy.act.inference import Prediction
from robo_manip_baselines.policy.act.resnet import (
    ResNet18,
    feature_size,
    fold_for_inference,
    for_products,
    load_backbone,
)
from robo_manip_baselines.policy.interface import Batch, PolicyDims, PolicyModel, masked_mean

TEMPERATURE = 10_000.0
"""Longest wavelength over the shortest (Vaswani et al. 2017; DETR)."""


def sine_positions(length: int, size: int) -> Tensor:
    """Return (L, D) sinusoidal position embeddings of the places 0 ... L - 1; D is even."""
    return _waves(torch.arange(length, dtype=torch.float64), size).float()


def sine_positions_2d(height: int, width: int, size: int) -> Tensor:
    """Return (h * w, D) position embeddings of the cells of a feature map, row by row.

    The first half of D is the row, the second the column, both scaled to (0, 2 pi], as in DETR:
    a cell keeps its position when the resolution changes. D is a multiple of 4.
    """
    rows, columns = (
        _waves(torch.arange(1, cells + 1, dtype=torch.float64) * (math.tau / cells), size // 2)
        for cells in (height, width)
    )
    parts = rows[:, None].expand(-1, width, -1), columns[None].expand(height, -1, -1)
    return torch.cat(parts, dim=-1).flatten(0, 1).float()


def _waves(places: Tensor, size: int) -> Tensor:
    """(n, size): sin(p w_0), cos(p w_0), sin(p w_1), ..., w_i = TEMPERATURE ** (-2 i / size)."""
    rates = TEMPERATURE ** (-torch.arange(0, size, 2, dtype=torch.float64) / size)
    angles = places[:, None] * rates
    return torch.stack([angles.sin(), angles.cos()], dim=-1).flatten(1)


_LEVELS = 1 << 16
"""Values of 16 bits: the probability is met to 1 in 65,536."""


class Dropout(nn.Module):
    """Dropout that draws 16 random bits an element on a CPU, a quarter of what PyTorch draws.

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


class Linear(nn.Linear):
    """A linear layer that casts its input to the type of its weights, where that is smaller."""

    def forward(self, input: Tensor) -> Tensor:
        """Return (..., out_features)."""
        if self.weight.dtype != torch.float32:  # under autocast they are fp32: it does the casting
            input = input.to(self.weight.dtype)
        if input.is_cuda and torch.is_grad_enabled() and not torch.compiler.is_compiling():
            tokens, weight, bias = map(for_products, (input, self.weight, self.bias))
            # What a function returns must be no view if others are to change it in place.
            return AffineProduct.apply(tokens.flatten(0, -2), weight, bias).view(
                *input.shape[:-1], -1
            )
        return nn.functional.linear(input, self.weight, self.bias)


class AffineProduct(torch.autograd.Function):
    """Linear layer that sums the gradient of its bias over the tokens by a product with ones.

    On a GPU PyTorch's sum over the first dimension takes longer than the gradient of the weights.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        """Return (L, N) from (L, M), (N, M) and (N,), all of one type."""
        ctx.save_for_backward(x, weight)
        return nn.functional.linear(x, weight, bias)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor, Tensor]:
        """Return the gradients of the three."""
        x, weight = ctx.saved_tensors
        gradient = gradients[0]
        of_x = gradient @ weight if ctx.needs_input_grad[0] else None
        ones = gradient.new_ones((1, len(gradient)))
        return of_x, gradient.t() @ x, (ones @ gradient).squeeze(0)


class ExactLinear(nn.Linear):
    """A linear layer in fp32 also under autocast, for both ends, where numbers are positions.

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
            query_BLD: queries, with their positions; (1, L, D) where they are the same for all.
            key_BMD: keys, with their positions.
            value_BMD: values: the same tokens without.
            keep_BM: bool, False for tokens to mask out; None for no mask.
        """
        query = for_products(query_BLD)
        key = query if key_BMD is query_BLD else key_BMD
        projected = self.query(query), self.key(key), self.value(value_BMD)
        heads = [x_BLD.unflatten(-1, (self.num_heads, -1)).transpose(1, 2) for x_BLD in projected]
        heads[0] = heads[0].expand(len(key_BMD), -1, -1, -1)
        mask = None if keep_BM is None else keep_BM[:, None, None, :]
        attended_BGLE = nn.functional.scaled_dot_product_attention(*heads, attn_mask=mask)
        return self.out(attended_BGLE.transpose(1, 2).flatten(2))


class LayerNorm(nn.LayerNorm):
    """Layer normalisation in fp32 for inputs of any type."""

    def forward(self, input: Tensor) -> Tensor:
        """Return fp32 of the same shape."""
        return nn.functional.layer_norm(
            input.float(), self.normalized_shape, self.weight, self.bias, self.eps
        )


class FeedForward(nn.Module):
    """Two linear layers with ReLU and dropout between them, on every token."""

    def __init__(self, config: ActConfig) -> None:
        super().__init__()
        # Names of parameters are those of checkpoints: widen, narrow, memory_attention.
        self.widen = Linear(config.hidden_size, config.feedforward_size)
        self.dropout = Dropout(config.dropout)
        self.narrow = Linear(config.feedforward_size, config.hidden_size)

    def forward(self, x_BLD: Tensor) -> Tensor:
        """Return (B, L, D)."""
        return self.narrow(self.dropout(nn.functional.relu(self.widen(x_BLD), inplace=True)))


class Residual(nn.Module):
    """Residual connection around a block, with layer normalisation before or after it."""

    def __init__(self, config: ActConfig) -> None:
        super().__init__()
        self.pre_norm = config.pre_norm
        self.norm = LayerNorm(config.hidden_size)
        self.dropout = Dropout(config.dropout)

    def before(self, x_BLD: Tensor) -> Tensor:
        """Return the block's input."""
        return self.norm(x_BLD) if self.pre_norm else x_BLD

    def after(self, x_BLD: Tensor, change_BLD: Tensor) -> Tensor:
        """Return the tokens plus the block's output."""
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
        inner = self.attention_residual.before(x_BLD)
        query = inner + position_LD
        x_BLD = self.attention_residual.after(x_BLD, self.attention(query, query, inner, keep_BL))
        inner = self.feed_forward_residual.before(x_BLD)
        return self.feed_forward_residual.after(x_BLD, self.feed_forward(inner))


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
            keep_BL: bool, False for tokens to mask out; None for no mask.
        """
        for layer in self.layers:
            x_BLD = layer(x_BLD, position_LD, keep_BL)
        return self.norm(x_BLD)


class DecoderLayer(nn.Module):
    """Self-attention of the queries, cross-attention to the memory, feed-forward."""

    def __init__(self, config: ActConfig) -> None:
        super().__init__()
        self.attention = Attention(config.hidden_size, config.num_heads)
        self.attention_residual = Residual(config)
        self.memory_attention = Attention(config.hidden_size, config.num_heads)
        self.memory_residual = Residual(config)
        self.feed_forward = FeedForward(config)
        self.feed_forward_residual = Residual(config)

    def forward(
        self, x_BLD: Tensor, position_LD: Tensor, memory_BMD: Tensor, memory_key_BMD: Tensor
    ) -> Tensor:
        """Return (B, L, D)."""
        inner = self.attention_residual.before(x_BLD)
        query = inner + position_LD
        x_BLD = self.attention_residual.after(x_BLD, self.attention(query, query, inner))
        query = self.memory_residual.before(x_BLD) + position_LD
        found = self.memory_attention(query, memory_key_BMD, memory_BMD)
        x_BLD = self.memory_residual.after(x_BLD, found)
        inner = self.feed_forward_residual.before(x_BLD)
        return self.feed_forward_residual.after(x_BLD, self.feed_forward(inner))


class Decoder(nn.Module):
    """A stack of decoder layers, of which only the first ``num_run`` are used."""

    def __init__(self, config: ActConfig, num_layers: int, num_run: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList(DecoderLayer(config) for _ in range(num_layers))
        self.num_run, self.dropout = num_run, config.dropout
        self.norm = LayerNorm(config.hidden_size)
        _initialize(self)
        # What is never run has no gradient, and distributed training waits for every gradient.
        self.layers[num_run:].requires_grad_(False)

    def forward(self, query_LD: Tensor, memory_BMD: Tensor, position_MD: Tensor) -> Tensor:
        """Return (B, L, D), fp32.

        Args:
            query_LD: learned queries, one for each output; the tokens themselves start at 0.
            memory_BMD: tokens of the encoder.
            position_MD: their positions.
        """
        # Up to the first cross-attention all examples are the same but for what is dropped. One
        # will do in training; predictions would round otherwise than those of earlier releases.
        batch = 1 if self.training and self.dropout == 0.0 else len(memory_BMD)
        x_BLD = query_LD.new_zeros((batch, *query_LD.shape))
        # The positions of the memory are the same in every layer: added once.
        memory_key_BMD = for_products(memory_BMD + position_MD)
        memory_BMD = for_products(memory_BMD)
        for layer in self.layers[: self.num_run]:
            x_BLD = layer(x_BLD, query_LD, memory_BMD, memory_key_BMD)
        return self.norm(x_BLD)


def _initialize(module: nn.Module) -> None:
    """Xavier-uniform matrices (DETR), biases of 0."""
    for part in module.modules():
        if isinstance(part, nn.Linear):
            nn.init.xavier_uniform_(part.weight)
            nn.init.zeros_(part.bias)


class CvaeEncoder(nn.Module):
    """Encoder of the CVAE: distribution of the latent given state and demonstrated actions."""

    positions: Tensor

    def __init__(self, config: ActConfig, dims: PolicyDims) -> None:
        super().__init__()
        width = config.hidden_size
        self.class_token = nn.Parameter(torch.randn(1, width))
        self.state_projection = ExactLinear(dims.state, width)
        self.action_projection = ExactLinear(dims.action, width)
        self.encoder = Encoder(config, config.cvae_layers)
        self.latent_projection = ExactLinear(width, 2 * config.latent_size)
        positions = sine_positions(2 + config.chunk_size, width)
        self.register_buffer("positions", positions, persistent=False)

    def forward(self, state: Tensor, action: Tensor, is_pad: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and logarithm of the variance of the latent, each (B, Z) float32.

        ``state`` is (B, S); ``action`` (B, K, A) is finite also where ``is_pad`` (B, K).
        """
        batch = state.shape[0]
        class_token = self.class_token.expand(batch, 1, -1)
        parts = class_token, self.state_projection(state)[:, None], self.action_projection(action)
        tokens = torch.cat(parts, dim=1)
        keep = torch.cat([is_pad.new_ones((batch, 2)), ~is_pad], dim=1)
        encoded = self.encoder(tokens, self.positions, keep)
        mean, log_variance = self.latent_projection(encoded[:, 0]).chunk(2, dim=-1)
        return mean, log_variance


def kl_divergence(mean: Tensor, log_variance: Tensor) -> Tensor:
    """Return KL(N(mean, exp(log_variance)) || N(0, 1)) of each example, (B,), summed over Z."""
    each = -0.5 * (1.0 + log_variance - mean.square() - log_variance.exp())
    return each.sum(dim=-1)


class ActModel(PolicyModel):
    """ACT. It observes the last step only (``n_obs_steps`` 1).

    Initial weights are drawn from PyTorch's default generator: seed it for a run that can be
    repeated.

    Raises:
        RequestError: ``backbone_weights`` without cameras, or not those of a ResNet-18.
    """

    def __init__(self, config: ActConfig, dims: PolicyDims) -> None:
        super().__init__()
        width = config.hidden_size
        self.config = config
        self.chunk_size = config.chunk_size
        self.noise_size = config.latent_size if config.use_cvae else 0
        self.cvae = CvaeEncoder(config, dims) if config.use_cvae else None
        self.latent_projection = ExactLinear(config.latent_size, width)
        is_small = bool(dims.cameras) and config.vision == "small"
        self.small_vision = SmallVision(config, dims) if is_small else None
        seen = config.camera_features * dims.cameras if is_small else 0
        self.state_projection = _state_projection(config, dims.state + seen)
        # Learned positions of latent and state, of unit variance like those of the sines.
        self.token_positions = nn.Parameter(torch.randn(2, width))
        self.vision = Vision(config, dims) if dims.cameras and not is_small else None
        self.encoder = Encoder(config, config.encoder_layers)
        self.queries = nn.Parameter(torch.randn(config.num_queries, width))
        num_run = 1 if config.paper_compat else config.decoder_layers
        self.decoder = Decoder(config, config.decoder_layers, num_run)
        self.action_head = ExactLinear(width, config.actions_per_query * dims.action)
        self.prediction: Prediction | None = None  # of a copy for inference
        if config.backbone_weights is not None:
            load_backbone(self.vision and self.vision.backbone, config.backbone_weights)

    def loss(self, batch: Batch) -> dict[str, Tensor]:
        """Return ``loss``, the sum of ``l1`` and weighted ``kl``, and these two."""
        # The content of padded steps, infinities too, must not reach a sum.
        action = torch.where(batch.is_pad[..., None], 0.0, batch.action)
        kl = batch.state.new_zeros(())
        latent = None
        if self.cvae is not None:
            mean, log_variance = self.cvae(batch.state[:, -1], action, batch.is_pad)
            latent = mean + (0.5 * log_variance).exp() * batch.noise
            kl = kl_divergence(mean, log_variance).sum() / batch.num_examples
        actions = self._actions(batch.state, batch.images, latent)
        error = batch.weighted(nn.functional.l1_loss(actions, action, reduction="none"))
        if self.config.paper_compat:
            kept = error.masked_fill(batch.is_pad[..., None], 0.0)
            l1 = kept.sum() / (batch.num_examples * kept[0].numel())
        else:
            l1 = masked_mean(error, batch.is_pad, batch.num_valid)
        return {"loss": l1 + self.config.kl_weight * kl, "l1": l1, "kl": kl}

    def predict(self, state: Tensor, images: Tensor | None, noise: Tensor | None) -> Tensor:
        """Return normalised actions (B, K, A) for the mean of the latent's prior, 0."""
        if self.prediction is not None:
            return self.prediction(state, images)
        return self._actions(state, images, None)

    def for_inference(self, dtype: torch.dtype) -> ActModel:
        """Return a copy that predicts the same, faster, and cannot be trained.

        Frozen normalisation is folded into the kernels once, and the weights are held in
        ``dtype`` where autocast would cast all of them on every call: no autocast is needed. It is
        moved to its device before it predicts, see `Prediction`.

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
        model.prediction = Prediction(model)
        return model.requires_grad_(False)

    def product_parameters(self) -> Iterator[str]:
        """Yield the names of parameters that are read by products alone, which autocast casts."""
        for name, module in self.named_modules():
            if isinstance(module, Linear):
                yield from (f"{name}.{part}" for part, _ in module.named_parameters())

    def parameter_groups(self, learning_rate: float) -> list[dict[str, object]]:
        """Return two groups: everything else, and the backbone with its own learning rate."""
        vision = self.vision or self.small_vision
        backbone = list(vision.backbone.parameters()) if vision is not None else []
        inside = {id(parameter) for parameter in backbone}
        trained = [p for p in self.parameters() if p.requires_grad and id(p) not in inside]
        slow = [p for p in backbone if p.requires_grad]
        slow_rate = learning_rate * self.config.backbone_learning_rate_factor
        groups: list[dict[str, object]] = [{"params": trained, "lr": learning_rate}]
        return [*groups, {"params": slow, "lr": slow_rate}] if slow else groups

    def _actions(self, state: Tensor, images: Tensor | None, latent: Tensor | None) -> Tensor:
        """(B, K, A) float32 from (B, 1, S), (B, 1, N, H, W, 3) and (B, Z), None being 0."""
        state = state[:, -1]
        if self.small_vision is not None:
            state = torch.cat([state, self.small_vision(images)], dim=1)
        if latent is None:
            latent = state.new_zeros((state.shape[0], self.config.latent_size))
        tokens = [self.latent_projection(latent)[:, None], self.state_projection(state)[:, None]]
        positions: list[Tensor] = [self.token_positions]
        if self.vision is not None:
            image_tokens, image_positions = self.vision(images)
            tokens.append(image_tokens)
            positions.append(image_positions)
        position_MD = torch.cat(positions)
        memory_BMD = self.encoder(torch.cat(tokens, dim=1), position_MD)
        actions = self.action_head(self.decoder(self.queries, memory_BMD, position_MD))
        actions = actions.unflatten(-1, (self.config.actions_per_query, -1)).flatten(1, 2)
        return actions[:, : self.chunk_size]


def _state_projection(config: ActConfig, size: int) -> nn.Module:
    """Build the layers from the state and what is seen (B, size) to their token (B, D)."""
    layers: list[nn.Module] = []
    hidden = config.feedforward_size
    for _ in range(config.state_layers):
        layers += [ExactLinear(size, hidden), nn.LayerNorm(hidden), nn.GELU()]
        size = hidden
    last = ExactLinear(size, config.hidden_size)
    return nn.Sequential(*layers, last) if layers else last


class Vision(nn.Module):
    """ResNet-18 features of the images of all cameras, as tokens."""

    positions: Tensor

    def __init__(self, config: ActConfig, dims: PolicyDims) -> None:
        super().__init__()
        self.shape = (dims.cameras, *dims.image, 3)
        self.backbone = ResNet18(config.backbone_width)
        if config.backbone_learning_rate_factor == 0.0:
            self.backbone.requires_grad_(False)
        self.projection = nn.Conv2d(self.backbone.features, config.hidden_size, 1)
        self.cameras: nn.Parameter | None = None
        if not config.paper_compat:
            self.cameras = nn.Parameter(torch.randn(dims.cameras, 1, config.hidden_size))
        positions = sine_positions_2d(*feature_size(dims.image), config.hidden_size)
        self.register_buffer("positions", positions.repeat(dims.cameras, 1, 1), persistent=False)

    def forward(self, images: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return tokens (B, N h w, D) fp32 and their positions (N h w, D).

        Raises:
            ValueError: the images are not (B, 1, N, H, W, 3).
        """
        images = _present(images, self.shape)
        # One pass over the images of all cameras and examples.
        features = self.projection(self.backbone(images.flatten(0, 1)))
        tokens = features.flatten(2).transpose(1, 2).unflatten(0, images.shape[:2]).flatten(1, 2)
        positions = self.positions if self.cameras is None else self.positions + self.cameras
        return tokens.float(), positions.flatten(0, 1)


class SmallVision(nn.Module):
    """Features of the images of all cameras, to be observed beside the state."""

    def __init__(self, config: ActConfig, dims: PolicyDims) -> None:
        super().__init__()
        self.shape = (dims.cameras, *dims.image, 3)
        self.backbone = CameraEncoder(dims.cameras, config.camera_features, dims.image)
        if config.backbone_learning_rate_factor == 0.0:
            self.backbone.requires_grad_(False)

    def forward(self, images: Tensor | None) -> Tensor:
        """Return (B, N F) float32, F being ``camera_features``.

        Raises:
            ValueError: the images are not (B, 1, N, H, W, 3).
        """
        return self.backbone(_present(images, self.shape))


def _present(images: Tensor | None, shape: tuple[int, ...]) -> Tensor:
    """Return the images (B, N, H, W, 3) of the present step; raise ValueError for other shapes."""
    given = None if images is None else tuple(images.shape[2:])
    if images is None or given != shape:
        raise ValueError(f"images of {shape} are needed for each example, not {given}")
    return images[:, -1]
