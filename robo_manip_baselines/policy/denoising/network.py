"""Network of the policies that turn noise into actions, and their common parts.

Legend: B batch, O observation steps, S elements of the state, N cameras, H and W image height and
width, K actions of a chunk, A elements of an action, C channels, D hidden size, P keypoints.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn

from robo_manip_baselines.policy.act.resnet import MEAN, STD, ResNet18
from robo_manip_baselines.policy.denoising.config import GROUPS, DenoisingConfig, Loss
from robo_manip_baselines.policy.interface import Batch, PolicyDims, PolicyModel

LONGEST_WAVE = 10_000.0
"""Longest wavelength over the shortest of an embedded noise level (Vaswani et al. 2017)."""

TIME_SCALE = 100.0
"""Noise levels from 0 to 1 are embedded as the steps 0 to 100 of Chi et al."""

SMALL_VISION = (16, 32, 64, 64)
"""Channels of the four convolutions of the small image encoder."""


def sines(values: Tensor, size: int) -> Tensor:
    """Return sines and cosines (..., size) of values (...), of wavelengths that grow evenly."""
    half = size // 2
    exponent = torch.arange(half, device=values.device, dtype=torch.float32) / max(half - 1, 1)
    angle = values.float()[..., None] * LONGEST_WAVE**-exponent
    return torch.cat([angle.sin(), angle.cos()], dim=-1)


class StepBlock(nn.Module):
    """Two convolutions over the steps beside a shortcut, scaled and shifted by a condition."""

    def __init__(self, channels_in: int, channels: int, condition: int, kernel: int) -> None:
        super().__init__()
        self.first = _convolution(channels_in, channels, kernel)
        self.modulation = nn.Linear(condition, 2 * channels)
        self.second = _convolution(channels, channels, kernel)
        same = channels_in == channels
        self.shortcut = nn.Identity() if same else nn.Conv1d(channels_in, channels, 1)

    def forward(self, x_BCK: Tensor, condition: Tensor) -> Tensor:
        """Return (B, C, K); ``condition`` is (B, D)."""
        scale, shift = self.modulation(condition)[..., None].chunk(2, dim=1)
        hidden = torch.addcmul(shift, self.first(x_BCK), scale)  # FiLM (Perez et al. 2018)
        return self.second(hidden) + self.shortcut(x_BCK)


def _convolution(channels_in: int, channels: int, kernel: int) -> nn.Sequential:
    convolution = nn.Conv1d(channels_in, channels, kernel, padding=kernel // 2)
    return nn.Sequential(convolution, nn.GroupNorm(GROUPS, channels), nn.Mish())


class StepUNet(nn.Module):
    """Convolutional network over the steps of a chunk (Chi et al. 2023; Janner et al. 2022).

    Each level has two blocks on the way down and two on the way up, where it also sees what the
    way down found; all levels but the last halve the steps.
    """

    def __init__(self, config: DenoisingConfig, channels_in: int, channels_out: int) -> None:
        super().__init__()
        widths, kernel = config.channels, config.kernel_size
        condition = 2 * config.hidden_size

        def blocks(first: int, width: int) -> nn.ModuleList:
            pair = (
                StepBlock(first, width, condition, kernel),
                StepBlock(width, width, condition, kernel),
            )
            return nn.ModuleList(pair)

        self.down, self.up = nn.ModuleList(), nn.ModuleList()
        self.shrink, self.stretch = nn.ModuleList(), nn.ModuleList()
        for below, width in zip((channels_in, *widths[:-1]), widths, strict=True):
            self.down.append(blocks(below, width))
        for below, width in zip(widths[-2::-1], widths[:0:-1], strict=True):
            self.shrink.insert(0, nn.Conv1d(below, below, 3, stride=2, padding=1))
            self.up.append(blocks(2 * width, below))
            self.stretch.append(nn.ConvTranspose1d(below, below, 4, stride=2, padding=1))
        self.middle = blocks(widths[-1], widths[-1])
        self.activation = nn.Mish()
        last = nn.Conv1d(widths[0], channels_out, 1)
        self.head = nn.Sequential(_convolution(widths[0], widths[0], kernel), last)

    def forward(self, action: Tensor, time: Tensor, observation: Tensor) -> Tensor:
        """Return (B, K, A) from actions (B, K, A'), embedded level and observation (B, D) each."""
        condition = self.activation(torch.cat([time, observation], dim=1))
        x, seen = action.transpose(1, 2), []
        for level, pair in enumerate(self.down):
            x = _through(pair, x, condition)
            if level < len(self.shrink):
                seen.append(x)
                x = self.shrink[level](x)
        seen.append(x)
        x = _through(self.middle, x, condition)
        for pair, stretch in zip(self.up, self.stretch, strict=True):
            x = stretch(_through(pair, torch.cat([x, seen.pop()], dim=1), condition))
        return self.head(x).transpose(1, 2)


def _through(blocks: nn.Module, x: Tensor, condition: Tensor) -> Tensor:
    for block in blocks.children():
        x = block(x, condition)
    return x


class StepTransformer(nn.Module):
    """Tokens for the steps of a chunk that attend to noise level and observation.

    As in Chi et al. 2023 but that a step also attends to later ones.
    """

    def __init__(self, config: DenoisingConfig, channels_in: int, channels_out: int) -> None:
        super().__init__()
        width = config.hidden_size
        self.first = nn.Linear(channels_in, width)
        self.positions = nn.Parameter(0.02 * torch.randn(config.chunk_size, width))
        self.places = nn.Parameter(0.02 * torch.randn(2, width))  # of level and observation
        layer = nn.TransformerDecoderLayer(
            *(width, config.num_heads, 4 * width, config.dropout),
            activation="gelu",
            batch_first=True,
            norm_first=True,
        )
        self.layers = nn.TransformerDecoder(layer, config.num_layers, nn.LayerNorm(width))
        self.head = nn.Linear(width, channels_out)

    def forward(self, action: Tensor, time: Tensor, observation: Tensor) -> Tensor:
        """Return (B, K, A) from actions (B, K, A'), embedded level and observation (B, D) each."""
        memory = torch.stack([time, observation], dim=1) + self.places
        return self.head(self.layers(self.first(action) + self.positions, memory))


class ChunkPerceptron(nn.Module):
    """Residual perceptron over a whole chunk, scaled and shifted by the condition.

    On a processor it takes a fourth of the time of the others.
    """

    def __init__(self, config: DenoisingConfig, channels_in: int, channels_out: int) -> None:
        super().__init__()
        chunk, width = config.chunk_size, 4 * config.hidden_size
        self.shape = chunk, channels_out
        self.first = nn.Linear(chunk * channels_in + 2 * config.hidden_size, width)
        self.modulation = nn.Linear(2 * config.hidden_size, 2 * width * config.num_layers)
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(config.num_layers))
        self.widen = nn.ModuleList(nn.Linear(width, width) for _ in range(config.num_layers))
        self.narrow = nn.ModuleList(nn.Linear(width, width) for _ in range(config.num_layers))
        self.head = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, chunk * channels_out))
        self.activation = nn.GELU()

    def forward(self, action: Tensor, time: Tensor, observation: Tensor) -> Tensor:
        """Return (B, K, A) from actions (B, K, A'), embedded level and observation (B, D) each."""
        condition = self.activation(torch.cat([time, observation], dim=1))
        modulations = iter(self.modulation(condition).chunk(2 * len(self.norms), dim=1))
        x = self.first(torch.cat([action.flatten(1), time, observation], dim=1))
        for norm, widen, narrow in zip(self.norms, self.widen, self.narrow, strict=True):
            hidden = norm(x) * (1.0 + next(modulations)) + next(modulations)
            x = x + narrow(self.activation(widen(hidden)))
        return self.head(x).unflatten(1, self.shape)


NETWORKS = {"unet": StepUNet, "transformer": StepTransformer, "perceptron": ChunkPerceptron}


class ImageEncoder(nn.Module):
    """Image features as coordinates of keypoints: convolutions, then a spatial softmax.

    The ResNet-18 is ACT's, whose normalisation is frozen, in place of the group normalisation of
    Chi et al.; to shift images at random is an option of the training.
    """

    mean: Tensor
    scale: Tensor

    def __init__(self, vision: str, keypoints: int) -> None:
        super().__init__()
        self.is_small = vision == "small"
        if self.is_small:
            layers: list[nn.Module] = []
            for width_in, width in zip((3, *SMALL_VISION[:-1]), SMALL_VISION, strict=True):
                layers += [nn.Conv2d(width_in, width, 3, stride=2, padding=1)]
                layers += [nn.GroupNorm(GROUPS, width), nn.Mish()]
            self.convolutions = nn.Sequential(*layers)
            width = SMALL_VISION[-1]
        else:
            self.convolutions = ResNet18()
            width = self.convolutions.features
        self.maps = nn.Conv2d(width, keypoints, 1)
        self.register_buffer("mean", 255.0 * torch.tensor(MEAN).view(3, 1, 1), persistent=False)
        scale = 1.0 / (255.0 * torch.tensor(STD).view(3, 1, 1))
        self.register_buffer("scale", scale, persistent=False)

    def forward(self, images: Tensor) -> Tensor:
        """Return (I, 2 P) from images (I, H, W, 3) uint8."""
        if self.is_small:  # the ResNet normalises by itself
            images = (images.permute(0, 3, 1, 2).float() - self.mean) * self.scale
        return keypoints(self.maps(self.convolutions(images)).float())


def keypoints(maps: Tensor) -> Tensor:
    """Return the mean places (I, 2 P), -1 to 1, of softmaxes over maps (I, P, h, w)."""
    weight = maps.flatten(2).softmax(-1).unflatten(2, maps.shape[2:])
    rows, columns = (torch.linspace(-1.0, 1.0, n, device=maps.device) for n in maps.shape[2:])
    y = (weight.sum(3) * rows).sum(2)
    x = (weight.sum(2) * columns).sum(2)
    return torch.cat([x, y], dim=1)


class DenoisingModel(PolicyModel):
    """Policy whose network tells, for noisy actions of a known level, the noise or the actions.

    A policy adds a `loss` and a `sample`. Initial weights come from PyTorch's default generator.

    Args:
        config: of the network.
        dims: of inputs and outputs.
        marks_prefix: the network also sees which steps of the chunk are fixed.
    """

    def __init__(
        self, config: DenoisingConfig, dims: PolicyDims, *, marks_prefix: bool = False
    ) -> None:
        super().__init__()
        self.chunk_size, self.n_obs_steps = config.chunk_size, config.n_obs_steps
        self.action_size, self.max_guidance = dims.action, config.max_guidance
        self.sampling_noise = config.sampling_noise
        self.error: Loss = config.loss
        self.strategies = ("rtc",)
        width = config.hidden_size
        self.vision = ImageEncoder(config.vision, config.keypoints) if dims.cameras else None
        features = dims.state + dims.cameras * 2 * config.keypoints
        self.observation = nn.Sequential(
            nn.Linear(config.n_obs_steps * features, 2 * width),
            nn.LayerNorm(2 * width),
            nn.GELU(),
            nn.Linear(2 * width, width),
        )
        self.time = nn.Sequential(
            nn.Linear(width, 4 * width), nn.Mish(), nn.Linear(4 * width, width)
        )
        self.time_width = width
        self.network = NETWORKS[config.backbone](config, dims.action + marks_prefix, dims.action)
        self.marks_prefix = marks_prefix
        self.finds_action = config.target == "action"

    def sample(
        self,
        observed: Tensor,
        noise: Tensor | None,
        action: Tensor | None = None,
        weight: Tensor | None = None,
    ) -> Tensor:
        """Return a chunk (B, K, A), for an embedded observation, from noise (B, Z).

        With a weight (B, K) it is guided towards ``action`` (B, K, A).
        """
        raise NotImplementedError

    def predict(self, state: Tensor, images: Tensor | None, noise: Tensor | None) -> Tensor:
        """Return normalised actions (B, K, A)."""
        return self.sample(self.observe(state, images), self.scaled(noise))

    def inpaint(
        self,
        state: Tensor,
        images: Tensor | None,
        noise: Tensor | None,
        action: Tensor,
        weight: Tensor,
    ) -> Tensor:
        """Return a chunk that is guided towards ``action``: real-time chunking."""
        return self.sample(self.observe(state, images), self.scaled(noise), action, weight)

    def scaled(self, noise: Tensor | None) -> Tensor | None:
        """Return the noise of predictions, of which ``noise`` (B, Z) has a deviation of 1."""
        return noise if noise is None else self.sampling_noise * noise

    def observe(self, state: Tensor, images: Tensor | None) -> Tensor:
        """Return the embedded observation (B, D) of (B, O, S) and (B, O, N, H, W, 3)."""
        parts = [state.flatten(1)]
        if self.vision is not None:
            assert images is not None
            parts.append(self.vision(images.flatten(0, 2)).view(len(state), -1))
        return self.observation(torch.cat(parts, dim=1))

    def found(
        self, observed: Tensor, action: Tensor, time: Tensor, is_fixed: Tensor | None = None
    ) -> Tensor:
        """Return the target (B, K, A) float32 for actions (B, K, A) at levels (B,) from 0 to 1.

        ``observed`` is of `observe`; ``is_fixed`` (B, K), only for a network that marks prefixes.
        """
        level = self.time(sines(TIME_SCALE * time, self.time_width))
        if is_fixed is not None:
            action = torch.cat([action, is_fixed[..., None].to(action.dtype)], dim=-1)
        return self.network(action, level, observed).float()


def guidance(
    estimate: Callable[[Tensor], Tensor], noisy: Tensor, action: Tensor, weight: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the direction in which an estimate of the actions comes closer to ``action``.

    It is the gradient of half the weighted squared distance, the transposed Jacobian of the
    estimate times the weighted difference (pseudoinverse guidance: Song et al. 2023; Pokle et al.
    2024 for flows).

    Args:
        estimate: of the actions (B, K, A) from noisy ones.
        noisy: (B, K, A).
        action: (B, K, A), the chunk that goes on.
        weight: (B, K), 1 where the chunk is to be ``action``, 0 where it is free.

    Returns:
        The direction and the estimate, (B, K, A) each.
    """
    with torch.enable_grad():
        place = noisy.detach().requires_grad_()
        found = estimate(place)
        difference = (weight[..., None] * (action - found)).detach()
        (direction,) = torch.autograd.grad(found, place, difference)
    return direction, found.detach()


def filled(batch: Batch) -> Tensor:
    """Return the actions (B, K, A) of examples; padding repeats the last action of the episode.

    As in Chi et al., where the network learns to stay there: its steps are not independent, and
    what it makes of the steps after the end must not disturb those before it.
    """
    last = (~batch.is_pad).sum(dim=1).sub(1)[:, None, None]
    last = last.expand(-1, 1, batch.action.shape[2])
    return torch.where(batch.is_pad[..., None], batch.action.gather(1, last), batch.action)


def mean_error(found: Tensor, wanted: Tensor, batch: Batch, loss: Loss) -> Tensor:
    """Return the mean error over all steps of (B, K, A), with the weights of the batch."""
    difference = found - wanted
    error = batch.weighted(difference.abs() if loss == "l1" else difference.square())
    return error.sum() / (batch.num_examples * math.prod(found.shape[1:]))
