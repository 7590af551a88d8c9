"""Work recorded on a CUDA device and replayed."""

from __future__ import annotations

import pytest
import torch

from robo_manip_baselines.policy.cuda_graph import WARM_UP, Replay

pytestmark = pytest.mark.cuda


def test_every_call_does_the_work_once() -> None:
    device = torch.device("cuda", 0)
    total, given = torch.zeros(3, device=device), torch.zeros(3, device=device)
    computed = []

    def compute() -> torch.Tensor:
        computed.append(True)
        total.add_(given)
        return total * 2

    replay = Replay(compute, device)
    expected = 0.0
    for call in range(WARM_UP + 4):
        given.fill_(call)
        expected += call
        assert replay().tolist() == [2 * expected] * 3
        assert replay.is_recorded == (call >= WARM_UP)
    assert total.tolist() == [expected] * 3
    assert len(computed) == WARM_UP + 1


def test_random_numbers_follow_the_seed_of_each_call() -> None:
    device = torch.device("cuda", 0)
    draw = Replay(lambda: torch.randn(100, device=device), device)
    for seed in range(WARM_UP + 3):
        torch.manual_seed(seed)
        drawn = draw().cpu()
        torch.manual_seed(seed)
        assert torch.equal(drawn, torch.randn(100, device=device).cpu())


def test_work_that_waits_for_the_device_is_computed(caplog: pytest.LogCaptureFixture) -> None:
    device = torch.device("cuda", 0)
    value = torch.zeros((), device=device)

    def compute() -> float:
        value.add_(1)
        return float(value)

    replay = Replay(compute, device)
    counts = [replay() for _ in range(WARM_UP + 3)]
    assert counts == list(range(1, WARM_UP + 4))
    assert not replay.is_recorded
    assert caplog.text.count("cannot be recorded as a CUDA graph") == 1
