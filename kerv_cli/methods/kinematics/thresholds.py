"""KERV's thresholds: the acceptance radius r in bins (docs/methods.md §3.2). They keep r as a real number and round it
for use."""

from __future__ import annotations

import math
from typing import Self

from kerv_cli.methods.context import Context
from kerv_cli.methods.kinematics import KinematicThresholdSettings, ScheduleThresholdSettings


class Kinematic:
    """r = r_min + (r_max − r_min) · exp(−(K / K_S)^φ) of the last decode that compared anything (KERV, level form).

    An episode begins at K = K_S, the reference level.
    """

    def __init__(self, r_min: int, r_max: int, phi: float, k_s: float) -> None:
        self.r_min, self.r_max, self.phi, self.k_s = r_min, r_max, phi, k_s
        self.reset()

    @classmethod
    def build(cls, settings: KinematicThresholdSettings, context: Context) -> Self:
        """threshold=kinematic, change; K_S is the task's, from the calibration, where none is given.

        Raises:
            UsageError: a radius above the largest distance of two tokens.
        """
        context.check_radius("r_max", settings.r_max)
        k_s = settings.k_s if settings.k_s is not None else context.calibration.k_s(context.task)
        return cls(settings.r_min, settings.r_max, settings.phi, k_s)

    def reset(self) -> None:
        """r as after a decode with K = K_S."""
        self.r = self.level(self.k_s)

    def level(self, variability: float) -> float:
        """K in normalised action units -> r, not rounded."""
        return falling(self.r_min, self.r_max, variability / self.k_s, self.phi)

    def radius(self) -> int:
        """r rounded to the nearest bin."""
        return nearest(self.r)

    def update(self, variability: float | None) -> None:
        """Sets r from K; a decode without K leaves it."""
        if variability is not None:
            self.r = self.level(variability)


class Change(Kinematic):
    """Ablation: r shrinks when K grows and grows when K shrinks.

    r ← clamp(r − (r_max − r_min) · sign(Δ) · (1 − exp(−|Δ / K_S|^φ)), r_min, r_max), Δ = K_t − K_{t−1} over decodes
    that compared something. An episode begins where `Kinematic` does, with K_{t−1} = K_S.
    """

    def reset(self) -> None:
        """r as after a decode with K = K_S, which is also the K to compare with."""
        super().reset()
        self.last = self.k_s

    def update(self, variability: float | None) -> None:
        """Moves r against the change of K; a decode without K leaves it."""
        if variability is None:
            return
        change = (variability - self.last) / self.k_s
        move = (self.r_max - self.r_min) - falling(0, self.r_max - self.r_min, abs(change), self.phi)
        self.r = min(self.r_max, max(self.r_min, self.r - math.copysign(move, change)))
        self.last = variability


class Schedule:
    """r(t) = r_min + (r_max − r_min) · exp(−(t / τ)^φ), t decodes into the episode: open loop.

    KERV's public code has 3 + 12 · exp(−(t / τ)^3): r_min 3, r_max 15, φ 3, the defaults here.
    """

    def __init__(self, r_min: int, r_max: int, phi: float, tau: float) -> None:
        self.r_min, self.r_max, self.phi, self.tau = r_min, r_max, phi, tau
        self.reset()

    @classmethod
    def build(cls, settings: ScheduleThresholdSettings, context: Context) -> Schedule:
        """threshold=schedule; errors as `Kinematic.build`."""
        context.check_radius("r_max", settings.r_max)
        return cls(settings.r_min, settings.r_max, settings.phi, settings.tau)

    def reset(self) -> None:
        """Starts again at t = 0."""
        self.decodes = 0

    def radius(self) -> int:
        """r(t) rounded to the nearest bin."""
        return nearest(falling(self.r_min, self.r_max, self.decodes / self.tau, self.phi))

    def update(self, variability: float | None) -> None:
        """t grows by one; K is not used."""
        self.decodes += 1


def falling(low: float, high: float, x: float, phi: float) -> float:
    """low + (high − low) · exp(−x^φ): `high` at x ≤ 0, falling to `low`."""
    if x <= 0:
        return float(high)
    power = math.exp(min(700.0, phi * math.log(x)))  # x^φ without overflow; exp(−e^700) is zero
    return low + (high - low) * math.exp(-power)


def nearest(r: float) -> int:
    """r rounded to the nearest bin, halves up."""
    return math.floor(r + 0.5)
