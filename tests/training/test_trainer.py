"""Training that was stopped and resumed is the training that was not."""

from __future__ import annotations

import itertools
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from robo_manip_baselines.policy.act import resnet as backbone
from robo_manip_baselines.policy.checkpoint import load_model, read_checkpoint
from robo_manip_baselines.runs.checkpoints import list_checkpoints
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.metrics import MetricsLog, read_metrics
from robo_manip_baselines.training.device import Processes
from robo_manip_baselines.training.options import parse_options
from robo_manip_baselines.training.run_folder import METRICS
from robo_manip_baselines.training.setup import Job
from robo_manip_baselines.training.trainer import Outcome, Parts, Trainer, assembled

pytestmark = pytest.mark.long

CPU = torch.device("cpu")
STEPS = 10

MLP = "Mlp --preset cpu --chunk_size 3 --hidden_size 8 --dropout 0.2 --batch_size 4"
PLAIN = f"{MLP} --validation_fraction 0.2 --warmup_steps 0 --ema_decay 0"
ACT = (
    "Act --preset cpu --chunk_size 3 --hidden_size 8 --feedforward_size 8 --num_heads 2 "
    "--encoder_layers 1 --decoder_layers 1 --cvae_layers 1 --batch_size 4 "
    "--validation_fraction 0.2"
)
RUNS = {
    "average, cosine, warm-up, clipped": (
        f"{MLP} --validation_fraction 0.2 --ema_decay 0.9 --schedule cosine --warmup_steps 3 "
        "--clip_norm 0.5"
    ),
    "constant, by episode": f"{PLAIN} --schedule constant --sampler episode --learning_rate 0.01",
    "latent noise": f"{ACT} --dropout 0.1 --ema_decay 0.5",
    "images": (
        f"{ACT} --cameras angle top --image_size 24x32 --dropout 0.1 --batch_size 2 "
        "--precision fp32"
    ),
    "nothing held out": f"{MLP} --validation_fraction 0",
}


@pytest.fixture(autouse=True)
def narrow_backbone(monkeypatch: pytest.MonkeyPatch) -> None:
    """A ResNet-18 of a thousandth of the size."""
    monkeypatch.setattr(backbone, "WIDTHS", (8, 8, 8, 8))


def run(line: str, episodes: Path, out: Path, stop_at: int | None = None) -> Outcome:
    """Train in this process, from the newest checkpoint on, until after step ``stop_at``."""
    intervals = "--log_every 3 --validate_every 4 --checkpoint_every 100"
    args = f"{line.split()[0]} {intervals} --steps {STEPS} --dataset {episodes} --out {out} "
    args += line.partition(" ")[2]  # may override the intervals
    job = Job.of(parse_options(args.split(), has_gpu=False))
    start = read_checkpoint(out) if list_checkpoints(out) else None
    first = start.step if start else 0
    out.mkdir(parents=True, exist_ok=True)
    steps = itertools.count(first + 1)
    with (
        MetricsLog(out / METRICS, first, None) as log,
        assembled(job, start, CPU, Processes()) as parts,
    ):
        trainer = Trainer(
            job, parts, log=log, processes=Processes(), stop=lambda: next(steps) == stop_at
        )
        return trainer.train()


def contents(out: Path) -> dict[str, Any]:
    """Weights, trainer's state and metrics; without clock times."""
    _, folder = list_checkpoints(out)[-1]
    trainer = json.loads((folder / "trainer.json").read_text())
    trainer.pop("seconds")
    lines = [
        {name: value for name, value in line.items() if not name.startswith("seconds")}
        for line in read_metrics(out / METRICS)
    ]
    return {
        "model": (folder / "model.safetensors").read_bytes(),
        "trainer": (folder / "trainer.safetensors").read_bytes(),
        "json": trainer,
        "metrics": lines,
        "hash": read_checkpoint(out).content_hash,
    }


@pytest.mark.parametrize("name", RUNS)
def test_resuming_is_exact(name: str, episodes: Path, tmp_path: Path) -> None:
    run(RUNS[name], episodes, tmp_path / "whole")
    # 4: in the middle of a window of metrics and after a validation; 9: at the end of a window
    for stop_at in (4, 9):
        outcome = run(RUNS[name], episodes, tmp_path / "parts", stop_at=stop_at)
        assert outcome.step == stop_at
    assert run(RUNS[name], episodes, tmp_path / "parts").step == STEPS
    assert contents(tmp_path / "parts") == contents(tmp_path / "whole")


def test_the_seed_decides_everything(episodes: Path, tmp_path: Path) -> None:
    line = RUNS["latent noise"]
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        torch.rand(3)  # the state of the global generator is nobody's business
        run(f"{line} --seed {seed}", episodes, tmp_path / name)
    assert contents(tmp_path / "a") == contents(tmp_path / "b")
    assert contents(tmp_path / "a")["model"] != contents(tmp_path / "c")["model"]


def test_saving_and_validating_change_nothing(episodes: Path, tmp_path: Path) -> None:
    line = RUNS["latent noise"]
    run(line, episodes, tmp_path / "seldom")
    often = f"{line} --log_every 1 --validate_every 1 --checkpoint_every 3"
    run(often, episodes, tmp_path / "often")
    weights = [list_checkpoints(tmp_path / name)[-1][1] for name in ("seldom", "often")]
    first, second = ((folder / "model.safetensors").read_bytes() for folder in weights)
    assert first == second
    # the two newest are kept
    assert [step for step, _ in list_checkpoints(tmp_path / "often")] == [9, STEPS]


def test_metrics_are_means_of_the_steps(episodes: Path, tmp_path: Path) -> None:
    line = PLAIN.replace("--dropout 0.2", "--dropout 0")
    run(line, episodes, tmp_path)
    written = [x for x in read_metrics(tmp_path / METRICS) if x["kind"] == "train"]
    assert [x["step"] for x in written] == [3, 6, 9, 10]

    # The same training with one plain loop.
    args = f"{line} --steps {STEPS} --dataset {episodes} --out {tmp_path / 'loop'}"
    job = Job.of(parse_options(args.split(), has_gpu=False))
    with assembled(job, None, CPU, Processes()) as parts:
        model, settings = parts.train_step.model, job.options.training
        optimizer = torch.optim.AdamW(
            model.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay
        )
        losses = []
        for step in range(STEPS):
            factor = 0.5 * (1 + math.cos(math.pi * step / STEPS))
            optimizer.param_groups[0]["lr"] = settings.learning_rate * factor
            optimizer.zero_grad()
            loss = model.loss(parts.loader.batch(step))["loss"]
            loss.backward()
            optimizer.step()
            losses.append(loss.item())
    expected = [np.mean(losses[a:b]) for a, b in ((0, 3), (3, 6), (6, 9), (9, 10))]
    # fused and plain AdamW round differently, and metrics keep seven digits
    assert [x["loss"] for x in written] == pytest.approx(expected, rel=1e-5)
    assert [x["learning_rate"] for x in written][-1] == pytest.approx(
        settings.learning_rate * 0.5 * (1 + math.cos(math.pi * 9 / STEPS))
    )


def test_the_average_is_what_is_saved_and_validated(episodes: Path, tmp_path: Path) -> None:
    run(RUNS["average, cosine, warm-up, clipped"], episodes, tmp_path)
    checkpoint = read_checkpoint(tmp_path)
    tensors = load_file(checkpoint.folder / "trainer.safetensors")
    model = load_model(checkpoint)
    name, weight = next(iter(model.named_parameters()))
    assert not torch.equal(weight, tensors[f"weights/{name}"])
    args = f"{RUNS['average, cosine, warm-up, clipped']} --steps {STEPS} --dataset {episodes}"
    job = Job.of(parse_options(args.split(), has_gpu=False))
    with assembled(job, None, CPU, Processes()) as parts:
        assert parts.validation is not None
        losses = parts.validation(model)
        assert losses == parts.validation(model)  # the same draws every time
    last = [x for x in read_metrics(tmp_path / METRICS) if x["kind"] == "validation"][-1]
    assert last["loss"] == pytest.approx(losses["loss"], rel=1e-6)  # seven digits are written


def test_every_step_enters_the_average(episodes: Path, tmp_path: Path) -> None:
    args = f"{MLP} --ema_decay 0.3 --steps 8 --dataset {episodes} --out {tmp_path}"
    job = Job.of(parse_options(args.split(), has_gpu=False))
    with assembled(job, None, CPU, Processes()) as parts:
        train_step = parts.train_step
        expected = [p.detach().double() for p in train_step.model.parameters()]
        for step in range(8):
            train_step(parts.loader.batch(step), step)
            decay = min(0.3, (1 + step) / (10 + step))
            expected = [
                decay * mean + (1 - decay) * now.detach().double()
                for mean, now in zip(expected, train_step.model.parameters(), strict=True)
            ]
        for mean, value in zip(expected, train_step.result.parameters(), strict=True):
            # eight float32 roundings of weights below 1
            np.testing.assert_allclose(value.double(), mean, rtol=1e-5, atol=1e-7)


def test_validation_is_without_dropout(episodes: Path, tmp_path: Path) -> None:
    args = f"{PLAIN} --steps 1 --dataset {episodes} --out {tmp_path}"
    job = Job.of(parse_options(args.split(), has_gpu=False))
    with assembled(job, None, CPU, Processes()) as parts:
        assert parts.validation is not None
        model = parts.train_step.model.train()
        losses = parts.validation(model)
        assert model.training
        assert parts.validation(model.eval()) == losses


def test_every_step_drops_other_units(episodes: Path, tmp_path: Path) -> None:
    args = f"{MLP} --learning_rate 1e-20 --steps 5 --dataset {episodes} --out {tmp_path}"
    job = Job.of(parse_options(args.split(), has_gpu=False))
    with assembled(job, None, CPU, Processes()) as parts:
        batch = parts.loader.batch(0)
        losses = [parts.train_step(batch, step)["loss"].item() for step in (0, 1, 2, 0)]
    assert len(set(losses)) == 3
    assert losses[0] == losses[3]


def test_a_loss_that_is_not_finite_stops_in_one_line(episodes: Path, tmp_path: Path) -> None:
    with pytest.raises(RequestError, match=r"not finite any more at step 3; lower --learning_rate"):
        run(f"{MLP} --learning_rate 1e30", episodes, tmp_path)
    assert list_checkpoints(tmp_path) == []


def test_weights_that_are_not_finite_are_not_saved(episodes: Path, tmp_path: Path) -> None:
    """Interrupted long before the next line of metrics."""
    with pytest.raises(RequestError, match="not finite any more at step 3"):
        run(f"{MLP} --learning_rate 1e30 --log_every 100", episodes, tmp_path, stop_at=3)
    assert list_checkpoints(tmp_path) == []


def test_initial_weights_may_be_gone_when_resuming(
    episodes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[Any] = []
    real = Job.make_model

    def spy(self: Job, is_start: bool) -> Any:
        made.append(is_start)
        return real(self, is_start)

    monkeypatch.setattr(Job, "make_model", spy)
    run(RUNS["latent noise"], episodes, tmp_path, stop_at=2)
    run(RUNS["latent noise"], episodes, tmp_path)
    assert made == [True, False]


def test_gradients_have_the_layout_of_their_weights(episodes: Path, tmp_path: Path) -> None:
    """Fused AdamW reads weight, gradient and moments as flat memory."""
    args = f"{RUNS['images']} --steps {STEPS} --dataset {episodes} --out {tmp_path}"
    job = Job.of(parse_options(args.split(), has_gpu=False))
    with assembled(job, None, CPU, Processes()) as parts:
        check_layouts(parts)


def check_layouts(parts: Parts) -> None:
    step, seen = parts.train_step, 0
    step.model.loss(parts.loader.batch(0))["loss"].backward()
    for parameter in step.model.parameters():
        if parameter.grad is not None:
            assert parameter.grad.stride() == parameter.stride()
            seen += parameter.ndim == 4 and not parameter.is_contiguous()
    step.optimizer.step()
    for parameter, state in step.optimizer.state.items():
        assert state["exp_avg"].stride() == parameter.stride()
    assert seen, "no convolution has its weights in channels_last"
