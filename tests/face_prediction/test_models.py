"""The three published approaches against what the paper writes, and settings as records."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
import torch

from face_prediction.forecast.interface import LandmarkSequences
from face_prediction.models.approaches import (
    CrossAttention,
    ImageEncoder,
    LandmarkEncoder,
    sinusoids,
)
from face_prediction.models.interface import Future, History
from face_prediction.models.settings import (
    MODELS,
    PRESETS,
    CrossAttentionSettings,
    FusionSettings,
    make_predictor_model,
    preset_settings,
    settings_class,
)
from robo_manip_baselines.runs.errors import RequestError

APPROACHES = ("image_only", "simple_fusion", "cross_attention")
TINY = {
    "size": 32,
    "channels": (8, 16),
    "width": 16,
    "heads": 2,
    "layers": 1,
    "feedforward": 24,
    "history": 6,
    "horizon": 3,
}


def tiny(name: str, **changes):
    torch.manual_seed(0)
    return make_predictor_model(name, settings_class(name)().changed({**TINY, **changes})).eval()


def history(rows: int = 2, seed: int = 0) -> History:
    g = torch.Generator().manual_seed(seed)
    images = torch.randint(0, 256, (rows, 6, 32, 32, 3), generator=g, dtype=torch.uint8)
    return History(torch.rand(rows, 6, 468, 2, generator=g), images)


def future(rows: int = 2, seed: int = 1) -> Future:
    g = torch.Generator().manual_seed(seed)
    images = torch.randint(0, 256, (rows, 3, 32, 32, 3), generator=g, dtype=torch.uint8)
    return Future(torch.rand(rows, 3, 468, 2, generator=g), images)


def test_cross_attention_is_equations_1_to_3() -> None:
    torch.manual_seed(0)
    attention = CrossAttention(landmark_width=5, image_width=7, width=4).double()
    rng = np.random.default_rng(0)
    landmarks, images = rng.normal(size=(2, 9, 5)), rng.normal(size=(2, 9, 7))
    weight = {name: value.detach().numpy() for name, value in attention.named_parameters()}
    L = landmarks @ weight["query.weight"].T + weight["query.bias"]
    I = images @ weight["key_and_value.weight"].T + weight["key_and_value.bias"]  # noqa: E741
    expected = np.zeros((2, 9, 4))
    for b in range(2):
        for i in range(9):
            a = np.exp(I[b] @ L[b, i] / np.sqrt(4))
            expected[b, i] = (a / a.sum()) @ I[b]
    got = attention(torch.tensor(landmarks), torch.tensor(images)).detach().numpy()
    np.testing.assert_allclose(got, expected, rtol=1e-12)


def test_landmarks_reach_the_output_by_a_residual_connection_alone() -> None:
    """Of images that are all alike equations 1 to 3 make the same, whatever the landmarks are."""
    alike = torch.randn(1, 1, 7).expand(2, 9, 7)
    landmarks = torch.randn(2, 9, 5)
    torch.manual_seed(0)
    plain = CrossAttention(landmark_width=5, image_width=7, width=4)
    fused = plain(landmarks, alike)
    torch.testing.assert_close(fused, plain.key_and_value(alike))
    torch.manual_seed(0)
    connected = CrossAttention(landmark_width=5, image_width=7, width=4, residual=True)
    torch.testing.assert_close(connected(landmarks, alike), fused + plain.query(landmarks))
    names = [
        sorted(dict(tiny("cross_attention", residual=r).named_parameters())) for r in (False, True)
    ]
    assert names[0] == names[1]  # no weights more


def test_settings_of_releases_without_a_residual_connection() -> None:
    settings = CrossAttentionSettings()
    assert not settings.residual
    older = {name: value for name, value in settings.to_json().items() if name != "residual"}
    assert CrossAttentionSettings.from_json(older) == settings
    with pytest.raises(RequestError, match="settings: width: is missing"):
        CrossAttentionSettings.from_json({k: v for k, v in older.items() if k != "width"})


def test_positions_are_those_of_vaswani() -> None:
    expected = [
        [
            f(t / 10_000 ** (2 * (i // 2) / 8))
            for i, f in zip(range(8), (np.sin, np.cos) * 4, strict=True)
        ]
        for t in range(5)
    ]
    np.testing.assert_allclose(sinusoids(5, 8).numpy(), expected, atol=1e-6)


@pytest.mark.parametrize("name", APPROACHES)
def test_what_comes_out(name: str) -> None:
    model = tiny(name)
    with torch.no_grad():
        output = model(history())
    assert output.images.shape == (2, 3, 3, 32, 32)
    assert float(output.images.min()) >= 0.0
    assert float(output.images.max()) <= 1.0
    if name == "image_only":
        assert output.landmarks is None
    else:
        assert output.landmarks.shape == (2, 3, 468, 2)
    assert (model.history, model.horizon) == (6, 3)
    assert (model.needs.frames, model.needs.size) == (6, 32)


@pytest.mark.parametrize("name", APPROACHES)
def test_the_loss_is_equation_5(name: str) -> None:
    model = tiny(name)
    with torch.no_grad():
        output, losses = model(history()), model.loss(history(), future())
    truth = future()
    image = np.mean(
        (output.images.numpy() - truth.images.numpy().transpose(0, 1, 4, 2, 3) / 255.0) ** 2
    )
    expected = {"image": image}
    total = image
    if name != "image_only":
        expected["landmark"] = np.mean((output.landmarks.numpy() - truth.landmarks.numpy()) ** 2)
        total = image + 0.5 * expected["landmark"]
    assert float(losses.total) == pytest.approx(total, rel=1e-5)
    assert {k: float(v) for k, v in losses.terms.items()} == pytest.approx(expected, rel=1e-5)


def differs(a, b) -> bool:
    pairs = [(a.images, b.images), (a.landmarks, b.landmarks)]
    return any(x is not None and float((x - y).abs().max()) > 1e-6 for x, y in pairs)


@pytest.mark.parametrize("name", APPROACHES)
def test_what_is_looked_at(name: str) -> None:
    """Every picture counts for all three; every frame of landmarks for the two fusions only."""
    model = tiny(name)
    seen = history()
    with torch.no_grad():
        before = model(seen)
        for frame in (0, 5):
            images = seen.images.clone()
            images[:, frame] = 255 - images[:, frame]
            assert differs(before, model(History(seen.landmarks, images)))
            landmarks = seen.landmarks.clone()
            landmarks[:, frame] += 0.3
            other = model(History(landmarks, seen.images))
            assert differs(before, other) == (name != "image_only")


@pytest.mark.parametrize("name", APPROACHES)
def test_order_in_time_counts_and_rows_do_not_touch(name: str) -> None:
    model = tiny(name)
    seen = history(rows=3)
    with torch.no_grad():
        output = model(seen)
        order = [4, 2, 0, 1, 3, 5]  # the last one stays
        turned = model(History(seen.landmarks[:, order], seen.images[:, order]))
        alone = model(History(seen.landmarks[1:2], seen.images[1:2]))
    assert differs(output, turned)
    torch.testing.assert_close(alone.images, output.images[1:2], atol=1e-6, rtol=0)


def test_cross_attention_can_tell_the_frames_of_a_face_at_rest() -> None:
    """Positions are in what asks and in what answers: without either, all tokens are alike."""
    model = tiny("cross_attention")
    with torch.no_grad():
        tokens = model.fuse(torch.ones(1, 6, 256), torch.ones(1, 6, 16))
    assert float((tokens[:, 1:] - tokens[:, :-1]).abs().amax(dim=2).min()) > 1e-5


@pytest.mark.parametrize("name", APPROACHES)
def test_features_are_of_one_frame_each(name: str) -> None:
    model = tiny(name)
    seen = history()
    with torch.no_grad():
        together = model.encode(seen.landmarks, seen.images)
        singly = [
            model.encode(seen.landmarks[:, t : t + 1], seen.images[:, t : t + 1]) for t in range(6)
        ]
        output = model.decode(seen.landmarks, together)
        whole = model(seen)
    torch.testing.assert_close(torch.cat(singly, dim=1), together, atol=1e-5, rtol=1e-5)
    assert not differs(output, whole)


def test_landmarks_are_predicted_absolutely() -> None:
    """No way around: with the last layer at zero, the mean face comes out, wherever the face is."""
    model = tiny("cross_attention")
    faces = np.random.default_rng(0).uniform(0.2, 0.8, size=(4, 9, 468, 2)).astype(np.float32)
    model.prepare(LandmarkSequences(faces, tuple("abcd")))
    with torch.no_grad():
        model.landmark_decoder.out.weight.zero_()
        landmarks = model(history()).landmarks.numpy()
    expected = faces.mean(axis=(0, 1))
    np.testing.assert_allclose(landmarks, np.broadcast_to(expected, (2, 3, 468, 2)), atol=1e-6)


def test_landmarks_are_measured_from_the_mean_face_in_units_of_their_spread() -> None:
    encoder = LandmarkEncoder(width=3)
    faces = np.random.default_rng(0).normal(0.5, 0.1, size=(50, 468, 2)).astype(np.float32)
    encoder.set_statistics(torch.tensor(faces))
    spread = np.sqrt(np.mean((faces - faces.mean(axis=0)) ** 2))
    assert float(encoder.spread) == pytest.approx(spread, rel=1e-4)
    with torch.no_grad():
        encoder.linear.weight.zero_()
        encoder.linear.weight[0, 2 * 7 + 1] = 1.0  # v of landmark 7
        encoder.linear.bias.zero_()
        got = encoder(torch.tensor(faces)[None])[0, :, 0].numpy()
    expected = (faces[:, 7, 1] - faces[:, 7, 1].mean()) / spread
    np.testing.assert_allclose(got, expected, atol=1e-4)


def test_a_face_that_never_moves_gives_finite_features() -> None:
    encoder = LandmarkEncoder(width=3)
    encoder.set_statistics(torch.full((5, 468, 2), 0.5))
    assert torch.isfinite(encoder(torch.full((1, 5, 468, 2), 0.5))).all()


def test_colours_and_places_reach_the_features() -> None:
    torch.manual_seed(0)
    encoder = ImageEncoder(32, (8, 16), 16)
    red = torch.zeros(1, 1, 32, 32, 3, dtype=torch.uint8)
    red[..., 0] = 200
    blue = red.flip(-1)
    dot = red.clone()
    dot[0, 0, 3:6, 3:6] = 255
    with torch.no_grad():
        features = [encoder(x) for x in (red, blue, dot, dot.flip(2), dot.flip(3))]
    for i in range(5):
        for j in range(i):
            assert float((features[i] - features[j]).abs().max()) > 1e-4


def test_the_papers_numbers() -> None:
    settings, training = preset_settings("cross_attention", "paper")
    assert isinstance(settings, CrossAttentionSettings)
    assert (settings.size, settings.history, settings.horizon, settings.layers) == (256, 70, 5, 4)
    assert settings.landmark_weight == 0.5
    assert training.learning_rate == 1e-4


@pytest.mark.parametrize("name", APPROACHES)
@pytest.mark.parametrize("preset", PRESETS)
def test_settings_survive_json(name: str, preset: str) -> None:
    settings, _ = preset_settings(name, preset)
    text = json.dumps(settings.to_json())
    assert type(settings).from_json(json.loads(text)) == settings


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"width": 97}, "width=97: not divisible; valid: a multiple of"),
        ({"width": 0}, "width 0: must be 2 or more"),
        ({"size": 100}, "size 100: unknown; valid: 32, 64, 128 or 256"),
        ({"channels": ()}, "channels"),
        ({"channels": (4,) * 8}, "channels"),
        ({"channels": [4.5]}, "channels[0]: must be a whole number, not 4.5"),
        ({"dropout": 1.0}, "dropout 1.0: must be 0.9 or less"),
        ({"heads": True}, "heads: must be a whole number, not true"),
        ({"landmark_weight": -1}, "landmark_weight -1: must be 0 or more"),
        ({"depth": 3}, "unknown name 'depth' (did you mean 'width'?); valid: size, "),
    ],
)
def test_settings_out_of_range_are_refused(values, words: str) -> None:
    with pytest.raises(RequestError) as refused:
        FusionSettings().changed(values)
    assert words in str(refused.value)
    assert "\n" not in str(refused.value)


def test_settings_with_other_keys_are_refused() -> None:
    data = FusionSettings().to_json()
    with pytest.raises(RequestError, match="unknown name 'more'"):
        FusionSettings.from_json({**data, "more": 1})
    del data["width"]
    with pytest.raises(RequestError, match="width: is missing"):
        FusionSettings.from_json(data)


def test_settings_cannot_be_changed_in_place() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        FusionSettings().width = 3  # pyright: ignore[reportAttributeAccessIssue]


def test_an_unknown_name_lists_the_known_ones() -> None:
    with pytest.raises(RequestError, match="image_only, simple_fusion, cross_attention"):
        settings_class("gpt")
    with pytest.raises(RequestError, match="paper, cpu"):
        preset_settings("image_only", "huge")
    assert set(APPROACHES) == set(MODELS)
