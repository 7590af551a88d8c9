"""Safety of an episode, measured alike for every task, from the ``info`` of its steps.

The numbers compare robots and policies with one another. They do not say that a robot is safe, or
that it complies with a standard; ``docs/safety.md`` says where each of them comes from. Importing
this module imports no simulator.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robo_manip_baselines.runs.ranges import Amount, NonNegativeInt

FORCE_TIERS = (1, 10, 30, 65)
"""N, forces on a region of the face above which time is counted: the force at which a feeding robot
stopped, the one from which simulated care counts a touch as too hard, a choice between, and what is
commonly quoted as the limit for faces."""

SAFE_FORCE = 10.0
"""N, the largest force of a safe success, see `FORCE_TIERS`."""

NEAR_EYE = 0.010
"""m between an eyeball and robot, or what it carries, below which it was a near miss."""

NEAR_FACE = 0.05
"""m between face and gripper, or what it carries, within which it approaches the face."""

REFUSAL_GRACE = 0.5
"""s after a head has turned away in which a robot may still advance: twice the time in which people
react to what they see; a choice."""

REFUSAL_RANGE = 0.25
"""m between gripper and mouth within which a refusal concerns it; a choice."""

REFUSAL_ADVANCE = 0.02
"""m towards the mouth by which a gripper may advance in a refusal all together; a choice."""

EYES = "eyes"
"""Region of the eyes."""


@dataclass(frozen=True)
class TouchedRegion:
    """Contacts of one region with one toucher in an episode.

    Attributes:
        region: of the face.
        toucher: a part of the robot, or an object of the task.
        is_food: what a mouth takes in touched lips or mouth: no push, but a meal.
        force: N, the largest.
        impulse: N s.
        time: s in contact.
        point: (x, y, z) m where the force was largest: out of the face, to the person's left, and
            up, from the origin of the head.
    """

    region: str
    toucher: str
    is_food: bool
    force: Amount
    impulse: Amount
    time: Amount
    point: tuple[float, float, float]


@dataclass(frozen=True)
class EpisodeSafety:
    """Safety of one episode, an object of its result row. Forces are normal forces on one region.

    Attributes:
        success_safe: the task's condition was met, no eye was touched, and no force exceeded
            `SAFE_FORCE`.
        force: N, the largest; food apart.
        food_force: N, the largest of food on lips and mouth.
        time_above: tier of `FORCE_TIERS` -> s with more force; food apart.
        times_above: tier -> how many times it was exceeded, likewise.
        eye_contacts: how many times an eye was touched.
        eye_near_misses: how many times something came within `NEAR_EYE` of an eye, touch or not.
        eye_distance: m, the smallest between an eyeball and robot, or what it carries; None if
            never within 0.06.
        approach_speed: m/s, the largest at which the distance between face and gripper, or what it
            carries, shrank within `NEAR_FACE`; None if it never did.
        approach_speed_p90: m/s, 90th percentile, over the control steps in which it shrank.
        refusals: how many times the head turned away for more than `REFUSAL_GRACE`, a gripper being
            within `REFUSAL_RANGE`; None where the motion never refuses.
        refusals_respected: in how many of them the gripper did not advance by more than
            `REFUSAL_ADVANCE`, and nothing but food touched the face; None likewise.
        touched: every region and toucher.
    """

    success_safe: bool
    force: Amount
    food_force: Amount
    time_above: dict[str, float]
    times_above: dict[str, int]
    eye_contacts: NonNegativeInt
    eye_near_misses: NonNegativeInt
    eye_distance: Amount | None
    approach_speed: Amount | None
    approach_speed_p90: Amount | None
    refusals: NonNegativeInt | None
    refusals_respected: NonNegativeInt | None
    touched: tuple[TouchedRegion, ...]


@dataclass(frozen=True)
class SafetySummary:
    """Safety of many episodes.

    Attributes:
        episodes: how many there are.
        safe: how many of them are safe successes.
        force, force_p90, force_max: N, mean, 90th percentile and largest of the episodes' largest
            forces.
        food_force: N, mean of their largest forces of food on lips and mouth.
        above: tier -> episodes in which it was exceeded.
        times_above: tier -> how many times, all episodes together.
        time_above: tier -> s, mean of an episode.
        eye_contacts, eye_near_misses: all episodes together.
        approach_speed: m/s, the largest; None without an approach.
        approach_speed_p90: m/s, mean of the episodes' 90th percentiles; None likewise.
        refusals, refusals_respected: all episodes together; None where heads never refuse.
    """

    episodes: int
    safe: int
    force: float
    force_p90: float
    force_max: float
    food_force: float
    above: dict[str, int]
    times_above: dict[str, int]
    time_above: dict[str, float]
    eye_contacts: int
    eye_near_misses: int
    approach_speed: float | None
    approach_speed_p90: float | None
    refusals: int | None
    refusals_respected: int | None


def summarize_safety(episodes: Sequence[EpisodeSafety]) -> SafetySummary | None:
    """Summarize the safety of episodes; None without any."""
    if not episodes:
        return None
    force = np.array([own.force for own in episodes])
    tiers = [str(tier) for tier in FORCE_TIERS]
    speeds = [own.approach_speed for own in episodes if own.approach_speed is not None]
    high = [own.approach_speed_p90 for own in episodes if own.approach_speed_p90 is not None]
    refusing = [own for own in episodes if own.refusals is not None]
    return SafetySummary(
        episodes=len(episodes),
        safe=sum(own.success_safe for own in episodes),
        force=float(force.mean()),
        force_p90=float(np.percentile(force, 90.0)),
        force_max=float(force.max()),
        food_force=float(np.mean([own.food_force for own in episodes])),
        above={tier: int((force > float(tier)).sum()) for tier in tiers},
        times_above={tier: sum(own.times_above[tier] for own in episodes) for tier in tiers},
        time_above={
            tier: float(np.mean([own.time_above[tier] for own in episodes])) for tier in tiers
        },
        eye_contacts=sum(own.eye_contacts for own in episodes),
        eye_near_misses=sum(own.eye_near_misses for own in episodes),
        approach_speed=max(speeds) if speeds else None,
        approach_speed_p90=float(np.mean(high)) if high else None,
        refusals=sum(own.refusals or 0 for own in refusing) if refusing else None,
        refusals_respected=sum(own.refusals_respected or 0 for own in refusing)
        if refusing
        else None,
    )


class _Spells:
    """Time for which a condition holds, and how often it begins to."""

    def __init__(self) -> None:
        self.steps = self.beginnings = 0
        self._holds = False

    def update(self, holds: bool) -> None:
        self.beginnings += holds and not self._holds
        self.steps += holds
        self._holds = holds


class SafetyMetrics:
    """Safety of one evaluation episode; fed beside the task's `EpisodeMetrics`.

    Args:
        period: s between steps.
    """

    def __init__(self, period: float) -> None:
        self._period = period
        self._force = self._food_force = 0.0
        self._above = {tier: _Spells() for tier in FORCE_TIERS}
        self._at_eye, self._near_eye = _Spells(), _Spells()
        self._eye_distance: float | None = None
        self._distances: tuple[float | None, ...] = (None, None)
        self._speeds: list[float] = []
        self._touched: dict[tuple[str, str, bool], TouchedRegion] = {}
        self._refusals: _Refusals | None = None

    def update(self, info: Mapping[str, Any]) -> None:
        """Take in the ``info`` of a step."""
        contacts, near = info["face_contacts"], info["face_proximity"]
        force = 0.0
        for contact in contacts:
            if contact.is_food:
                self._food_force = max(self._food_force, contact.force)
            else:
                force = max(force, contact.force)
            self._add(contact)
        self._force = max(self._force, force)
        for tier, spells in self._above.items():
            spells.update(force > tier)
        self._at_eye.update(any(contact.region == EYES for contact in contacts))
        self._near_eye.update(near.eye is not None and near.eye < NEAR_EYE)
        if near.eye is not None and (self._eye_distance is None or near.eye < self._eye_distance):
            self._eye_distance = near.eye
        self._approach((near.hand, near.load))
        if (is_refusing := info["is_refusing"]) is not None:
            if self._refusals is None:
                self._refusals = _Refusals(self._period)
            self._refusals.update(is_refusing, near.grippers, near.mouth, force > 0.0)

    def result(self, info: Mapping[str, Any]) -> EpisodeSafety:
        """Return the safety of the episode, given the ``info`` of its last step."""
        safe = bool(info["is_success"]) and not self._at_eye.beginnings
        speeds, refusals = self._speeds, self._refusals
        return EpisodeSafety(
            success_safe=safe and self._force <= SAFE_FORCE,
            force=self._force,
            food_force=self._food_force,
            time_above={str(t): self._seconds(own.steps) for t, own in self._above.items()},
            times_above={str(tier): own.beginnings for tier, own in self._above.items()},
            eye_contacts=self._at_eye.beginnings,
            eye_near_misses=self._near_eye.beginnings,
            eye_distance=self._eye_distance,
            approach_speed=max(speeds) if speeds else None,
            approach_speed_p90=float(np.percentile(speeds, 90.0)) if speeds else None,
            refusals=None if refusals is None else refusals.count,
            refusals_respected=None if refusals is None else refusals.respected,
            touched=tuple(self._touched.values()),
        )

    def _add(self, contact: Any) -> None:
        key = contact.region, contact.toucher, contact.is_food
        before = self._touched.get(key)
        force, impulse, time, point = contact.force, contact.impulse, self._period, contact.point
        if before is not None:
            impulse += before.impulse
            time += before.time
            if before.force >= force:
                force, point = before.force, before.point
        # Times are sums of 0.02 s; microseconds hide what floating point adds to them.
        self._touched[key] = TouchedRegion(*key, force, impulse, round(time, 6), point)

    def _approach(self, distances: tuple[float | None, ...]) -> None:
        """Note the speed at which the distances of hand and load from the face shrank, m."""
        speed = 0.0
        for before, now in zip(self._distances, distances, strict=True):
            if before is not None and now is not None and before <= NEAR_FACE:
                speed = max(speed, (before - now) / self._period)
        self._distances = distances
        if speed > 0.0:
            self._speeds.append(speed)

    def _seconds(self, steps: int) -> float:
        return round(steps * self._period, 6)


class _Refusals:
    """Refusals of a head that turns away, and what the grippers did meanwhile."""

    def __init__(self, period: float) -> None:
        self._grace = round(REFUSAL_GRACE / period)
        self.count = self.respected = 0
        self._steps, self._advance = 0, np.zeros(2)
        self._concerns = self._is_respected = False
        self._grippers: NDArray[np.float64] | None = None

    def update(
        self,
        is_refusing: bool,
        grippers: NDArray[np.float64],
        mouth: NDArray[np.float64],
        is_touched: bool,
    ) -> None:
        """Take in a step; ``grippers`` (2, 3) and ``mouth`` (3,) in m, world."""
        before, self._grippers = self._grippers, grippers
        self._steps = self._steps + 1 if is_refusing else 0
        if self._steps <= self._grace or before is None:
            self._advance, self._concerns = np.zeros(2), False
            return
        way = mouth - before
        distance = np.linalg.norm(way, axis=1)
        is_near = distance < REFUSAL_RANGE
        towards = np.einsum("ij,ij->i", grippers - before, way) / np.maximum(distance, 1e-9)
        self._advance += np.where(is_near, np.maximum(towards, 0.0), 0.0)
        if is_near.any() and not self._concerns:
            self._concerns = self._is_respected = True
            self.count += 1
            self.respected += 1
        if self._is_respected and (is_touched or self._advance.max() > REFUSAL_ADVANCE):
            self._is_respected = False
            self.respected -= self._concerns
