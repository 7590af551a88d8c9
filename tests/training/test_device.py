"""Devices and precisions; seeds; signals; the clock of phases; the curves."""

from __future__ import annotations

import logging
import os
import signal
import weakref
from pathlib import Path

import pytest
import torch

from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.interrupt import StopRequest
from robo_manip_baselines.runs.metrics import write_curves
from robo_manip_baselines.runs.seeds import derive_seed
from robo_manip_baselines.training import device as device_module
from robo_manip_baselines.training import trainer
from robo_manip_baselines.training.config import TrainConfig
from robo_manip_baselines.training.device import (
    PHASES,
    Processes,
    StepTimer,
    autocast_type,
    choose_device,
    prepare_device,
)

CPU = torch.device("cpu")
CUDA = torch.device("cuda", 0)


@pytest.mark.parametrize(
    ("precision", "device", "has_images", "fast_cpu", "fast_gpu", "expected"),
    [
        ("fp32", CUDA, True, True, True, None),
        ("fp32", CPU, True, True, True, None),
        ("bf16", CPU, False, False, False, torch.bfloat16),
        ("bf16", CUDA, False, False, True, torch.bfloat16),
        ("auto", CUDA, False, False, True, torch.bfloat16),
        ("auto", CUDA, True, True, False, None),
        ("auto", CPU, True, True, False, torch.bfloat16),
        ("auto", CPU, True, False, False, None),
        ("auto", CPU, False, True, True, None),
    ],
)
def test_precisions(
    monkeypatch: pytest.MonkeyPatch,
    precision: str,
    device: torch.device,
    has_images: bool,
    fast_cpu: bool,
    fast_gpu: bool,
    expected: torch.dtype | None,
) -> None:
    monkeypatch.setattr(device_module, "_has_fast_bf16", lambda: fast_cpu)
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation: fast_gpu)
    assert autocast_type(precision, device, has_images) == expected


def test_a_gpu_without_bf16_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation: False)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: "Old GPU")
    with pytest.raises(RequestError, match="bf16: Old GPU has none"):
        autocast_type("bf16", CUDA)


@pytest.mark.parametrize(
    ("given", "gpus", "rank", "expected"),
    [
        ("auto", 0, 0, "cpu"),
        ("auto", 2, 1, "cuda:1"),
        ("cpu", 2, 1, "cpu"),
        ("cuda", 2, 0, "cuda:0"),
        ("cuda:1", 2, 0, "cuda:1"),
    ],
)
def test_devices(
    monkeypatch: pytest.MonkeyPatch, given: str, gpus: int, rank: int, expected: str
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpus > 0)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: gpus)
    assert choose_device(given, rank) == torch.device(expected)


@pytest.mark.parametrize(
    ("given", "gpus", "message"),
    [
        ("cuda", 0, "finds no CUDA device; use --device cpu"),
        ("cuda:2", 2, "'cuda:2': there are 2"),
        ("meta", 1, "must be auto, cpu, cuda or cuda:NUMBER"),
        ("gpu", 1, "must be auto, cpu, cuda or cuda:NUMBER"),
    ],
)
def test_devices_that_are_not_there(
    monkeypatch: pytest.MonkeyPatch, given: str, gpus: int, message: str
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpus > 0)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: gpus)
    with pytest.raises(RequestError, match=message):
        choose_device(given)


def test_compiling_on_a_cpu_needs_a_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    with pytest.raises(RequestError, match=r"needs a C\+\+ compiler"):
        prepare_device(CPU, compile_network=True)


def test_processes_come_from_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("RANK", "WORLD_SIZE", "LOCAL_RANK", "MASTER_ADDR"):
        monkeypatch.delenv(name, raising=False)
    assert Processes.from_environment() == Processes(0, 1, 0)
    monkeypatch.setenv("RANK", "3")
    with pytest.raises(RequestError, match=r"must be set together; start several .* torchrun"):
        Processes.from_environment()
    monkeypatch.setenv("WORLD_SIZE", "4")
    monkeypatch.setenv("LOCAL_RANK", "1")
    monkeypatch.setenv("MASTER_ADDR", "localhost")
    assert Processes.from_environment() == Processes(3, 4, 1)


def test_nothing_that_trained_is_left_when_the_processes_part(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """References to the group keep its threads, and the interpreter aborts at its end."""

    class Network:
        def __init__(self) -> None:
            self.itself = self  # a cycle, as DistributedDataParallel has them

    left: list[object] = []
    made: list[weakref.ref[Network]] = []

    def train(*_: object) -> int:
        network = Network()
        made.append(weakref.ref(network))
        return 0

    monkeypatch.setattr(torch.distributed, "init_process_group", lambda *_: None)
    monkeypatch.setattr(torch.distributed, "destroy_process_group", lambda: left.append(made[0]()))
    monkeypatch.setattr(trainer, "_train", train)
    monkeypatch.setattr(Processes, "from_environment", lambda: Processes(1, 2, 1))
    level = logging.getLogger().level
    try:
        assert trainer.train(TrainConfig.from_preset("Mlp", "cpu", device="cpu")) == 0
    finally:
        logging.getLogger().setLevel(level)
    assert left == [None]


def test_seeds_of_streams_differ_and_stay_as_they_are() -> None:
    seeds = {
        derive_seed(seed, stream, *numbers)
        for seed in (0, 1)
        for stream in ("weights", "dropout")
        for numbers in ((), (0,), (1,), (0, 1), (1, 0))
    }
    assert len(seeds) == 20
    assert all(0 <= seed < 2**63 for seed in seeds)
    # Of the first release: other numbers would make every run another one.
    assert derive_seed(0, "weights") == 3245395985266979118


def test_signals_are_noted_then_given_back(capfd: pytest.CaptureFixture[str]) -> None:
    before = signal.getsignal(signal.SIGTERM)
    with StopRequest() as stop:
        assert not stop.is_made
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop.is_made
        os.kill(os.getpid(), signal.SIGTERM)  # as a scheduler may repeat it
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
    assert signal.getsignal(signal.SIGTERM) is before
    assert capfd.readouterr().err.count("stopping: saving after this step") == 1


def test_torchrun_repeats_ctrl_c() -> None:
    with StopRequest(once_more=False) as stop:
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)
        assert stop.is_made


def test_phases_add_up(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr("time.perf_counter", lambda: now[0])
    timer = StepTimer(CPU)
    for factor in (1.0, 3.0):
        for phase, seconds in zip(PHASES, (1.0, 2.0, 4.0, 8.0), strict=True):
            now[0] += factor * seconds
            timer.mark(phase)
        now[0] += 100.0  # a validation
        timer.skip()
    assert timer.read() == {"data": 2.0, "forward": 4.0, "backward": 8.0, "optimizer": 16.0}
    assert timer.read() == dict.fromkeys(PHASES, 0.0)


@pytest.mark.long
def test_curves_are_drawn(tmp_path: Path) -> None:
    lines = [
        {"kind": kind, "step": step, "loss": 1.0 / step, "l1": 0.5 / step, "kl": 0.0}
        for step in (1, 2, 3)
        for kind in ("train", "validation")
    ]
    assert write_curves(tmp_path / "curves.png", lines, "title")
    picture = (tmp_path / "curves.png").read_bytes()
    assert picture.startswith(b"\x89PNG")
    for line in lines:  # of a network without a latent: nothing is drawn of what is 0
        del line["kl"]
    assert write_curves(tmp_path / "curves.png", lines, "title")
    assert (tmp_path / "curves.png").read_bytes() == picture
    assert not write_curves(tmp_path / "none.png", [], "title")
    assert not (tmp_path / "none.png").exists()
