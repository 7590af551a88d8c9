"""A network as a policy: every row for itself, whatever runs beside it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from robo_manip_baselines.data.normalization import Normalization
from robo_manip_baselines.observation import ObservationSpec, ObservedNames
from robo_manip_baselines.policy.execution import WARM_UP, PolicyRunner
from robo_manip_baselines.policy.interface import PolicyModel
from robo_manip_baselines.policy.presets import ActionExecution
from robo_manip_baselines.runs.errors import RequestError

SPEC = ObservationSpec(obs="current", cameras=("angle", "top"), image_size=(6, 8))
SIZE = len(SPEC.vector_names(ObservedNames()))
ENSEMBLE, FIRST = ActionExecution(), ActionExecution(temporal_ensemble=False, n_action_steps=2)


class Network(PolicyModel):
    """Uses all of its inputs, and notes the shapes that it is called with."""

    chunk_size = 4
    factors: Tensor

    def __init__(self) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(1)
        self.weight = nn.Parameter(torch.randn(SIZE, 28, generator=generator))
        self.convolution = nn.Conv2d(3, 1, 3, bias=False)
        nn.init.constant_(self.convolution.weight, 0.01)
        self.register_buffer("factors", torch.tensor([[1.0], [2.0]]))
        self.rows: list[int] = []

    def predict(self, state: Tensor, images: Tensor | None, noise: Tensor | None) -> Tensor:
        assert images is not None
        assert noise is None
        assert images.dtype == torch.uint8
        assert images.shape[1:] == (1, 2, 6, 8, 3)
        assert not self.training
        assert not torch.is_grad_enabled()
        self.rows.append(len(state))
        views = images[:, -1].permute(0, 1, 4, 2, 3).float().flatten(0, 1) / 255
        seen = self.convolution(views).mean((1, 2, 3)).view(-1, 2)
        seen = seen @ self.factors
        return ((state[:, -1] @ self.weight).tanh() + seen).view(-1, 4, 7)


def normalization() -> Normalization:
    rng = np.random.default_rng(0)
    draw = [rng.uniform(0.5, 2.0, n).astype(np.float32) for n in (SIZE, SIZE, 7, 7)]
    return Normalization(*draw)


Observed = tuple[NDArray[np.float32], NDArray[np.uint8]]


def observe(count: int, seed: int = 0) -> Observed:
    """Vectors (b, S) and images (b, N, H, W, 3)."""
    rng = np.random.default_rng(seed)
    vectors = rng.normal(size=(count, SIZE)).astype(np.float32)
    return vectors, rng.integers(0, 256, (count, 2, 6, 8, 3)).astype(np.uint8)


def policy(
    num_envs: int,
    execution: ActionExecution = ENSEMBLE,
    tile: int | None = None,
    device: str = "cpu",
) -> PolicyRunner:
    return PolicyRunner(
        Network(), SPEC, normalization(), execution, num_envs=num_envs, tile=tile, device=device
    )


@pytest.mark.cuda
def test_a_gpu_acts_as_a_cpu_does() -> None:
    """The first predictions are computed, the others replayed."""
    on_cpu, on_gpu = (policy(5, device=device) for device in ("cpu", "cuda"))
    for step in range(6):
        observations = observe(5, step)
        given = [one.act(*observations, np.arange(5)) for one in (on_cpu, on_gpu)]
        np.testing.assert_allclose(given[0], given[1], atol=5e-3)  # TF32 convolution


def test_the_first_action_is_what_the_network_says_in_units_of_the_joints() -> None:
    observations = observe(2)
    given = policy(2).act(*observations, np.arange(2))
    model, scale = Network().eval(), normalization()
    state = torch.from_numpy(scale.normalize_state(observations[0]))
    images = torch.from_numpy(observations[1][:, None])
    with torch.no_grad():
        expected = scale.unnormalize_action(
            model.predict(state[:, None], images, None)[:, 0].numpy()
        )
    assert given.dtype == np.float32
    np.testing.assert_allclose(given, expected, rtol=1e-5, atol=1e-6)


CUDA = pytest.param("cuda", marks=pytest.mark.cuda)


@pytest.mark.parametrize("device", ["cpu", CUDA])
@pytest.mark.parametrize("execution", [ENSEMBLE, FIRST])
@pytest.mark.parametrize("tile", [None, 1, 4])
def test_a_row_does_not_depend_on_its_neighbours(
    execution: ActionExecution, tile: int | None, device: str
) -> None:
    """Bit for bit, in another environment, another order and with other rows beside it."""
    many, alone = policy(7, execution, tile, device), policy(3, execution, tile, device)
    rows = np.array([6, 2, 0, 5, 1])
    for step in range(5):
        observations = observe(5, step)
        together = many.act(*observations, rows)
        single = alone.act(*(part[1:2] for part in observations), np.array([0]))
        np.testing.assert_array_equal(together[1:2], single)


@pytest.mark.parametrize(("tile", "rows"), [(None, [1] * 5), (2, [2, 2, 2]), (8, [8])])
def test_the_network_always_sees_whole_tiles(tile: int | None, rows: list[int]) -> None:
    runner = policy(5, tile=tile)
    runner.act(*observe(5), np.arange(5))
    assert runner._model.rows == rows


def test_only_environments_that_need_a_prediction_are_computed() -> None:
    runner = policy(3, FIRST)
    both, one = np.array([0, 2]), np.array([2])
    assert runner.needs_images(both).all()
    runner.act(*observe(2), both)
    assert not runner.needs_images(both).any()
    stale, fresh = policy(3, FIRST), runner
    stale.act(*observe(2), both)
    vectors, images = observe(2, 1)
    np.testing.assert_array_equal(
        fresh.act(vectors, images, both), stale.act(vectors, images * 0, both)
    )
    assert fresh._model.rows == [1, 1]
    fresh.reset(one, [5])
    assert fresh.needs_images(np.array([0, 2])).tolist() == [True, True]


@pytest.mark.parametrize("execution", [ENSEMBLE, FIRST])
def test_the_time_of_a_prediction_is_measured_and_leaves_nothing(
    execution: ActionExecution,
) -> None:
    own, other = policy(2, execution), policy(2, execution)
    assert 0.0 < own.prediction_time(repeats=4) < 60.0
    network = own._model
    assert isinstance(network, Network)
    assert len(network.rows) == WARM_UP + 4  # steps without a prediction do not count
    both = np.arange(2)
    for runner in (own, other):
        runner.reset(both, [1, 2])
    for seed in range(3):
        vectors, images = observe(2, seed)
        np.testing.assert_array_equal(
            own.act(vectors, images, both), other.act(vectors, images, both)
        )


def test_rows_of_a_tile_that_are_not_used_do_not_matter() -> None:
    """Memory left by an earlier tile is wiped, so that even its NaNs do no harm."""
    runner = policy(4, tile=4)
    runner._state_tile.fill_(torch.nan)
    runner.act(*observe(1), np.array([0]))
    assert not torch.isnan(runner._state_tile).any()


def test_numbers_that_are_not_finite_are_refused() -> None:
    runner = policy(1)
    with torch.no_grad():
        runner._model.weight.fill_(torch.nan)
    with pytest.raises(RequestError, match="not finite"):
        runner.act(*observe(1), np.array([0]))


def test_bf16_is_close_and_other_precisions_are_refused() -> None:
    half = PolicyRunner(
        Network(), SPEC, normalization(), ENSEMBLE, num_envs=1, precision="bf16"
    ).act(*observe(1), np.array([0]))
    full = policy(1).act(*observe(1), np.array([0]))
    # bf16 has 8 bits: sums of 18 products of about 1, through tanh, scaled by up to 2.
    np.testing.assert_allclose(half, full, atol=0.1)
    assert not np.array_equal(half, full)
    with pytest.raises(RequestError, match="unknown precision 'fp8'"):
        PolicyRunner(Network(), SPEC, normalization(), ENSEMBLE, num_envs=1, precision="fp8")


class Remembering(PolicyModel):
    """Its action is the noise beside the window of observations."""

    chunk_size, n_obs_steps, sample_noise_size = 4, 3, 2

    def __init__(self) -> None:
        super().__init__()
        self.windows: list[tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.float32]]] = []

    def predict(self, state: Tensor, images: Tensor | None, noise: Tensor | None) -> Tensor:
        assert images is not None
        assert noise is not None
        self.windows.append((state.numpy().copy(), images.numpy().copy(), noise.numpy().copy()))
        return noise.sum(1)[:, None, None].expand(-1, 4, 7)


def play(runner: PolicyRunner, envs: dict[int, int], steps: int) -> list[NDArray[np.float32]]:
    """Let episodes (environment -> seed) run; images that are not needed are spoilt."""
    env_ids = np.array(list(envs))
    runner.reset(env_ids, list(envs.values()))
    actions = []
    for step in range(steps):
        rows = [observe(1, 100 * seed + step) for seed in envs.values()]
        vectors, images = map(np.concatenate, zip(*rows, strict=True))
        images[~runner.needs_images(env_ids)] = 77
        actions.append(runner.act(vectors, images, env_ids))
    return actions


@pytest.mark.parametrize("n_action_steps", [0, 1, 2, 4])
def test_the_window_holds_the_last_observations(n_action_steps: int) -> None:
    """0 stands for the ensemble. The first observation is repeated, and images are in step."""
    execution = ENSEMBLE
    if n_action_steps:
        execution = ActionExecution(temporal_ensemble=False, n_action_steps=n_action_steps)
    model, scale = Remembering(), normalization()
    runner = PolicyRunner(model, SPEC, scale, execution, num_envs=2)
    play(runner, {1: 8}, 3)  # an earlier episode
    model.windows.clear()
    play(runner, {1: 9}, 9)
    predicted = range(0, 9, n_action_steps or 1)
    assert len(model.windows) == len(predicted)
    for step, (state, images, _) in zip(predicted, model.windows, strict=True):
        for place, past in enumerate((2, 1, 0)):
            vectors, views = observe(1, 900 + max(step - past, 0))
            np.testing.assert_array_equal(state[:, place], scale.normalize_state(vectors))
            np.testing.assert_array_equal(images[:, place], views)


def test_noise_is_a_function_of_the_episodes_seed_and_of_the_step() -> None:
    def runner() -> tuple[Remembering, PolicyRunner]:
        model = Remembering()
        return model, PolicyRunner(model, SPEC, normalization(), ENSEMBLE, num_envs=4)

    (one, first), (other, second) = runner(), runner()
    together = play(first, {2: 5, 0: 6}, 4)
    play(second, {3: 1}, 2)
    alone = play(second, {3: 6}, 4)
    for a, b in zip(together, alone, strict=True):
        np.testing.assert_array_equal(a[1:], b)
    noise = np.concatenate([window[2] for window in one.windows])
    assert len(np.unique(noise)) == noise.size == 2 * 4 * 2
    np.testing.assert_array_equal(
        noise[1::2], np.concatenate([window[2] for window in other.windows[2:]])
    )
