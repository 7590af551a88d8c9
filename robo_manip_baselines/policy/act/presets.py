"""Presets of ACT: ``paper`` for a GPU, ``cpu`` for a laptop."""

from __future__ import annotations

from robo_manip_baselines.policy.act.config import ActConfig
from robo_manip_baselines.policy.presets import WITHOUT_IMAGES, Acting, PolicyPreset
from robo_manip_baselines.training.settings import TrainSettings

PRESETS = {
    "paper": PolicyPreset(
        config=ActConfig(),
        training=TrainSettings(
            batch_size=8,
            learning_rate=1e-5,
            sampler="episode",
            epochs=2000,
            validation_fraction=0.0,  # the paper trains on all 50
        ),
        acting=Acting(temporal_ensemble=True, decay=0.01),
    ),
    "cpu": PolicyPreset(
        config=ActConfig(
            chunk_size=30,
            hidden_size=128,
            feedforward_size=512,
            num_heads=4,
            encoder_layers=1,
            decoder_layers=1,
            state_layers=2,
            cvae_layers=1,
            dropout=0.0,
        ),
        training=WITHOUT_IMAGES,
        acting=Acting(temporal_ensemble=True),
        cameras=(),
        object_pose=True,
    ),
}
