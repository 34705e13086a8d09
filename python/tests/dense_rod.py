# OpenMM-VRATTLE: an independent statement of the elastic rod of the paper's section 5 in dense NumPy algebra.
# SPDX-License-Identifier: MIT

"""The rod written down once more from its formulas, to hold openmmvrattle.testsystems.elastic_rod against.

All derivatives are complex steps, x + i epsilon with epsilon = 1e-30: exact to rounding, and nothing that could share a
slip with a derivative taken by hand or by symbols. Positions are flat, three points a section, the clamped section
first; functions of positions take any number of them, one a row.
"""

from __future__ import annotations

import numpy as np
from dense_reference import Array, DenseConstraints

STEP = 1e-30


def gradient_of(function, q: Array) -> Array:
    """The derivatives of a function of positions, one row for each of its values; it takes many positions at once."""
    return np.imag(function(q + 1j * STEP * np.eye(q.size))).T / STEP


class Rod(DenseConstraints):
    """Constraints, potential and start of a rod; the start is along z, turning about its foot."""

    offsets = np.array([0.3, 0.3])
    stiffness = np.array([0.1, 0.1, 0.4])
    wall, diameter, depth = 0.65, 0.25, 0.1

    def __init__(self, sections: int = 10, length: float = 1.0, angular_speed: float = 3.2) -> None:
        self.sections, self.spacing = sections, length / sections
        masses = np.full(3 * sections, self.spacing / 3)
        masses[:3] = 0.0
        pairs = [(3 * i + a, 3 * i + b) for i in range(1, sections) for a, b in ((0, 1), (0, 2), (1, 2))]
        height = (np.arange(sections) + 0.5) * self.spacing
        centres = np.outer(height, [0, 0, 1])
        d1, d2 = np.tile([1.0, 0, 0], (sections, 1)), np.tile([0, 1.0, 0], (sections, 1))
        self.start = self.points(centres, d1, d2)
        speed = np.outer(angular_speed * (height - self.spacing), [1, 0, 0])
        turning = np.tile([0, 0, -angular_speed], (sections, 1))
        for part in (speed, turning):
            part[0] = 0
        self.start_velocity = self.points(speed, turning, np.zeros((sections, 3)))
        q = self.start.reshape(-1, 3)
        super().__init__(masses, pairs, np.array([np.linalg.norm(q[i] - q[j]) for i, j in pairs]))
        # Of the node constraints no length is known; they have no dimension and are compared with 1.
        self.lengths = np.concatenate([self.lengths, np.ones(3 * (sections - 1))])

    def points(self, z: Array, d1: Array, d2: Array) -> Array:
        """Flat positions (or velocities) of the points of sections with centres z and directors d1, d2."""
        a, b = self.offsets
        return np.stack([z + a * d1, z + b * d2, z - a * d1 - b * d2], axis=1).ravel()

    def frames(self, q: Array) -> tuple[Array, Array, Array]:
        """Centres and directors."""
        points = q.reshape(*q.shape[:-1], -1, 3, 3)
        z = points.mean(axis=-2)
        return z, (points[..., 0, :] - z) / self.offsets[0], (points[..., 1, :] - z) / self.offsets[1]

    def nodes(self, q: Array) -> tuple[Array, ...]:
        """Between neighbours: the derivative of the centres, means and derivatives of the directors."""
        means = [(x[..., 1:, :] + x[..., :-1, :]) / 2 for x in self.frames(q)[1:]]
        return *means, *((x[..., 1:, :] - x[..., :-1, :]) / self.spacing for x in self.frames(q))

    # ---- constraints: |q_i - q_j|^2 - L^2 section by section, then the three components of each node

    def g(self, q: Array) -> Array:
        r = (q @ self.difference.T).reshape(*q.shape[:-1], -1, 3)
        m1, m2, slope, _, _ = self.nodes(q)
        distances = np.sum(r * r, axis=-1) - self.lengths[: r.shape[-2]] ** 2
        node = (slope - np.cross(m1, m2)).reshape(*q.shape[:-1], -1)
        return np.concatenate([distances, node], axis=-1)

    def jacobian(self, q: Array) -> Array:
        return gradient_of(self.g, q)

    def velocity_jacobian(self, q: Array, v: Array) -> Array:
        return self.jacobian(v) - self.jacobian(np.zeros_like(v))

    def second(self, q: Array, v: Array) -> Array:
        """g''(v,v): every constraint is a polynomial of degree two, so this is exact."""
        zero = np.zeros_like(v)
        return self.g(v) - 2 * self.g(zero) + self.g(-v)

    # ---- potential

    def strains(self, q: Array) -> Array:
        """u1, u2, u3 of each node, in the last axis but one."""
        m1, m2, _, e1, e2 = self.nodes(q)
        normal = np.cross(m1, m2)
        products = (normal * e2, -normal * e1, m2 * e1)
        return np.stack([np.sum(x, axis=-1) for x in products], axis=-2)

    def distances(self, q: Array) -> Array:
        """Of the centres from the two walls, the clamped section left out."""
        x = self.frames(q)[0][..., 1:, 0]
        return np.concatenate([self.wall - x, self.wall + x], axis=-1)

    def energy(self, q: Array) -> Array:
        ratio = (self.diameter / self.distances(q)) ** 6
        elastic = self.spacing / 2 * np.sum(self.stiffness @ self.strains(q) ** 2, axis=-1)
        return elastic + 4 * self.depth * np.sum(ratio**2 - ratio, axis=-1)

    def potential(self, q: Array) -> tuple[float, Array]:
        return float(self.energy(q)), gradient_of(self.energy, q)

    def total_energy(self, q: Array, v: Array) -> float:
        return float(np.sum(self.m3 * v * v)) / 2 + float(self.energy(q))

    def nearness(self, q: Array, exponent: float) -> float:
        """U3 of (5.2): the largest D^-exponent."""
        return float(np.max(1 / self.distances(q)) ** exponent)
