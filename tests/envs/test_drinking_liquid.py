"""Liquid in the cup: its level against exact geometry, its flow, and no drop lost."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from robo_manip_baselines.envs.mujoco.tasks.drinking.cup import SLICES, slice_heights
from robo_manip_baselines.envs.mujoco.tasks.drinking.liquid import (
    CAPACITY,
    CAVITY_HEIGHT,
    CAVITY_RADIUS,
    GRAVITY,
    SERVING,
    SPOUT_TIP,
    Liquid,
    jet_at,
    outflow_speed,
    surface_height,
)


def up_in_cup(tilt: float, around: float = 0.0) -> np.ndarray:
    """(3,) upwards in the frame of a cup that is tilted towards its spout, or turned from there."""
    away = -np.sin(np.radians(tilt)) * np.array([np.cos(around), np.sin(around)])
    return np.array([*away, np.cos(np.radians(tilt))])


def exact_volume(height: float, up: np.ndarray) -> float:
    """m³ of the cavity below a height along ``up``, by summing columns of a fine grid."""
    edge = np.linspace(-CAVITY_RADIUS, CAVITY_RADIUS, 401)
    x, y = np.meshgrid(edge, edge)
    inside = x**2 + y**2 <= CAVITY_RADIUS**2
    area = np.pi * CAVITY_RADIUS**2 / inside.sum()
    if abs(up[2]) < 1e-6:  # lying on its side
        below = np.full(x.shape, CAVITY_HEIGHT) * (up[0] * x + up[1] * y <= height)
    else:
        cut = np.clip(
            (height - up[0] * x - up[1] * y) / up[2], *np.array([-0.5, 0.5]) * CAVITY_HEIGHT
        )
        below = cut + CAVITY_HEIGHT / 2 if up[2] > 0 else CAVITY_HEIGHT / 2 - cut
    return float((below * inside).sum() * area)


@pytest.mark.parametrize("share", [0.05, 0.25, 0.5, 0.95])
@pytest.mark.parametrize("around", [0.0, 1.0, 2.5])
@pytest.mark.parametrize("tilt", [0.0, 10.0, 30.0, 45.0, 80.0, 90.0, 120.0, 180.0])
def test_level_agrees_with_columns(share: float, around: float, tilt: float) -> None:
    up, volume = up_in_cup(tilt, around), share * CAPACITY
    found = exact_volume(surface_height(volume, up), up)
    assert found == pytest.approx(volume, abs=0.015 * SERVING)  # what the 2000 parts are off


def test_level_of_an_upright_cup_is_that_of_a_cylinder() -> None:
    level = SERVING / (np.pi * CAVITY_RADIUS**2) - CAVITY_HEIGHT / 2
    assert surface_height(SERVING, up_in_cup(0.0)) == pytest.approx(level, abs=1e-4)


@pytest.mark.parametrize("tilt", [0.0, 40.0, 100.0])
def test_level_rises_with_the_volume(tilt: float) -> None:
    up = up_in_cup(tilt)
    levels = [surface_height(volume, up) for volume in np.linspace(0.0, CAPACITY, 50)]
    assert levels[0] == -np.inf
    assert (np.diff(levels[1:]) > 0.0).all()


@pytest.mark.parametrize(("tilt", "pours"), [(0, False), (10, False), (18, False), (20, True)])
def test_a_full_cup_pours_from_19_degrees_on(tilt: float, pours: bool) -> None:
    up = up_in_cup(tilt)
    assert (outflow_speed(surface_height(SERVING, up), up) > 0.0) is pours


@pytest.mark.parametrize(("around", "tilt"), [(np.pi / 2, 20), (np.pi, 60)])
def test_it_pours_through_the_spout_alone(around: float, tilt: float) -> None:
    up = up_in_cup(tilt, around)
    assert outflow_speed(surface_height(SERVING, up), up) == 0.0


def test_speed_is_that_of_a_fall_from_the_surface() -> None:
    up = up_in_cup(40.0)
    tip = float(SPOUT_TIP @ up)
    for head in (0.0, 0.002, 0.01):
        time = np.sqrt(2.0 * head / GRAVITY)
        assert outflow_speed(tip + head, up) == pytest.approx(GRAVITY * time, abs=1e-9)
    assert outflow_speed(tip - 0.001, up) == 0.0
    assert outflow_speed(-np.inf, up) == 0.0


def pour(tilts: np.ndarray, period: float, inside: np.ndarray) -> list[Liquid]:
    """The liquid after each period of a course of tilts, in degrees."""
    liquids = [Liquid()]
    for tilt, is_into_mouth in zip(tilts, inside, strict=True):
        last, up = liquids[-1], up_in_cup(tilt)
        speed = outflow_speed(surface_height(last.left, up), up)
        liquids.append(last.flow(speed, period, bool(is_into_mouth)))
    return liquids


def test_no_drop_is_lost_or_made() -> None:
    rng = np.random.default_rng(0)
    liquids = pour(rng.uniform(0.0, 180.0, 400), 0.02, rng.random(400) < 0.5)
    for before, now in itertools.pairwise(liquids):
        # Rounding: some units in the last place of 4e-5 m³ a step.
        assert now.left + now.delivered + now.spilled == pytest.approx(SERVING, abs=1e-17)
        assert 0.0 <= now.left <= before.left
        assert now.delivered >= before.delivered
        assert now.spilled >= before.spilled
    assert liquids[-1].delivered > 0.0 < liquids[-1].spilled
    assert liquids[-1].delivered_share + liquids[-1].spilled_share <= 1.0 + 1e-12


@pytest.mark.parametrize("tilt", [15.0, 22.0, 28.0, 36.0, 46.0])
def test_a_tilted_cup_keeps_what_is_below_its_spout(tilt: float) -> None:
    last = pour(np.full(4000, tilt), 0.02, np.ones(4000))[-1]  # 80 s
    up = up_in_cup(tilt)
    kept = min(SERVING, exact_volume(float(SPOUT_TIP @ up), up))
    assert last.left == pytest.approx(kept, abs=0.015 * SERVING)


def test_the_flow_does_not_depend_on_the_control_period() -> None:
    """Half the period, the same: 20 ms are short beside the seconds that it takes to drink."""
    ramp = np.linspace(15.0, 46.0, 200)
    coarse = pour(ramp, 0.02, np.ones(200))[-1]
    fine = pour(np.repeat(ramp, 2), 0.01, np.ones(400))[-1]
    assert coarse.delivered_share == pytest.approx(fine.delivered_share, abs=0.01)


def test_a_jet_flies_as_everything_that_falls() -> None:
    start, velocity, dt = np.array([0.1, 0.2, 0.3]), np.array([-0.4, 0.05, 0.1]), 1e-4
    position, speed = start.copy(), velocity.copy()
    for _ in range(1000):  # 0.1 s
        speed = speed - [0.0, 0.0, GRAVITY * dt]
        position = position + speed * dt
    # The sum is behind by g dt t / 2.
    np.testing.assert_allclose(jet_at(0.1, start, velocity), position, atol=6e-5)
    assert jet_at(np.zeros(3), start, velocity).shape == (3, 3)


@pytest.mark.parametrize("tilt", [0.0, 20.0, 40.0, 90.0, 170.0])
def test_what_is_drawn_is_what_is_there(tilt: float) -> None:
    edges = np.linspace(-CAVITY_RADIUS, CAVITY_RADIUS, SLICES + 1)
    places, up = (edges[1:] + edges[:-1]) / 2, up_in_cup(tilt)
    low, high = slice_heights(surface_height(SERVING, up), up, places)
    assert (low <= high).all()
    chords = 2.0 * np.sqrt(CAVITY_RADIUS**2 - places**2)
    drawn = ((high - low) * chords).sum() * (edges[1] - edges[0])
    assert drawn == pytest.approx(SERVING, rel=0.08)  # by ten straight slices of a round cup
    for end in slice_heights(-np.inf, up, places):
        np.testing.assert_array_equal(end, slice_heights(-np.inf, up, places)[0])
