"""Settings of network and training by name: ``paper`` for a GPU, ``cpu`` for one or two cores."""

from __future__ import annotations

from face_prediction.errors import RequestError
from face_prediction.models.registry import settings_class
from face_prediction.models.settings import ModelSettings
from face_prediction.training.settings import TrainSettings

PRESETS = ("paper", "cpu")

#: The paper's training is Adam at 1e-4 (IV.B); how long, on how many sequences at once, it does
#: not say. The cpu preset has minutes: it needs larger steps, and a schedule that ends them.
_TRAINING = {
    "paper": TrainSettings(steps=20_000, batch_size=16, learning_rate=1e-4, augment=False),
    "cpu": TrainSettings(
        steps=1600,
        batch_size=4,
        learning_rate=1e-3,
        schedule="cosine",
        warmup_steps=100,
        augment=True,
        validate_every=400,
    ),
}
#: Where a network is trained otherwise than the three published approaches.
_TRAINING_OF: dict[tuple[str, str], TrainSettings] = {
    # a step holds eleven origins of each sequence; what is learnt is small beside the fitted prior
    ("residual", "cpu"): TrainSettings(
        steps=500,
        batch_size=16,
        learning_rate=1e-3,
        schedule="cosine",
        warmup_steps=50,
        ema_decay=0.99,
        augment=True,
        validate_every=100,
    ),
}


def preset_settings(model: str, preset: str) -> tuple[ModelSettings, TrainSettings]:
    """Settings of network and training.

    Raises:
        RequestError: there is no such network or preset.
    """
    if preset not in PRESETS:
        raise RequestError(f"--preset {preset}: one of {', '.join(PRESETS)}")
    training = _TRAINING_OF.get((model, preset), _TRAINING[preset])
    return settings_class(model).preset(preset), training
