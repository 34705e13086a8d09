# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""Langevin dynamics with substeps, written down again with dense matrices: what the integrator is compared with."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

BOLTZMANN = 0.00831446261815324
FLIGHT_LENGTH, POWER, TRIGGER, FLOOR, FLOOR_PART, RATE = 0.0125, 2 / 3, 2.2, 0.5, 0.2, 0.002
LARGEST_THERMAL, ROOM_TEMPERATURE = 16, 300


def philox(counter: np.ndarray, key: tuple[int, int]) -> np.ndarray:
    """Philox4x32-10 of rows of four 32 bit words."""
    words = [counter[:, i].astype(np.uint64) for i in range(4)]
    mask = np.uint64(0xFFFFFFFF)
    k0, k1 = key
    for _ in range(10):
        a, b = np.uint64(0xD2511F53) * words[0], np.uint64(0xCD9E8D57) * words[2]
        high = np.uint64(32)
        words = [(b >> high) ^ words[1] ^ np.uint64(k0), b & mask, (a >> high) ^ words[3] ^ np.uint64(k1), a & mask]
        k0, k1 = (k0 + 0x9E3779B9) & 0xFFFFFFFF, (k1 + 0xBB67AE85) & 0xFFFFFFFF
    return np.stack(words, axis=1)


def normal_numbers(seed: int, step: int, count: int) -> np.ndarray:
    """Three numbers for each of `count` particles."""
    counter = np.zeros((count, 4), dtype=np.uint64)
    counter[:, 0], counter[:, 1], counter[:, 2] = step & 0xFFFFFFFF, step >> 32, np.arange(count)
    words = philox(counter, (seed & 0xFFFFFFFF, (seed >> 32) & 0xFFFFFFFF)).astype(float)
    first, second = np.sqrt(-2 * np.log((words[:, 0] + 0.5) / 2**32)), np.sqrt(-2 * np.log((words[:, 2] + 0.5) / 2**32))
    angle, other = 2 * np.pi * words[:, 1] / 2**32, 2 * np.pi * words[:, 3] / 2**32
    return np.stack([first * np.cos(angle), first * np.sin(angle), second * np.cos(other)], axis=1)


@dataclass
class Statement:
    """A system of particles with distance constraints, and the step of docs/langevin.md."""

    masses: np.ndarray
    constraints: Sequence[tuple[int, int, float]]
    """Two particles and their distance."""
    force: Callable[[np.ndarray], np.ndarray]
    temperature: float
    friction: float
    step_size: float
    num_projections: int = 1
    """Of velocities in a substep: 1 at its end, or 4, also after the half kick, the noise and the central drift."""
    largest: int = 10
    reference: float = 0.0
    noise_at: dict[str, np.ndarray] = field(default_factory=dict)
    """The velocities before and after the noise of the last step."""

    def __post_init__(self) -> None:
        self.clusters = np.arange(len(self.masses))
        for i, j, _ in self.constraints:
            self.clusters[self.clusters == self.clusters[j]] = self.clusters[i]

    def g(self, q: np.ndarray) -> np.ndarray:
        return np.array([(np.sum((q[i] - q[j]) ** 2) - d * d) / (2 * d * d) for i, j, d in self.constraints])

    def jacobian(self, q: np.ndarray) -> np.ndarray:
        rows = np.zeros((len(self.constraints), *q.shape))
        for k, (i, j, d) in enumerate(self.constraints):
            rows[k, i], rows[k, j] = (q[i] - q[j]) / d**2, (q[j] - q[i]) / d**2
        return rows.reshape(len(self.constraints), -1)

    def _over_mass(self, rows: np.ndarray) -> np.ndarray:
        return rows / np.repeat(self.masses, 3)

    def project(self, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        if not self.constraints:
            return v
        rows = self.jacobian(q)
        multipliers = np.linalg.solve(rows @ self._over_mass(rows).T, rows @ v.ravel())
        return v - (self._over_mass(rows).T @ multipliers).reshape(v.shape)

    def drift(self, q: np.ndarray, v: np.ndarray, size: float) -> tuple[np.ndarray, np.ndarray]:
        if not self.constraints:
            return q + size * v, v
        rows = self._over_mass(self.jacobian(q))
        impulses = np.zeros(len(self.constraints))
        for _ in range(100):
            w = v - (rows.T @ impulses).reshape(v.shape)
            end = q + size * w
            error = self.g(end)
            if not np.all(np.isfinite(error)):
                break
            change = np.linalg.solve(self.jacobian(end) @ rows.T * size, error)
            impulses = impulses + change
            if np.max(np.abs(error)) < 1e-13:
                return end, w
        raise ArithmeticError("no convergence")

    def monitor(self, q: np.ndarray, v: np.ndarray, f: np.ndarray) -> float:
        net = f
        if self.constraints:
            rows = self.jacobian(q)
            curvature = np.array([np.sum((v[i] - v[j]) ** 2) / d**2 for i, j, d in self.constraints])
            multipliers = np.linalg.solve(rows @ self._over_mass(rows).T, curvature + self._over_mass(rows) @ f.ravel())
            net = f - (rows.T @ multipliers).reshape(f.shape)
        size = np.linalg.norm(net, axis=1)
        each = size**2 / self.masses + size * np.sum(v * v, axis=1) / FLIGHT_LENGTH
        return float(np.sum(np.bincount(self.clusters, each) ** 4) ** 0.125)

    def doublings(self, u: float) -> int:
        asked = (u / self.reference) ** POWER / TRIGGER
        return next(k for k in range(1000) if 2**k >= asked)

    def attempt(
        self, q: np.ndarray, v: np.ndarray, noise: np.ndarray, k: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The step made of n substeps."""
        n = 1 if k == 0 else 2**k + 1
        d = self.step_size / n
        mass = self.masses[:, None]
        damping = np.exp(-self.friction * self.step_size)
        scale = np.sqrt(BOLTZMANN * self.temperature * (1 - damping**2))
        also = self.project if self.num_projections == 4 else lambda q, v: v
        f = self.force(q)
        for i in range(n):
            v = also(q, v + d / 2 * f / mass)
            if i == (n - 1) // 2:
                q, v = self.drift(q, v, d / 2)
                v = also(q, v)
                self.noise_at["before"] = v
                v = damping * v + scale * noise / np.sqrt(mass)
                self.noise_at["after"] = v
                q, v = self.drift(q, also(q, v), d / 2)
            else:
                q, v = self.drift(q, v, d)
            f = self.force(q)
            v = self.project(q, v + d / 2 * f / mass)
        return q, v, f

    def step(self, q: np.ndarray, v: np.ndarray, noise: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
        """A step, and the k that it has taken."""
        size = np.sum(np.bincount(self.clusters).astype(float) ** 4) ** 0.125
        floor = max(FLOOR, FLOOR_PART * size) * np.sqrt(BOLTZMANN * max(self.temperature, 10)) / self.step_size
        u = self.monitor(q, v, self.force(q))
        if self.reference == 0:
            self.reference = min(max(u, floor), 4 * floor)
        k = min(self.doublings(u), self.largest)
        while True:
            try:
                end, velocity, f = self.attempt(q, v, noise, k)
                u = self.monitor(end, velocity, f)
                if k == self.largest or self.doublings(u) <= k:
                    break
            except ArithmeticError:
                assert k < self.largest
            k += 1
        warm = floor * np.sqrt(max(self.temperature, ROOM_TEMPERATURE) / max(self.temperature, 10))
        if k == 0 or u <= max(self.reference, LARGEST_THERMAL * warm):
            self.reference = max(floor, self.reference * np.exp(RATE * np.sign(u - self.reference)))
        return end, velocity, k

    def reversed_noise(self) -> np.ndarray:
        """What takes the last step back, from the velocities at its end with the sign changed."""
        damping = np.exp(-self.friction * self.step_size)
        scale = np.sqrt(BOLTZMANN * self.temperature * (1 - damping**2))
        return (damping * self.noise_at["after"] - self.noise_at["before"]) * np.sqrt(self.masses[:, None]) / scale
