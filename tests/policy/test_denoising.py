"""Diffusion and Flow: samplers against distributions known in closed form, and their networks."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.stats import norm
from torch import Tensor

from robo_manip_baselines.policy.denoising.config import DenoisingConfig
from robo_manip_baselines.policy.denoising.network import (
    DenoisingModel,
    filled,
    guidance,
    keypoints,
    sines,
)
from robo_manip_baselines.policy.diffusion.config import DiffusionConfig
from robo_manip_baselines.policy.diffusion.model import DiffusionModel, squared_cosine
from robo_manip_baselines.policy.flow.config import FlowConfig
from robo_manip_baselines.policy.flow.model import FlowModel
from robo_manip_baselines.policy.interface import Batch, PolicyDims
from robo_manip_baselines.policy.registry import make_model, policy_presets
from robo_manip_baselines.runs.errors import RequestError

DIMS = PolicyDims(state=3, action=1, cameras=0, image=(32, 40))
SMALL: dict[str, Any] = {
    "chunk_size": 8,
    "channels": (8, 16),
    "hidden_size": 16,
    "num_layers": 1,
    "num_heads": 2,
    "vision": "small",
    "keypoints": 4,
}
ONE: dict[str, Any] = {**SMALL, "chunk_size": 1, "backbone": "perceptron"}

# -- samplers: a mixture of two normal distributions in one dimension ---------------------

WEIGHTS, MEANS, DEVIATIONS = (
    torch.tensor(values, dtype=torch.float64) for values in ([0.3, 0.7], [-0.6, 0.4], [0.1, 0.2])
)


def mean_action(noisy: Tensor, signal: Tensor, spread: Tensor) -> Tensor:
    """E[a | signal a + spread z = noisy] of an action of the mixture and of unit noise z."""
    noisy, signal, spread = (x.double()[..., None] for x in (noisy, signal, spread))
    variance = (signal * DEVIATIONS) ** 2 + spread**2
    log_share = WEIGHTS.log() - 0.5 * variance.log() - (noisy - signal * MEANS) ** 2 / variance / 2
    each = MEANS + signal * DEVIATIONS**2 * (noisy - signal * MEANS) / variance
    return (log_share.softmax(-1) * each).sum(-1)


class ExactFlow(FlowModel):
    """Its velocity is the mean one of the mixture."""

    def found(
        self, observed: Tensor, action: Tensor, time: Tensor, is_fixed: Tensor | None = None
    ) -> Tensor:
        at = time.double()[:, None, None]
        mean = mean_action(action, at, 1 - at)
        return mean if self.finds_action else (mean - action) / (1 - at)


class ExactDiffusion(DiffusionModel):
    """Its noise is the mean one of the mixture."""

    def found(
        self, observed: Tensor, action: Tensor, time: Tensor, is_fixed: Tensor | None = None
    ) -> Tensor:
        level = (time * self.config.diffusion_steps).round().long()
        signal = torch.from_numpy(self.shares)[level][:, None, None]
        mean = mean_action(action, signal.sqrt(), (1 - signal).sqrt())
        if self.finds_action:
            return mean
        return (action - signal.sqrt() * mean) / (1 - signal).sqrt()


def distribution(values: np.ndarray) -> np.ndarray:
    """Cumulative distribution of the mixture."""
    parts = [norm.cdf(values, m, d) for m, d in zip(MEANS, DEVIATIONS, strict=True)]
    return np.einsum("i,in->n", WEIGHTS, parts)


@pytest.mark.parametrize("target", ["noise", "action"])
@pytest.mark.parametrize("policy", ["Flow", "Diffusion"])
def test_noise_becomes_the_quantile_of_the_mixture(policy: str, target: Any) -> None:
    """In one dimension paths do not cross: noise goes to the action of the same quantile."""
    steps: dict[str, Any] = {**ONE, "target": target, "sampling_steps": 400}
    model = (
        ExactFlow(FlowConfig(**steps), DIMS)
        if policy == "Flow"
        else ExactDiffusion(DiffusionConfig(**steps, diffusion_steps=400), DIMS)
    )
    share = np.linspace(0.01, 0.99, 99)
    noise = torch.from_numpy(norm.ppf(share))[:, None]
    actions = model.double().predict(torch.zeros(99, 2, 3).double(), None, noise).detach()
    # Errors are of first order in the steps, and the first level of Diffusion has some signal.
    np.testing.assert_allclose(distribution(actions.numpy().ravel()), share, atol=0.02)


def test_noise_on_the_way_leaves_the_distribution_as_it_is() -> None:
    config = DiffusionConfig(**ONE, diffusion_steps=100, sampling_steps=100, eta=1.0)
    model = ExactDiffusion(config, DIMS)
    assert model.sample_noise_size == 100
    count = 4000
    noise = torch.randn(count, 100, generator=torch.Generator().manual_seed(0)).double()
    actions = model.double().predict(torch.zeros(count, 2, 3).double(), None, noise).detach()
    share = np.sort(distribution(actions.numpy().ravel()))
    # Kolmogorov-Smirnov: 1.95 / sqrt(n) is exceeded once in a thousand; and the levels' width.
    assert np.abs(share - (np.arange(count) + 0.5) / count).max() < 1.95 / math.sqrt(count) + 0.02


def test_guidance_is_the_gradient_of_the_weighted_distance() -> None:
    generator = torch.Generator().manual_seed(3)
    matrix = torch.randn(5, 5, generator=generator)
    noisy, action = torch.randn(2, 1, 5, 1, generator=generator)
    weight = torch.tensor([[1.0, 1.0, 0.5, 0.0, 0.0]])
    direction, estimate = guidance(lambda x: matrix @ x, noisy, action, weight)
    torch.testing.assert_close(estimate, matrix @ noisy)
    expected = matrix.T @ (weight[..., None] * (action - matrix @ noisy))
    torch.testing.assert_close(direction, expected)


def test_the_schedule_is_the_squared_cosine() -> None:
    shares = squared_cosine(100)
    steps = np.arange(1, 100)
    wanted = np.cos((steps / 100 + 0.008) / 1.008 * np.pi / 2) ** 2
    wanted /= np.cos(0.008 / 1.008 * np.pi / 2) ** 2
    np.testing.assert_allclose(shares[:-1], wanted, rtol=1e-9)
    assert shares[-1] == pytest.approx(shares[-2] * 0.001)


@pytest.mark.parametrize(("steps", "levels"), [(1, [99]), (2, [99, 0]), (4, [99, 66, 33, 0])])
def test_sampling_visits_levels_from_noise_to_actions(steps: int, levels: list[int]) -> None:
    model = DiffusionModel(DiffusionConfig(**ONE, sampling_steps=steps), DIMS)
    visited = list(model._levels())
    assert [level for level, _, _ in visited] == levels
    assert [after for _, _, after in visited] == [*(s for _, s, _ in visited[1:]), 1.0]


# -- training -------------------------------------------------------------------------------------


def make(kind: type[DenoisingModel], config: Any, dims: PolicyDims = DIMS) -> Any:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(5)
        return kind(config, dims).eval()


def make_batch(model: DenoisingModel, dims: PolicyDims = DIMS, batch: int = 3) -> Batch:
    generator = torch.Generator().manual_seed(11)
    chunk = model.chunk_size
    is_pad = torch.arange(chunk)[None] >= torch.tensor([chunk, 3, 1])[:batch, None]
    shape = (batch, 2, dims.cameras, *dims.image, 3)
    images = torch.randint(0, 256, shape, generator=generator, dtype=torch.uint8)
    return Batch(
        state=torch.randn(batch, 2, dims.state, generator=generator),
        images=images if dims.cameras else None,
        action=torch.randn(batch, chunk, dims.action, generator=generator),
        is_pad=is_pad,
        noise=torch.randn(batch, model.noise_size, generator=generator),
        num_valid=(~is_pad).sum().float(),
        num_examples=torch.tensor(float(batch)),
    )


def test_padding_repeats_the_last_action() -> None:
    batch = make_batch(make(FlowModel, FlowConfig(**SMALL)))
    actions = filled(batch)
    torch.testing.assert_close(actions[0], batch.action[0])
    for row, length in ((1, 3), (2, 1)):
        torch.testing.assert_close(actions[row, :length], batch.action[row, :length])
        last = batch.action[row, length - 1].expand(8 - length, -1)
        torch.testing.assert_close(actions[row, length:], last)


def test_losses_are_the_mean_errors() -> None:
    flow = make(FlowModel, FlowConfig(**SMALL))
    batch = make_batch(flow)
    action, z, u = filled(batch), batch.noise[:, :8, None], norm.cdf(batch.noise[:, 8])
    time = torch.tensor(u, dtype=torch.float32)
    at = time[:, None, None]
    observed = flow.observe(batch.state, None)
    found = flow.found(observed, (1 - at) * z + at * action, time)
    expected = ((found - (action - z)) ** 2).mean()
    torch.testing.assert_close(flow.loss(batch)["loss"], expected)

    diffusion = make(DiffusionModel, DiffusionConfig(**SMALL))
    level = torch.tensor(np.floor(100 * u)).long()
    a = torch.from_numpy(squared_cosine(100)).float()[level][:, None, None]
    observed = diffusion.observe(batch.state, None)
    found = diffusion.found(observed, a.sqrt() * action + (1 - a).sqrt() * z, level / 100)
    torch.testing.assert_close(diffusion.loss(batch)["loss"], ((found - z) ** 2).mean())
    diffusion = make(DiffusionModel, DiffusionConfig(**SMALL, loss="l1"))
    torch.testing.assert_close(diffusion.loss(batch)["loss"], (found - z).abs().mean())


def test_fixed_actions_are_no_error_and_are_seen() -> None:
    """A prefix of every length from 0 to the largest is trained; its actions are without noise."""
    model = make(FlowModel, FlowConfig(**SMALL, max_prefix=3))
    batch = make_batch(model)
    seen: list[tuple[Tensor, Tensor]] = []
    network = model.found

    def watch(observed: Tensor, action: Tensor, time: Tensor, is_fixed: Tensor) -> Tensor:
        seen.append((action, is_fixed))
        return network(observed, action, time, is_fixed)

    model.found = watch
    lengths = set()
    for share in np.linspace(0.05, 0.95, 8):
        noise = batch.noise.clone()
        noise[:, -1] = norm.ppf(share)
        model.loss(replace(batch, noise=noise))
        action, is_fixed = seen[-1]
        length = int(is_fixed[0].sum())
        assert is_fixed[:, :length].all()
        assert not is_fixed[:, length:].any()
        torch.testing.assert_close(action[:, :length], filled(batch)[:, :length])
        lengths.add(length)
    assert lengths == {0, 1, 2, 3}


# -- continuing a chunk ---------------------------------------------------------------------------


@pytest.mark.parametrize("policy", [FlowModel, DiffusionModel])
def test_without_weights_guidance_changes_nothing(policy: type[DenoisingModel]) -> None:
    config = FlowConfig(**SMALL) if policy is FlowModel else DiffusionConfig(**SMALL)
    model = make(policy, config)
    batch = make_batch(model)
    noise = torch.randn(3, model.sample_noise_size, generator=torch.Generator().manual_seed(2))
    with torch.no_grad():
        free = model.predict(batch.state, None, noise)
        guided = model.inpaint(batch.state, None, noise, batch.action, torch.zeros(3, 8))
    torch.testing.assert_close(guided, free, rtol=0, atol=2e-6)  # float32 sums in another order


@pytest.mark.parametrize(
    "model",
    [
        ExactFlow(FlowConfig(**{**ONE, "chunk_size": 8}, sampling_steps=20), DIMS),
        ExactDiffusion(DiffusionConfig(**{**ONE, "chunk_size": 8}, sampling_steps=20), DIMS),
    ],
    ids=["Flow", "Diffusion"],
)
def test_guidance_draws_a_chunk_towards_the_one_under_way(model: Any) -> None:
    """Steps of the mixture are independent: those that are drawn get there, the others stay."""
    noise = torch.randn(5, 8, generator=torch.Generator().manual_seed(4)).double()
    action, state = torch.full((5, 8, 1), 0.5).double(), torch.zeros(5, 2, 3).double()
    weight = (torch.arange(8) < 4).double().expand(5, -1)
    model = model.double()
    with torch.no_grad():
        free = model.predict(state, None, noise)
        guided = model.inpaint(state, None, noise, action, weight)
    before, after = ((x - action)[:, :4].abs().mean() for x in (free, guided))
    assert after < 0.25 * before
    torch.testing.assert_close(guided[:, 4:], free[:, 4:])


@pytest.mark.parametrize(
    ("policy", "config"),
    [
        (FlowModel, FlowConfig(**SMALL, max_prefix=4)),
        (DiffusionModel, DiffusionConfig(**SMALL)),
        (DiffusionModel, DiffusionConfig(**SMALL, eta=1.0)),
    ],
    ids=["Flow", "DDIM", "DDPM"],
)
def test_predictions_begin_with_noise_of_the_given_deviation(policy: Any, config: Any) -> None:
    batch = make_batch(make(policy, config))
    size, generator = make(policy, config).sample_noise_size, torch.Generator().manual_seed(2)
    noise, weight = torch.randn(3, size, generator=generator), torch.zeros(3, 8)

    def predictions(sampling_noise: float, noise: Tensor) -> list[Tensor]:
        model = make(policy, replace(config, sampling_noise=sampling_noise))
        ways = [model.predict, lambda *x: model.inpaint(*x, batch.action, weight)]
        if model.max_delay:
            ways.append(lambda *x: model.extend(*x, batch.action, weight))
        with torch.no_grad():
            return [way(batch.state, None, noise) for way in ways]

    assert len(predictions(1.0, noise)) == (3 if policy is FlowModel else 2)
    for half, one in zip(predictions(0.5, noise), predictions(1.0, noise / 2), strict=True):
        torch.testing.assert_close(half, one)
    for same, without in zip(predictions(0.0, noise), predictions(0.0, -noise), strict=True):
        torch.testing.assert_close(same, without)


def test_fixed_actions_are_kept() -> None:
    model = make(FlowModel, FlowConfig(**SMALL, max_prefix=4))
    batch = make_batch(model)
    noise = torch.randn(3, model.sample_noise_size, generator=torch.Generator().manual_seed(2))
    weight = (torch.arange(8)[None] < torch.tensor([[0], [2], [4]])).float()
    with torch.no_grad():
        free = model.predict(batch.state, None, noise)
        chunk = model.extend(batch.state, None, noise, batch.action, weight)
    assert torch.equal(chunk[0], free[0])
    for row, length in ((1, 2), (2, 4)):
        assert torch.equal(chunk[row, :length], batch.action[row, :length])
        assert not torch.allclose(chunk[row, length:], free[row, length:])


# -- networks -------------------------------------------------------------------------------------


@pytest.mark.parametrize("channels", [(8,), (8, 16), (8, 16, 24)])
@pytest.mark.parametrize("backbone", ["unet", "transformer", "perceptron"])
def test_every_output_sees_action_time_and_observation(
    backbone: str, channels: tuple[int, ...]
) -> None:
    config = DenoisingConfig(**{**SMALL, "backbone": backbone, "channels": channels})
    model = make(DenoisingModel, config)
    action = torch.randn(1, 8, 1, generator=torch.Generator().manual_seed(1)).requires_grad_()
    observed, time = torch.ones(1, 16, requires_grad=True), torch.tensor([0.3], requires_grad=True)
    found = model.found(observed, action, time)
    assert found.shape == (1, 8, 1)
    gradients = torch.autograd.grad(found.sum(), (action, observed, time))
    assert gradients[0].all()  # each step of the chunk matters
    assert gradients[1].any()
    assert gradients[2].any()


def test_images_and_every_observation_step_are_seen() -> None:
    dims = replace(DIMS, cameras=2)
    model = make(FlowModel, FlowConfig(**SMALL), dims)
    batch = make_batch(model, dims)
    assert batch.images is not None
    before = model.observe(batch.state, batch.images)
    for step in range(2):
        for camera in range(2):
            images = batch.images.clone()
            images[:, step, camera] = 255 - images[:, step, camera]
            assert not torch.allclose(model.observe(batch.state, images), before)


def test_a_keypoint_is_where_the_map_is_large() -> None:
    maps = torch.zeros(1, 2, 5, 9)
    maps[0, 0, 4, 0], maps[0, 1, 2, 8] = 100.0, 100.0
    torch.testing.assert_close(keypoints(maps), torch.tensor([[-1.0, 1.0, 1.0, 0.0]]))


def test_sines_of_the_longest_and_of_the_shortest_wave() -> None:
    found = sines(torch.tensor([3.0]), 4)
    angle = torch.tensor([3.0, 3.0e-4])
    torch.testing.assert_close(found, torch.cat([angle.sin(), angle.cos()])[None])


COUNTS = {"paper": 270_691_559, "cpu": 2_903_520, "cpu_images": 1_113_287}
"""Of both policies: only what is done with the network differs."""


@pytest.mark.parametrize("preset", COUNTS)
@pytest.mark.parametrize("policy", ["Diffusion", "Flow"])
def test_parameters_of_the_presets(policy: str, preset: str) -> None:
    chosen = policy_presets(policy)[preset]
    dims = PolicyDims(29, 7, len(chosen.cameras), chosen.image_size)
    with torch.device("meta"):
        model = make_model(policy, chosen.config, dims)
    count = sum(parameter.numel() for parameter in model.parameters())
    assert count == COUNTS[preset]
    assert chosen.config.num_parameters(dims) == pytest.approx(count, rel=0.15)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"channels": ()}, "channels: must name at least one level"),
        ({"channels": (12,)}, "channels 12: must be a multiple of 8"),
        ({"chunk_size": 30, "channels": (8, 8, 8)}, "chunk_size 30: must be a multiple of 4"),
        ({"kernel_size": 4}, "kernel_size 4: must be odd"),
        ({"hidden_size": 12, "num_heads": 4}, "hidden_size 12: must be a multiple of twice"),
        ({"backbone": "lstm"}, "backbone 'lstm': unknown; valid: unet, transformer, perceptron"),
        ({"sampling_steps": 0}, "sampling_steps 0: must be 1 to"),
    ],
)
def test_wrong_settings_are_one_line(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(RequestError, match=message):
        FlowConfig(**changes)


def test_settings_that_do_not_fit_one_another() -> None:
    with pytest.raises(RequestError, match="max_prefix 16: must be less than chunk_size 16"):
        FlowConfig(max_prefix=16)
    with pytest.raises(RequestError, match="sampling_steps 101: must be 1 to diffusion_steps 100"):
        DiffusionConfig(sampling_steps=101)
