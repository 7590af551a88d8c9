"""Training that was stopped and resumed is the training that was not."""

from __future__ import annotations

import itertools
import json
import math
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor

from robo_manip_baselines.commands.train import parse_config
from robo_manip_baselines.policy.checkpoint import load_model, read_checkpoint
from robo_manip_baselines.policy.interface import Batch
from robo_manip_baselines.policy.mlp.model import MlpModel
from robo_manip_baselines.runs.checkpoints import BEST, list_checkpoints
from robo_manip_baselines.runs.command import EXIT_INTERRUPTED
from robo_manip_baselines.runs.errors import RequestError
from robo_manip_baselines.runs.metrics import read_metrics
from robo_manip_baselines.training import trainer as trainer_module
from robo_manip_baselines.training.config import CONFIG, METRICS, TrainConfig, read_config
from robo_manip_baselines.training.device import Processes
from robo_manip_baselines.training.images import ImageStore
from robo_manip_baselines.training.setup import TrainSetup
from robo_manip_baselines.training.trainer import HeldOutLoss, Trainer, train

pytestmark = pytest.mark.long

CPU = torch.device("cpu")
STEPS = 10

MLP = "Mlp --preset cpu --chunk_size 3 --hidden_size 8 --dropout 0.2 --batch_size 4"
PLAIN = f"{MLP} --validation_fraction 0.2 --warmup_steps 0 --ema_decay 0"
ACT = (
    "Act --preset cpu --chunk_size 3 --hidden_size 8 --feedforward_size 8 --num_heads 2 "
    "--encoder_layers 1 --decoder_layers 1 --use_cvae --cvae_layers 1 --batch_size 4 "
    "--validation_fraction 0.2 --backbone_width 8"
)
FLOW = (
    "Flow --preset cpu --chunk_size 4 --hidden_size 16 --num_layers 1 --batch_size 4 "
    "--validation_fraction 0.2"
)
RUNS = {
    "noise and fixed actions": f"{FLOW} --max_prefix 2 --ema_decay 0.9 --norm min_max",
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
    "changed images": (
        f"{ACT} --cameras angle top --image_size 24x32 --batch_size 2 --vision small "
        "--camera_features 4 --augment shift+colour --precision fp32"
    ),
    "nothing held out": f"{MLP} --validation_fraction 0",
}


def configure(line: str, episodes: Path, out: Path) -> TrainConfig[Any]:
    """Return the configuration of a short run."""
    intervals = "--log_every 3 --validate_every 4 --checkpoint_every 100 --logger none"
    args = f"{line.split()[0]} {intervals} --steps {STEPS} --dataset {episodes} --out {out} "
    args += line.partition(" ")[2]  # may override the intervals
    return parse_config(args.split(), has_gpu=False)


class StopAt:
    """A request to stop that is made after a step."""

    def __init__(self, step: int | None) -> None:
        self._before = -1 if step is None else step

    @property
    def is_made(self) -> bool:
        """Asked once after each step."""
        self._before -= 1
        return self._before == 0


def run(line: str, episodes: Path, out: Path, stop_at: int | None = None) -> int:
    """Train in this process, from the newest checkpoint on, until after step ``stop_at``."""
    done = list_checkpoints(out)[-1][0] if list_checkpoints(out) else 0
    with pytest.MonkeyPatch.context() as patch:
        stop = StopAt(None if stop_at is None else stop_at - done)
        patch.setattr(trainer_module, "StopRequest", lambda **_: nullcontext(stop))
        code = train(configure(line, episodes, out), resume=True)
    assert code == (0 if stop_at is None else EXIT_INTERRUPTED)
    return list_checkpoints(out)[-1][0]


def make_trainer(line: str, episodes: Path, out: Path) -> Trainer:
    """Return a trainer at its beginning, which writes nothing."""
    setup = TrainSetup.load(configure(line, episodes, out))
    images = ImageStore(setup.demonstrations) if setup.dims.cameras else None
    return Trainer(setup, None, CPU, Processes(), images=images)


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
        assert run(RUNS[name], episodes, tmp_path / "parts", stop_at=stop_at) == stop_at
    assert run(RUNS[name], episodes, tmp_path / "parts") == STEPS
    assert contents(tmp_path / "parts") == contents(tmp_path / "whole")


@pytest.mark.parametrize("name", ["average, cosine, warm-up, clipped", "images"])
def test_an_extended_run_is_the_longer_run(name: str, episodes: Path, tmp_path: Path) -> None:
    """For a learning rate that does not depend on the budget; the old end was a multiple of 3."""
    steady = RUNS[name] + " --schedule constant"
    run(steady, episodes, tmp_path / "whole")
    run(f"{steady} --steps 6", episodes, tmp_path / "parts")
    assert read_config(tmp_path / "parts" / CONFIG)["steps"] == 6
    assert run(steady, episodes, tmp_path / "parts") == STEPS
    assert read_config(tmp_path / "parts" / CONFIG)["steps"] == STEPS
    whole, parts = contents(tmp_path / "whole"), contents(tmp_path / "parts")
    for written in ("model", "trainer", "json"):
        assert parts[written] == whole[written]
    # the end of the first budget was validated, which the longer run has not done there
    assert [line for line in parts["metrics"] if line in whole["metrics"]] == whole["metrics"]


def test_a_cosine_goes_on_at_the_rate_of_the_new_budget(episodes: Path, tmp_path: Path) -> None:
    curve = "Mlp --schedule cosine --warmup_steps 0 --learning_rate 1e-3 --log_every 1"
    run(f"{curve} --steps 4", episodes, tmp_path / "run")
    run(f"{curve} --steps 8", episodes, tmp_path / "run")
    lines = [x for x in read_metrics(tmp_path / "run" / METRICS) if x["kind"] == "train"]
    rates = [x["learning_rate"] for x in lines]
    expected = [*(0.5e-3 * (1 + np.cos(np.pi * k / 4)) for k in range(4))]
    expected += [0.5e-3 * (1 + np.cos(np.pi * k / 8)) for k in range(4, 8)]
    np.testing.assert_allclose(rates, expected, rtol=1e-6)


def test_a_budget_below_what_was_done_is_refused(episodes: Path, tmp_path: Path) -> None:
    run("Mlp --steps 6", episodes, tmp_path / "run")
    before = contents(tmp_path / "run")
    with pytest.raises(RequestError, match=r"has done 6 steps already, more than 4; give a larger"):
        run("Mlp --steps 4", episodes, tmp_path / "run")
    with pytest.raises(RequestError, match=r"with batch_size \d+, not 2"):
        run("Mlp --steps 9 --batch_size 2", episodes, tmp_path / "run")
    assert contents(tmp_path / "run") == before


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
    trainer = make_trainer(line, episodes, tmp_path / "loop")
    model, settings = trainer.state.model, configure(line, episodes, tmp_path).training
    optimizer = torch.optim.AdamW(
        model.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay
    )
    losses = []
    for step in range(STEPS):
        factor = 0.5 * (1 + math.cos(math.pi * step / STEPS))
        optimizer.param_groups[0]["lr"] = settings.learning_rate * factor
        optimizer.zero_grad()
        loss = model.loss(trainer.loader.batch(step))["loss"]
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
    trainer = make_trainer(RUNS["average, cosine, warm-up, clipped"], episodes, tmp_path)
    assert trainer.held_out is not None
    losses = trainer.held_out(model)
    assert losses == trainer.held_out(model)  # the same draws every time
    last = [x for x in read_metrics(tmp_path / METRICS) if x["kind"] == "validation"][-1]
    assert last["loss"] == pytest.approx(losses["loss"], rel=1e-6)  # seven digits are written


def test_every_step_enters_the_average(
    episodes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(trainer_module, "KEPT_CHECKPOINTS", STEPS)
    line = f"{MLP} --ema_decay 0.3 --checkpoint_every 1"
    first = make_trainer(line, episodes, tmp_path).state.model.state_dict()
    expected = {name: value.double() for name, value in first.items()}
    run(line, episodes, tmp_path)
    for step, (_, folder) in enumerate(list_checkpoints(tmp_path)):
        decay = min(0.3, (1 + step) / (10 + step))
        tensors = load_file(folder / "trainer.safetensors")
        averages = load_file(folder / "model.safetensors")
        for name, value in averages.items():
            now = tensors[f"weights/{name}"].double()
            expected[name] = decay * expected[name] + (1 - decay) * now
            # at most ten float32 roundings of weights below 1
            np.testing.assert_allclose(value.double(), expected[name], rtol=1e-5, atol=1e-7)
    assert step == STEPS - 1


def test_validation_is_without_dropout(episodes: Path, tmp_path: Path) -> None:
    trainer = make_trainer(PLAIN, episodes, tmp_path)
    assert trainer.held_out is not None
    model = trainer.state.model.train()
    losses = trainer.held_out(model)
    assert model.training
    assert trainer.held_out(model.eval()) == losses


def test_every_step_drops_other_units(episodes: Path, tmp_path: Path) -> None:
    """A batch is all frames and no step learns: the losses differ by dropout alone."""
    line = f"{PLAIN} --validation_fraction 0 --batch_size 39 --learning_rate 1e-20 --log_every 1"
    spread = {}
    for dropout in ("0", "0.2"):
        line_of = line.replace("--dropout 0.2", f"--dropout {dropout} --state_noise 0")
        run(f"{line_of} --clock_noise 0", episodes, tmp_path / dropout)
        lines = read_metrics(tmp_path / dropout / METRICS)
        losses = [x["loss"] for x in lines if x["kind"] == "train"]
        assert len(losses) == STEPS
        spread[dropout] = np.diff(sorted(losses))
    assert spread["0"].max() < 1e-5  # float32 sums in another order
    assert spread["0.2"].max() > 1e-3
    assert np.count_nonzero(spread["0.2"]) == STEPS - 1


@pytest.fixture
def diverging(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the loss of Mlp infinite from the third step on."""
    real, steps = MlpModel.loss, itertools.count(1)

    def loss(self: MlpModel, batch: Batch) -> dict[str, Tensor]:
        factor = float("inf") if next(steps) > 2 else 1.0
        return {name: value * factor for name, value in real(self, batch).items()}

    monkeypatch.setattr(MlpModel, "loss", loss)


@pytest.mark.usefixtures("diverging")
def test_a_loss_that_is_not_finite_stops_in_one_line(episodes: Path, tmp_path: Path) -> None:
    with pytest.raises(RequestError, match=r"not finite any more at step 3; lower --learning_rate"):
        run(MLP, episodes, tmp_path)
    assert list_checkpoints(tmp_path) == []


@pytest.mark.usefixtures("diverging")
def test_weights_that_are_not_finite_are_not_saved(episodes: Path, tmp_path: Path) -> None:
    """Interrupted long before the next line of metrics."""
    with pytest.raises(RequestError, match="not finite any more at step 3"):
        run(f"{MLP} --log_every 100", episodes, tmp_path, stop_at=3)
    assert list_checkpoints(tmp_path) == []


def test_initial_weights_may_be_gone_when_resuming(
    episodes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[bool] = []
    real = TrainSetup.make_model

    def spy(self: TrainSetup, *, initial_weights: bool = True) -> Any:
        made.append(initial_weights)
        return real(self, initial_weights=initial_weights)

    monkeypatch.setattr(TrainSetup, "make_model", spy)
    run(RUNS["latent noise"], episodes, tmp_path, stop_at=2)
    run(RUNS["latent noise"], episodes, tmp_path)
    assert made == [True, False]


def test_gradients_have_the_layout_of_their_weights(episodes: Path, tmp_path: Path) -> None:
    """Fused AdamW reads weight, gradient and moments as flat memory."""
    trainer, seen = make_trainer(RUNS["images"], episodes, tmp_path), 0
    state = trainer.state
    state.model.loss(trainer.loader.batch(0))["loss"].backward()
    for parameter in state.model.parameters():
        if parameter.grad is not None:
            assert parameter.grad.stride() == parameter.stride()
            seen += parameter.ndim == 4 and not parameter.is_contiguous()
    state.optimizer.step()
    for parameter, moments in state.optimizer.state.items():
        assert moments["exp_avg"].stride() == parameter.stride()
    assert seen, "no convolution has its weights in channels_last"


@pytest.mark.cuda
@pytest.mark.parametrize("name", ["average, cosine, warm-up, clipped", "images"])
def test_a_recorded_step_trains_as_a_computed_one(
    name: str, episodes: Path, tmp_path: Path
) -> None:
    """With the same masks of dropout; across an interruption, too."""
    on_gpu = f"{RUNS[name]} --device cuda --precision fp32 --log_every 1"
    run(f"{on_gpu} --no_cuda_graph", episodes, tmp_path / "computed")
    run(on_gpu, episodes, tmp_path / "recorded")
    run(on_gpu, episodes, tmp_path / "parts", stop_at=6)
    run(on_gpu, episodes, tmp_path / "parts")
    losses = []
    for out in ("computed", "recorded", "parts"):
        lines = [x for x in read_metrics(tmp_path / out / METRICS) if x["kind"] == "train"]
        assert [line["step"] for line in lines] == list(range(1, STEPS + 1))
        losses.append([line["loss"] for line in lines])
    np.testing.assert_allclose(losses[1], losses[0], rtol=5e-3)  # TF32
    np.testing.assert_allclose(losses[2], losses[0], rtol=5e-3)


def test_the_norm_is_recorded_and_measured(episodes: Path, tmp_path: Path) -> None:
    for name, norm in (("own", "action_min_max"), ("given", "mean_std")):
        run(FLOW if name == "own" else f"{FLOW} --norm {norm}", episodes, tmp_path / name)
        assert read_checkpoint(tmp_path / name).settings.norm == norm
    own, given = (read_checkpoint(tmp_path / name).normalization for name in ("own", "given"))
    np.testing.assert_array_equal(own.state_std, given.state_std)
    assert (own.action_std > given.action_std).any()


def test_a_norm_beyond_the_range_of_a_policy_is_refused(episodes: Path, tmp_path: Path) -> None:
    line = FLOW.replace("Flow", "Diffusion") + " --norm mean_std"
    with pytest.raises(RequestError, match=r"norm mean_std: actions .* give --clip_sample"):
        run(line, episodes, tmp_path)
    make_trainer(f"{line} --clip_sample 9", episodes, tmp_path)


def test_a_training_begins_with_the_weights_of_another(episodes: Path, tmp_path: Path) -> None:
    """The average's, and its normalisation, also of fewer demonstrations; nothing else."""
    run(f"{FLOW} --ema_decay 0.9", episodes, tmp_path / "first")
    first = read_checkpoint(tmp_path / "first")
    line = f"{FLOW} --num_episodes 2 --init_from {tmp_path}/first"
    begun = make_trainer(line, episodes, tmp_path / "second")
    wanted = load_model(first).state_dict()
    for name, value in begun.state.model.state_dict().items():
        assert torch.equal(value, wanted[name]), name
    assert not begun.state.optimizer.state
    run(line, episodes, tmp_path / "second", stop_at=4)
    for path in sorted((tmp_path / "first").rglob("*"), reverse=True):
        path.rmdir() if path.is_dir() else path.unlink()
    assert run(line, episodes, tmp_path / "second") == STEPS  # goes on without it
    second = read_checkpoint(tmp_path / "second")
    np.testing.assert_array_equal(second.normalization.state_mean, first.normalization.state_mean)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ("--norm mean_std", "norm action_min_max, not mean_std"),
        ("--obs current", "elements of state and action"),
        ("--hidden_size 8", "does not fit Flow"),
    ],
)
def test_what_another_training_cannot_begin_with(
    episodes: Path, tmp_path: Path, more: str, message: str
) -> None:
    run(FLOW, episodes, tmp_path / "first")
    with pytest.raises(RequestError, match=message):
        make_trainer(f"{FLOW} {more} --init_from {tmp_path}/first", episodes, tmp_path / "second")


def test_a_training_ends_where_the_held_out_loss_stops_falling(
    episodes: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Weights that do not move: the first validation is the best one."""
    still = f"{PLAIN} --schedule constant --learning_rate 1e-30 --validate_every 2"
    early = f"{still} --early_stopping 2"
    for out, stop_at in (("whole", None), ("parts", 5)):
        if stop_at:
            assert run(early, episodes, tmp_path / out, stop_at=stop_at) == stop_at
        assert run(early, episodes, tmp_path / out) == 6  # 2, and two more validations
    assert contents(tmp_path / "parts") == contents(tmp_path / "whole")
    ((step, _),) = list_checkpoints(tmp_path / "whole" / BEST)
    assert step == read_checkpoint(tmp_path / "whole" / BEST).step == 2
    assert read_checkpoint(tmp_path / "whole").step == 6
    caplog.set_level("INFO")
    assert run(early, episodes, tmp_path / "whole") == 6
    assert "2 validations after the smallest held-out loss" in caplog.text
    # Extended, it is the run that never stopped.
    assert run(f"{still} --early_stopping 0", episodes, tmp_path / "whole") == STEPS
    run(still, episodes, tmp_path / "never")
    assert contents(tmp_path / "whole")["model"] == contents(tmp_path / "never")["model"]


def test_a_loss_that_falls_is_followed(episodes: Path, tmp_path: Path) -> None:
    line = f"{PLAIN} --schedule constant --learning_rate 0.01 --validate_every 1 --early_stopping 9"
    run(line, episodes, tmp_path)
    losses = [x for x in read_metrics(tmp_path / METRICS) if x["kind"] == "validation"]
    best = min(losses, key=lambda x: x["loss"])
    checkpoint = read_checkpoint(tmp_path / BEST)
    assert checkpoint.step == best["step"]
    setup = TrainSetup.load(configure(line, episodes, tmp_path / "again"))
    model = load_model(checkpoint)
    held_out = HeldOutLoss(setup, model, None, CPU, None)
    assert held_out(model)["loss"] == pytest.approx(best["loss"], rel=1e-6)  # float32


def test_a_killed_run_has_the_best_checkpoint_of_what_it_goes_on_from(
    episodes: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    line = f"{PLAIN} --schedule constant --learning_rate 0.01 --validate_every 1 --early_stopping 9"
    line += " --checkpoint_every 4"

    def die(trainer: Trainer) -> None:
        if trainer._progress.step == 8:
            raise KeyboardInterrupt
        save(trainer)

    save = Trainer._save
    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "_save", die)
        with pytest.raises(KeyboardInterrupt):
            run(line, episodes, tmp_path / "killed")
    assert list_checkpoints(tmp_path / "killed")[-1][0] == 4
    steps = [step for step, _ in list_checkpoints(tmp_path / "killed" / BEST)]
    assert steps[0] <= 4 < steps[-1]
    for name in ("killed", "whole"):
        run(line, episodes, tmp_path / name)
    assert len(list_checkpoints(tmp_path / "killed" / BEST)) == 1
    assert contents(tmp_path / "killed" / BEST) == contents(tmp_path / "whole" / BEST)


def test_early_stopping_needs_episodes_to_stop_by(episodes: Path, tmp_path: Path) -> None:
    with pytest.raises(RequestError, match="no episodes are held out to stop by"):
        configure(f"{MLP} --validation_fraction 0 --early_stopping 3", episodes, tmp_path)
