"""The residual network: begins as its prior, follows its landmarks, warps, gives intervals."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from face_prediction.forecast import LandmarkSequences
from face_prediction.models.interface import Future, History
from face_prediction.models.residual.model import ResidualModel, cut_out, flow, warp
from face_prediction.models.settings import ResidualSettings, preset_settings
from face_prediction.tracking.geometry import LIPS
from robo_manip_baselines.runs.errors import RequestError

S = 32
SETTINGS = ResidualSettings(
    size=S, pictures=3, region=8, channels=(8, 16), width=8, refiner=8, history=32, recent=16
)
pytestmark = pytest.mark.long


def moving_faces(count: int, frames: int) -> np.ndarray:
    rng = np.random.default_rng(count)
    shape = rng.uniform(0.2, 0.8, (1, 1, 468, 2))
    sway = np.cumsum(np.cumsum(rng.normal(0, 2e-4, (count, frames, 1, 2)), axis=1), axis=1)
    jaw = np.cumsum(rng.normal(0, 2e-3, (count, frames, 1, 1)), axis=1) * (shape[..., 1:] - 0.5)
    shape = shape + sway
    shape[..., 1:] += jaw
    return shape.astype(np.float32)


def pictures(count: int, frames: int, seed: int = 0) -> Tensor:
    rng = np.random.default_rng(seed)
    return torch.tensor(rng.integers(0, 256, (count, frames, S, S, 3), dtype=np.uint8))


@pytest.fixture(scope="module")
def fitted() -> dict[str, Tensor]:
    torch.manual_seed(0)
    model = ResidualModel(SETTINGS)
    sequences = LandmarkSequences(moving_faces(9, 75), tuple(f"p{i}" for i in range(9)))
    model.prepare(sequences, torch.Generator())
    return model.state_dict()


@pytest.fixture
def model(fitted: dict[str, Tensor]) -> ResidualModel:
    result = ResidualModel(SETTINGS)
    result.load_state_dict(fitted)
    return result.eval()


def trained(model: ResidualModel) -> ResidualModel:
    """The same with last layers that are not zero."""
    torch.manual_seed(1)
    for layer in (model.correction.seen, model.correction.change, model.correction.log_scale):
        torch.nn.init.normal_(layer.weight, std=0.3)
    torch.nn.init.normal_(model.refiner.last.weight, std=0.05)
    return model


def history(count: int = 2, frames: int = 32) -> History:
    return History(torch.tensor(moving_faces(count, frames)), pictures(count, 3))


def test_an_untrained_network_is_its_prior(model: ResidualModel) -> None:
    seen = history()
    out = model(seen)
    assert out.landmarks is not None
    assert out.mouth_scale is not None
    mouth, shapes = model.prior.series(seen.landmarks)
    prior = model.prior(mouth, shapes, torch.tensor([31]))
    lips = out.landmarks[:, :, list(LIPS)].mean(dim=2)
    torch.testing.assert_close(lips, mouth[:, -1:] + prior.mouth[:, 0], rtol=0, atol=1e-6)
    torch.testing.assert_close(out.mouth_scale, prior.error[:, 0])


def test_other_landmarks_go_where_the_shapes_say(model: ResidualModel) -> None:
    seen = history()
    out = model(seen).landmarks
    mouth, shapes = model.prior.series(seen.landmarks)
    prior = model.prior(mouth, shapes, torch.tensor([31]))
    moved = (prior.shapes[:, 0] @ model.prior.basis).unflatten(-1, (468, 2))
    others = [i for i in range(468) if i not in LIPS]
    expected = seen.landmarks[:, -1:, others] + moved[:, :, others]
    torch.testing.assert_close(out[:, :, others], expected, rtol=0, atol=1e-6)


def test_pictures_count_once_it_is_trained(model: ResidualModel) -> None:
    model = trained(model)
    seen = history()
    others = History(seen.landmarks, pictures(2, 3, seed=9))
    assert (model(seen).landmarks - model(others).landmarks).abs().max() > 1e-6


def test_forward_is_decode_of_frame_by_frame_features(model: ResidualModel) -> None:
    """State kept by the live predictor equals that of a whole history."""
    model = trained(model)
    seen = history()
    marks = seen.landmarks[:, -3:]
    kept = [model.encode(marks[:, i : i + 2], seen.images[:, i : i + 2]) for i in range(2)]
    live = model.decode(seen.landmarks, torch.cat(kept, dim=1), seen.images[:, -1])
    torch.testing.assert_close(live.landmarks, model(seen).landmarks, rtol=0, atol=1e-6)


def test_a_face_moved_as_a_whole_is_forecast_moved(model: ResidualModel) -> None:
    seen = history()
    there = model(seen).landmarks
    moved = model(History(seen.landmarks + 0.05, seen.images)).landmarks
    torch.testing.assert_close(moved - there, torch.full_like(there, 0.05), rtol=0, atol=2e-4)


def test_loss_falls_and_reaches_every_weight(model: ResidualModel) -> None:
    model.train()
    marks = torch.tensor(moving_faces(4, 37))
    shown = pictures(1, 8).expand(4, -1, -1, -1, -1)
    seen, future = History(marks[:, :32], shown[:, :3]), Future(marks[:, 32:], shown[:, 3:])
    optimizer = torch.optim.Adam(model.parameters(), 1e-2)
    totals = []
    for _ in range(12):
        torch.manual_seed(0)
        losses = model.loss(seen, future)
        optimizer.zero_grad()
        losses.total.backward()
        totals.append(losses.total.item())
        optimizer.step()
    assert totals[-1] < totals[0] - 0.1
    assert set(losses.terms) == {"likelihood", "mouth", "landmarks", "pictures"}
    without = [n for n, p in model.named_parameters() if p.grad is None or not p.grad.any()]
    assert without == []


def test_the_likelihood_is_a_student_t(model: ResidualModel) -> None:
    from scipy.stats import t

    marks = torch.tensor(moving_faces(1, 21))
    shown = pictures(1, 8)
    # 16 frames of history: a single origin
    small = ResidualModel(
        ResidualSettings(**{**SETTINGS.to_json(), "history": 16, "channels": (8, 16)})
    )
    small.load_state_dict(model.state_dict())
    small.eval()
    seen, future = History(marks[:, :16], shown[:, :3]), Future(marks[:, 16:], shown[:, 3:])
    out = small(seen)
    error = (out.landmarks - future.landmarks)[:, :, list(LIPS)].mean(dim=2)[0].detach().numpy()
    expected = -t.logpdf(
        error, out.degrees_of_freedom.detach().numpy(), scale=out.mouth_scale[0].detach().numpy()
    ).mean()
    assert float(small.loss(seen, future).terms["likelihood"]) == pytest.approx(expected, rel=1e-4)


def test_a_shift_of_all_landmarks_carries_the_middle_along() -> None:
    rng = np.random.default_rng(0)
    marks = torch.tensor(rng.uniform(0.3, 0.7, (1, 468, 2)), dtype=torch.float32)
    shift = torch.tensor([0.125, -0.0625])
    moved = flow(marks, (marks + shift)[:, None])
    assert torch.allclose(moved[0, 0, :, 15, 15], shift, rtol=0.05)
    assert moved[0, 0, :, 0, 0].abs().max() < 0.01  # the corner is background


def test_warp_fetches_what_lies_against_the_flow() -> None:
    picture = torch.zeros(1, 3, S, S)
    picture[:, :, 10, 12] = 1.0
    moved = torch.zeros(1, 1, 2, 32, 32)
    moved[:, :, 0], moved[:, :, 1] = 4 / S, -3 / S  # right by 4 pixels, up by 3
    there = warp(picture, moved)[0, 0, 0]
    assert (there > 0.9).nonzero().tolist() == [[7, 16]]


def test_flow_is_the_slow_oracle() -> None:
    rng = np.random.default_rng(2)
    marks = rng.uniform(0.2, 0.8, (1, 468, 2))
    ahead = marks[:, None] + rng.normal(0, 0.02, (1, 2, 468, 2))
    result = flow(torch.tensor(marks), torch.tensor(ahead))
    for h, row, column in [(0, 3, 20), (1, 16, 11)]:
        cell = np.array([column + 0.5, row + 0.5]) / 32
        weight = np.exp(-((ahead[0, h] - cell) ** 2).sum(axis=1) / (2 * 0.05**2))
        expected = (weight[:, None] * (ahead[0, h] - marks[0])).sum(axis=0) / (weight.sum() + 0.3)
        np.testing.assert_allclose(result[0, h, :, row, column], expected, rtol=1e-6)


def test_regions_are_cut_at_the_landmarks() -> None:
    marks = torch.full((1, 1, 468, 2), 0.25)
    marks[0, 0, 10], marks[0, 0, 152] = torch.tensor([0.25, 0.0]), torch.tensor([0.25, 0.5])
    marks[0, 0, list(LIPS)] = torch.tensor([0.625, 0.375])
    picture = torch.zeros(1, 1, 3, 64, 64)
    picture[..., 20:28, 36:44] = 1.0  # around (0.625, 0.375) of 64 pixels
    mouth = cut_out(picture, marks, 8)[0, 0, 0, 0]
    assert mouth[2:6, 2:6].min() == 1.0  # side 0.25: 16 pixels, of which the middle 8 are white
    assert mouth[0].max() == 0.0


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"size": 100}, "size"),
        ({"pictures": 1}, "pictures"),
        ({"recent": 99}, "recent"),
        ({"history": 16, "pictures": 40, "recent": 8}, "pictures"),
        ({"region": 8, "channels": (4, 4, 4, 4)}, "halvings"),
        ({"dropout": 1.0}, "dropout"),
    ],
)
def test_settings_refuse_what_cannot_be(values: dict[str, object], words: str) -> None:
    with pytest.raises(RequestError, match=words):
        ResidualSettings(**values)  # type: ignore[arg-type]


def test_settings_survive_json() -> None:
    settings, _ = preset_settings("residual", "cpu")
    assert type(settings).from_json(settings.to_json()) == settings
