"""Presets of ACT: ``paper`` for a GPU, ``cpu`` for a laptop."""

from __future__ import annotations

from robo_manip_baselines.policy.act.config import ActConfig
from robo_manip_baselines.policy.presets import Acting, PolicyPreset
from robo_manip_baselines.training.settings import TrainSettings

PRESETS = {
    "paper": PolicyPreset(
        config=ActConfig(),
        training=TrainSettings(batch_size=8, learning_rate=1e-5, sampler="episode", epochs=2000),
        acting=Acting(temporal_ensemble=True, decay=0.01),
    ),
    "cpu": PolicyPreset(
        config=ActConfig(
            chunk_size=50,
            hidden_size=128,
            feedforward_size=512,
            num_heads=4,
            encoder_layers=2,
            decoder_layers=2,
        ),
        training=TrainSettings(
            batch_size=64, learning_rate=3e-4, schedule="cosine", sampler="frame", steps=5000
        ),
        acting=Acting(temporal_ensemble=True, decay=0.01),
        cameras=(),
        object_pose=True,
    ),
}
