"""Keypoints in the images: what they depend on, and the network that observes them."""

from __future__ import annotations

import pytest
import torch

from robo_manip_baselines.policy.act.keypoints import KeypointEncoder, keypoints
from robo_manip_baselines.policy.interface import PolicyDims
from robo_manip_baselines.runs.errors import RequestError

KEYPOINTS = {"vision": "keypoints", "keypoints": 8}


def make_encoder(cameras: int = 2, image: tuple[int, int] = (48, 64)) -> KeypointEncoder:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(3)
        return KeypointEncoder(cameras, 8, image)


def draw_images(cameras: int, height: int, width: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(4)
    shape = (2, cameras, height, width, 3)
    return torch.randint(0, 256, shape, generator=generator, dtype=torch.uint8)


def test_a_keypoint_is_the_mean_place_of_its_map():
    maps = torch.zeros(1, 2, 5, 9)
    maps[0, 0, 4, 0] = 100.0  # one corner
    maps[0, 1, 2, 2], maps[0, 1, 2, 6] = 100.0, 100.0  # between two cells
    torch.testing.assert_close(keypoints(maps), torch.tensor([[-1.0, 0.0, 1.0, 0.0]]))


def test_maps_move_with_the_image_a_cell_for_eight_pixels():
    network = next(make_encoder(1).cameras.children())
    image = torch.zeros(1, 3, 64, 80)
    image[..., 24:32, 32:40] = 1.0
    maps, moved = network(image), network(image.roll((8, 16), dims=(2, 3)))
    # Without the cells that see the border.
    torch.testing.assert_close(
        maps.roll((1, 2), dims=(2, 3))[..., 2:-2, 3:-2], moved[..., 2:-2, 3:-2]
    )


def test_each_camera_has_its_own_points():
    encoder, images = make_encoder(), draw_images(2, 48, 64)
    before = encoder(images)
    assert before.shape == (2, 2 * 2 * 8)
    assert before.dtype == torch.float32
    assert before.abs().max() <= 1.0
    changed = images.clone()
    changed[:, 1] = 255 - changed[:, 1]
    after = encoder(changed)
    assert torch.equal(after[:, :16], before[:, :16])
    assert not torch.allclose(after[:, 16:], before[:, 16:])
    # The same view through another camera: other convolutions.
    assert not torch.allclose(encoder(images.flip(1))[:, :16], before[:, 16:])


@pytest.mark.parametrize("image", [(8, 8), (30, 41), (96, 128)])
def test_any_size_from_8_pixels_on(image: tuple[int, int]):
    assert make_encoder(1, image)(draw_images(1, *image)).isfinite().all()


def test_smaller_images_are_refused():
    with pytest.raises(RequestError, match="image_size 7x64: vision keypoints needs 8x8"):
        make_encoder(1, (7, 64))


def test_the_network_observes_every_camera(make_model, make_batch):
    model, batch = make_model(**KEYPOINTS), make_batch()
    assert model.vision is None
    before = model.predict(batch.state, batch.images, None)
    for camera in range(2):
        images = batch.images.clone()
        images[:, :, camera] = 255 - images[:, :, camera]
        assert not torch.allclose(model.predict(batch.state, images, None), before)
    with pytest.raises(ValueError, match=r"images of \(2, 40, 70, 3\) are needed"):
        model.predict(batch.state, None, None)


def test_its_convolutions_have_their_own_learning_rate(make_model):
    groups = make_model(**KEYPOINTS, backbone_learning_rate_factor=0.1).parameter_groups(1.0)
    assert [group["lr"] for group in groups] == [1.0, 0.1]
    frozen = make_model(**KEYPOINTS, backbone_learning_rate_factor=0.0)
    assert len(frozen.parameter_groups(1.0)) == 1


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_the_form_for_inference_predicts_the_same(make_model, make_batch, dtype: torch.dtype):
    model, batch = make_model(**KEYPOINTS).eval(), make_batch()
    expected = model.predict(batch.state, batch.images, None)
    found = model.for_inference(dtype).predict(batch.state, batch.images, None)
    tolerance = 1e-5 if dtype == torch.float32 else 0.1  # bf16 has 8 bits
    torch.testing.assert_close(found, expected, rtol=tolerance, atol=tolerance)


def test_without_cameras_it_makes_no_difference(make_model, make_batch):
    dims = PolicyDims(state=5, action=3, cameras=0, image=(40, 70))
    batch = make_batch(dims)
    plain, keyed = make_model(dims), make_model(dims, **KEYPOINTS)
    assert torch.equal(keyed.loss(batch)["loss"], plain.loss(batch)["loss"])
    with pytest.raises(RequestError, match="backbone_weights"):
        make_model(**KEYPOINTS, backbone_weights="resnet18.safetensors")
