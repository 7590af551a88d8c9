"""The whole network: what it counts, what it sees, and what may not change its losses.

Legend: B batch, K actions of a chunk, A elements of an action.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch.utils._python_dispatch import TorchDispatchMode

from robo_manip_baselines.policy.act.config import ActConfig
from robo_manip_baselines.policy.act.model import ActModel
from robo_manip_baselines.policy.act.resnet import ResNet18
from robo_manip_baselines.policy.interface import Batch, PolicyDims
from robo_manip_baselines.runs.errors import RequestError

BLIND = PolicyDims(state=5, action=3, cameras=0, image=(40, 70))


@pytest.mark.parametrize(
    ("dims", "settings", "total", "trained"),
    [
        (PolicyDims(14, 7, 3, (480, 640)), {}, 83_916_935, 83_916_935),
        (PolicyDims(29, 7, 3, (480, 640)), {}, 83_932_295, 83_932_295),
        (PolicyDims(14, 7, 0, (480, 640)), {}, 72_485_831, 72_485_831),
        (PolicyDims(29, 7, 0, (480, 640)), {}, 72_501_191, 72_501_191),
        # Public ACT, two arms of 7 joints: 83,923,087 with an output that it never uses (513).
        (PolicyDims(14, 14, 3, (480, 640)), {"paper_compat": True}, 83_922_574, 51_613_582),
        (PolicyDims(14, 7, 3, (480, 640)), {"paper_compat": True}, 83_915_399, 51_606_407),
        (PolicyDims(29, 7, 3, (480, 640)), {"paper_compat": True}, 83_930_759, 51_621_767),
        (PolicyDims(14, 7, 3, (480, 640)), {"use_cvae": False}, 66_539_079, 66_539_079),
        (
            PolicyDims(14, 7, 3, (480, 640)),
            {"backbone_width": 16},
            # 11,166,912 weights of a ResNet-18 become 699,696, and 384 features of it less are
            # projected to 512.
            83_916_935 - 11_166_912 + 699_696 - 384 * 512,
            83_916_935 - 11_166_912 + 699_696 - 384 * 512,
        ),
        # 90 queries of 512 less, and 9 × 7 more outputs of 512 + 1 weights.
        (PolicyDims(14, 7, 3, (480, 640)), {"actions_per_query": 10}, 83_903_174, 83_903_174),
    ],
)
def test_how_many_parameters_there_are(
    dims: PolicyDims, settings: dict[str, Any], total: int, trained: int
):
    # The totals of docs/act.md.
    with torch.device("meta"):  # counted without numbers
        model = ActModel(ActConfig(**settings), dims)
    assert sum(p.numel() for p in model.parameters()) == total
    assert sum(p.numel() for p in model.parameters() if p.requires_grad) == trained


def numpy_losses(model: ActModel, batch: Batch, compat: bool) -> tuple[float, float]:
    """The two parts of the loss, from their definitions."""
    assert model.cvae is not None
    mean, log_variance = model.cvae(batch.state[:, -1], batch.action, batch.is_pad)
    latent = mean + torch.exp(log_variance / 2) * batch.noise
    found = model._actions(batch.state, batch.images, latent).detach().numpy().astype(float)
    error = np.abs(found - batch.action.numpy())
    valid = ~batch.is_pad.numpy()
    l1 = error[valid].sum() / error.size if compat else error[valid].mean()
    posterior = torch.distributions.Normal(mean, (0.5 * log_variance).exp())
    kl = torch.distributions.kl_divergence(posterior, torch.distributions.Normal(0.0, 1.0))
    return float(l1), kl.sum(1).mean().item()


@pytest.mark.parametrize("compat", [False, True])
def test_the_loss_is_its_definition(make_model, make_batch, compat: bool):
    model, batch = make_model(paper_compat=compat), make_batch()
    losses = {name: value.item() for name, value in model.loss(batch).items()}
    l1, kl = numpy_losses(model, batch, compat)
    assert losses["l1"] == pytest.approx(l1, rel=1e-5)  # fp32
    assert losses["kl"] == pytest.approx(kl, rel=1e-5)
    assert losses["loss"] == pytest.approx(l1 + 10.0 * kl, rel=1e-5)


@pytest.mark.parametrize("compat", [False, True])
def test_processes_that_share_a_batch_average_to_the_whole(make_model, make_batch, compat: bool):
    model, batch = make_model(BLIND, paper_compat=compat), make_batch(BLIND)
    whole = gradients(model, batch)
    shares = []
    for examples in (slice(0, 1), slice(1, 3)):
        tensors = ("state", "action", "is_pad", "noise")
        share = replace(batch, **{name: getattr(batch, name)[examples] for name in tensors})
        counts = {"num_valid": batch.num_valid / 2, "num_examples": batch.num_examples / 2}
        shares.append(gradients(model, replace(share, **counts)))
    for name, gradient in whole.items():
        mean = (shares[0][name] + shares[1][name]) / 2
        torch.testing.assert_close(mean, gradient, rtol=1e-4, atol=1e-5)


def gradients(model: ActModel, batch: Batch) -> dict[str, torch.Tensor]:
    model.zero_grad()
    model.loss(batch)["loss"].backward()
    return {name: p.grad.clone() for name, p in model.named_parameters() if p.grad is not None}


@pytest.mark.parametrize("compat", [False, True])
@pytest.mark.parametrize("filler", [1e6, float("inf"), float("nan")])
def test_padded_actions_change_nothing(make_model, make_batch, compat: bool, filler: float):
    model, batch = make_model(BLIND, paper_compat=compat), make_batch(BLIND)
    other = replace(batch, action=batch.action.masked_fill(batch.is_pad[..., None], filler))
    expected, found = gradients(model, batch), gradients(model, other)
    assert all(torch.equal(found[name], expected[name]) for name in expected)
    assert torch.equal(model.loss(batch)["loss"], model.loss(other)["loss"])


def test_every_valid_action_changes_the_loss(make_model, make_batch):
    model, batch = make_model(BLIND), make_batch(BLIND)
    for b, k in torch.nonzero(~batch.is_pad).tolist():
        action = batch.action.clone()
        action[b, k] += 0.5
        assert not torch.equal(
            model.loss(replace(batch, action=action))["l1"], model.loss(batch)["l1"]
        )


@pytest.mark.parametrize(
    "settings", [{}, {"paper_compat": True}, {"use_cvae": False}, {"pre_norm": True}]
)
@pytest.mark.parametrize("cameras", [0, 2])
def test_what_is_trained_has_a_gradient_and_the_rest_has_none(
    make_model, make_batch, settings: dict[str, Any], cameras: int
):
    dims = PolicyDims(5, 3, cameras, (40, 70))
    model = make_model(dims, **settings)
    found = gradients(model, make_batch(dims, latent=model.noise_size))
    assert found.keys() == {n for n, p in model.named_parameters() if p.requires_grad}
    assert all(torch.isfinite(gradient).all() for gradient in found.values())


def test_noise_is_what_the_network_asks_for(make_model, make_batch):
    model, batch = make_model(BLIND), make_batch(BLIND)
    assert model.noise_size == 4
    other = replace(batch, noise=batch.noise + 1.0)
    assert not torch.equal(model.loss(batch)["l1"], model.loss(other)["l1"])
    assert torch.equal(model.loss(batch)["kl"], model.loss(other)["kl"])
    plain = make_model(BLIND, use_cvae=False)
    assert plain.noise_size == 0
    losses = plain.loss(make_batch(BLIND, latent=0))
    assert losses["kl"].item() == 0.0
    assert torch.equal(losses["loss"], losses["l1"])


def test_the_prediction_is_that_of_the_latent_0(make_model, make_batch):
    model, batch = make_model(), make_batch()
    expected = model._actions(batch.state, batch.images, torch.zeros(3, 4))
    assert torch.equal(model.predict(batch.state, batch.images, None), expected)
    other = model._actions(batch.state, batch.images, torch.ones(3, 4))
    assert not torch.allclose(other, expected)


def test_the_paper_compatible_actions_are_those_of_the_first_layer(make_model, make_batch):
    model, batch = make_model(paper_compat=True), make_batch()
    assert len(model.decoder.layers) == 3
    found = {}
    model.encoder.register_forward_hook(lambda _m, given, result: found.update(e=(given, result)))
    actions = model.predict(batch.state, batch.images, None)
    (_, places), memory = found["e"]
    first = model.decoder.layers[0](torch.zeros(3, 6, 16), model.queries, memory, memory + places)
    assert torch.equal(actions, model.action_head(model.decoder.norm(first)))


def test_by_default_every_layer_matters(make_model, make_batch):
    model, batch = make_model(BLIND), make_batch(BLIND)
    before = model.predict(batch.state, None, None)
    for layer in model.decoder.layers:
        layer.feed_forward.narrow.weight.data *= -1.0
        after = model.predict(batch.state, None, None)
        assert not torch.allclose(after, before)
        before = after


@pytest.mark.parametrize(("per_query", "queries"), [(1, 6), (3, 2), (4, 2), (6, 1), (7, 1)])
def test_a_query_gives_successive_actions(make_model, make_batch, per_query: int, queries: int):
    model = make_model(actions_per_query=per_query)
    assert model.queries.shape == (queries, 16)
    numbers = torch.arange(3.0 * per_query)
    with torch.no_grad():
        model.action_head.weight.zero_()
        model.action_head.bias.copy_(numbers)
    actions = model.eval().predict(make_batch().state, make_batch().images, None)
    expected = numbers.view(per_query, 3).repeat(queries, 1)  # the same for all queries
    assert torch.equal(actions[0], expected[:6])


def test_cameras_are_told_apart(make_model, make_batch):
    batch = make_batch()
    swapped = batch.images.flip(2)
    model = make_model()
    assert not torch.allclose(
        model.predict(batch.state, batch.images, None),
        model.predict(batch.state, swapped, None),
        atol=1e-4,
    )
    # In the public code they are not: to attention, tokens are a set.
    compat = make_model(paper_compat=True)
    torch.testing.assert_close(
        compat.predict(batch.state, batch.images, None),
        compat.predict(batch.state, swapped, None),
        atol=1e-5,
        rtol=1e-5,
    )


def test_the_place_in_the_image_matters(make_model, make_batch):
    batch = make_batch()
    model = make_model(paper_compat=True)
    assert not torch.allclose(
        model.predict(batch.state, batch.images, None),
        model.predict(batch.state, batch.images.flip(4), None),
        atol=1e-4,
    )


@pytest.mark.parametrize("cameras", [0, 2])
def test_examples_are_independent(make_model, make_batch, cameras: int):
    dims = PolicyDims(5, 3, cameras, (40, 70))
    model, batch = make_model(dims).eval(), make_batch(dims)
    together = model.predict(batch.state, batch.images, None)
    for b in range(3):
        images = None if batch.images is None else batch.images[b : b + 1]
        alone = model.predict(batch.state[b : b + 1], images, None)
        # Other dims of matrices are summed in another order.
        torch.testing.assert_close(alone[0], together[b], atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("image", [(30, 40), (33, 31), (1, 1), (64, 20)])
@pytest.mark.parametrize("cameras", [1, 3])
def test_any_image_size_and_number_of_cameras(
    make_model, make_batch, image: tuple[int, int], cameras: int
):
    dims = PolicyDims(5, 3, cameras, image)
    model, batch = make_model(dims), make_batch(dims)
    assert model.predict(batch.state, batch.images, None).shape == (3, 6, 3)
    assert torch.isfinite(model.loss(batch)["loss"])


@pytest.mark.parametrize(
    "given", [None, (3, 1, 2, 70, 40, 3), (3, 1, 1, 40, 70, 3), (3, 1, 2, 3, 40, 70)]
)
def test_images_of_another_shape_are_refused(make_model, make_batch, given):
    images = None if given is None else torch.zeros(given, dtype=torch.uint8)
    with pytest.raises(ValueError, match=r"images of \(2, 40, 70, 3\) are needed"):
        make_model().predict(make_batch().state, images, None)


class Recorder(TorchDispatchMode):
    """Notes which operations are carried out."""

    def __init__(self) -> None:
        super().__init__()
        self.names: set[str] = set()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.names.add(func._schema.name)
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize(
    "settings", [{"dropout": 0.1}, {"paper_compat": True}, {"vision": "small"}]
)
@pytest.mark.parametrize("cameras", [0, 2])
def test_a_step_waits_for_no_number(make_model, make_batch, cameras: int, settings: dict[str, Any]):
    # On a GPU each of these would halt the queue until what came before is done.
    waiting = {"_local_scalar_dense", "nonzero", "masked_select", "equal", "unique", "is_nonzero"}
    dims = PolicyDims(5, 3, cameras, (40, 70))
    model, batch = make_model(dims, **settings), make_batch(dims)
    with Recorder() as found:
        model.loss(batch)["loss"].backward()
        model.predict(batch.state, batch.images, None)
    assert "aten::addmm" in found.names  # it does record
    assert not found.names & {f"aten::{name}" for name in waiting}
    with Recorder() as found:
        batch.state[0, 0, 0].item()
    assert found.names & {f"aten::{name}" for name in waiting}


@pytest.mark.parametrize(("factor", "groups"), [(1.0, 2), (0.1, 2), (0.0, 1)])
def test_the_backbone_has_its_own_learning_rate(make_model, factor: float, groups: int):
    model = make_model(backbone_learning_rate_factor=factor)
    found = model.parameter_groups(1e-4)
    assert [group["lr"] for group in found] == [1e-4, 1e-4 * factor][:groups]
    members = [parameter for group in found for parameter in group["params"]]
    assert {id(p) for p in members} == {id(p) for p in model.parameters() if p.requires_grad}
    assert len(members) == len({id(p) for p in members})
    if groups == 2:
        assert {id(p) for p in found[1]["params"]} == {
            id(p) for p in model.vision.backbone.parameters()
        }


def test_without_cameras_there_is_one_group(make_model):
    assert len(make_model(BLIND).parameter_groups(1e-4)) == 1


def test_what_is_saved_builds_the_same_network(make_model, make_batch):
    model, batch = make_model(), make_batch()
    other = make_model()
    for parameter in other.parameters():
        parameter.data.zero_()
    other.load_state_dict(model.state_dict())
    assert torch.equal(other.loss(batch)["loss"], model.loss(batch)["loss"])
    # Saved as they are: the safetensors format takes contiguous tensors only.
    assert all(value.is_contiguous() for value in model.state_dict().values())


@pytest.mark.long
def test_it_starts_from_given_weights(make_model, tmp_path):
    path = tmp_path / "resnet18.safetensors"
    state = ResNet18(8).state_dict()
    save_file(state, path)
    model = make_model(backbone_weights=str(path))
    loaded = model.vision.backbone.state_dict()
    assert all(torch.equal(loaded[name], value) for name, value in state.items())
    with pytest.raises(RequestError, match="without cameras"):
        make_model(BLIND, backbone_weights=str(path))


@pytest.mark.parametrize("settings", [{}, {"pre_norm": True}, {"paper_compat": True}])
def test_what_is_the_same_for_all_examples_is_trained_as_if_it_were_not(
    make_model, make_batch, settings: dict[str, Any]
):
    """The decoder's first self-attention sees no observation: one example stands for all."""
    batch, gradients, losses = make_batch(), [], []
    for dropout in (0.0, 0.5):
        model = make_model(**settings).train()
        model.decoder.dropout = dropout  # as if something were dropped, so that every row counts
        loss = model.loss(batch)["loss"]
        loss.backward()
        losses.append(loss.detach())
        gradients.append({name: p.grad for name, p in model.named_parameters() if p.requires_grad})
    torch.testing.assert_close(*losses)
    for name, gradient in gradients[0].items():
        assert gradient is not None
        scale = gradient.abs().max().item()
        # Rounding adds up over 16 channels and 18 tokens; some gradients are nothing but rounding.
        torch.testing.assert_close(
            gradient, gradients[1][name], rtol=1e-4, atol=1e-5 * scale + 1e-7, msg=name
        )


@pytest.mark.long
def test_it_compiles_in_one_piece(make_model, make_batch):
    model, batch = make_model(), make_batch()
    compiled = torch.compile(model.loss, fullgraph=True, backend="eager")
    losses = compiled(batch)
    losses["loss"].backward()
    torch.testing.assert_close(losses, model.loss(batch), rtol=1e-4, atol=1e-5)


@pytest.mark.long
def test_it_learns_one_batch_by_heart(make_model, make_batch):
    model, batch = make_model(BLIND), make_batch(BLIND)
    optimizer = torch.optim.AdamW(model.parameter_groups(3e-3))
    before = model.loss(batch)["l1"].item()
    for _ in range(60):
        optimizer.zero_grad()
        model.loss(batch)["loss"].backward()
        optimizer.step()
    assert model.loss(batch)["l1"].item() < 0.3 * before
