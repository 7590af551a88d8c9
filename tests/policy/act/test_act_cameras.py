"""Small encoders of the cameras: what they depend on, and the network that observes them."""

from __future__ import annotations

import pytest
import torch

from robo_manip_baselines.policy.act.cameras import CameraEncoder
from robo_manip_baselines.policy.interface import PolicyDims
from robo_manip_baselines.runs.errors import RequestError

SMALL = {"vision": "small", "camera_features": 6}


def make_encoder(cameras: int = 2, image: tuple[int, int] = (48, 64)) -> CameraEncoder:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(3)
        return CameraEncoder(cameras, 6, image)


def draw_images(cameras: int, height: int, width: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(4)
    shape = (2, cameras, height, width, 3)
    return torch.randint(0, 256, shape, generator=generator, dtype=torch.uint8)


def test_each_camera_has_its_own_features():
    encoder, images = make_encoder(), draw_images(2, 48, 64)
    before = encoder(images)
    assert before.shape == (2, 2 * 6)
    assert before.dtype == torch.float32
    changed = images.clone()
    changed[:, 1] = 255 - changed[:, 1]
    after = encoder(changed)
    assert torch.equal(after[:, :6], before[:, :6])
    assert not torch.allclose(after[:, 6:], before[:, 6:], atol=1e-3)
    # The same view through another camera: other weights.
    assert not torch.allclose(encoder(images.flip(1))[:, :6], before[:, 6:], atol=1e-3)


def test_the_place_in_the_image_matters():
    encoder = make_encoder(1)
    images = torch.zeros(1, 1, 48, 64, 3, dtype=torch.uint8)
    images[0, 0, 16:24, 24:32] = 255
    one, other = encoder(images), encoder(images.roll(1, dims=3))
    assert not torch.allclose(one, other, atol=1e-3)  # a pixel, an eighth of a cell


@pytest.mark.parametrize("image", [(8, 8), (30, 41), (96, 128)])
def test_any_size_from_8_pixels_on(image: tuple[int, int]):
    assert make_encoder(1, image)(draw_images(1, *image)).isfinite().all()


def test_smaller_images_are_refused():
    with pytest.raises(RequestError, match="image_size 7x64: vision small needs 8x8"):
        make_encoder(1, (7, 64))


def test_the_network_observes_every_camera(make_model, make_batch):
    model, batch = make_model(**SMALL), make_batch()
    assert model.vision is None
    before = model.predict(batch.state, batch.images, None)
    for camera in range(2):
        images = batch.images.clone()
        images[:, :, camera] = 255 - images[:, :, camera]
        assert not torch.allclose(model.predict(batch.state, images, None), before, atol=1e-4)
    with pytest.raises(ValueError, match=r"images of \(2, 40, 70, 3\) are needed"):
        model.predict(batch.state, None, None)


def test_its_convolutions_have_their_own_learning_rate(make_model):
    groups = make_model(**SMALL, backbone_learning_rate_factor=0.1).parameter_groups(1.0)
    assert [group["lr"] for group in groups] == [1.0, 0.1]
    frozen = make_model(**SMALL, backbone_learning_rate_factor=0.0)
    assert len(frozen.parameter_groups(1.0)) == 1


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_the_form_for_inference_predicts_the_same(make_model, make_batch, dtype: torch.dtype):
    model, batch = make_model(**SMALL).eval(), make_batch()
    expected = model.predict(batch.state, batch.images, None)
    found = model.for_inference(dtype).predict(batch.state, batch.images, None)
    tolerance = 1e-5 if dtype == torch.float32 else 0.1  # bf16 has 8 bits
    torch.testing.assert_close(found, expected, rtol=tolerance, atol=tolerance)


def test_without_cameras_it_makes_no_difference(make_model, make_batch):
    dims = PolicyDims(state=5, action=3, cameras=0, image=(40, 70))
    batch = make_batch(dims)
    plain, small = make_model(dims), make_model(dims, **SMALL)
    assert torch.equal(small.loss(batch)["loss"], plain.loss(batch)["loss"])
    with pytest.raises(RequestError, match="backbone_weights"):
        make_model(**SMALL, backbone_weights="resnet18.safetensors")
