# OpenMM-VRATTLE: an independent statement of the method in dense NumPy algebra, and the models that tests run.
# SPDX-License-Identifier: MIT

"""The formulas of VRATTLE written down once more, as plainly as possible, to hold the plugin against.

Nothing here is fast and nothing is shared with the plugin: full matrices, no clusters, no reuse of factorisations.
Vectors are flat arrays of length 3N in OpenMM's units (nm, ps, amu, kJ/mol). Equation numbers are those of E. Barth,
B. Leimkuhler and S. Reich, SIAM J. Sci. Comput. 21 (1999) 1027.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
# Maps positions (3N) to the potential energy and its gradient (3N).
Potential = Callable[[Array], tuple[float, Array]]

SEMI_EXPLICIT, EXPLICIT, BOUNDED = "SemiExplicit", "Explicit", "Bounded"
UPDATES = (SEMI_EXPLICIT, EXPLICIT, BOUNDED)
KINDS = (
    "ConstraintMultipliers",
    "ConstraintForce",
    "AppliedForce",
    "ConstraintAndAppliedForce",
    "MultiplierPNorm",
    "ForcePNorm",
    "VectorField",
    "MaxForce",
    "ArcLength",
    "MaxParticleArcLength",
    "ForceGroupEnergy",
)


@dataclass
class GeneralConstraint:
    """A constraint g = 0 as the plugin gets it, and once more in NumPy.

    value and gradient take the positions of the particles (n x 3), which may be complex: derivatives along a direction
    v are the imaginary part at q + i 1e-30 v, exact to rounding.
    """

    expression: str
    particles: list[int]
    parameters: dict[str, float]
    value: Callable[[Any], Any]
    gradient: Callable[[Any], Any]


class DenseConstraints:
    """Distance constraints g_k = |q_i - q_j|^2 - L_k^2 between particles with masses, and general ones behind them."""

    def __init__(
        self,
        masses: Sequence[float] | Array,
        pairs: Sequence[tuple[int, int]],
        lengths: Array,
        general: Sequence[GeneralConstraint] = (),
    ) -> None:
        self.general = list(general)
        self.masses = np.asarray(masses, dtype=float)
        self.pairs = [(int(i), int(j)) for i, j in pairs]
        self.lengths = np.asarray(lengths, dtype=float)
        self.m3 = np.repeat(self.masses, 3)
        self.w3 = np.where(self.m3 > 0, 1 / np.where(self.m3 > 0, self.m3, 1), 0.0)
        # D maps a flat vector x to the stacked differences x_i - x_j, one block of three rows for each constraint.
        self.difference = np.zeros((3 * len(self.pairs), self.m3.size))
        for k, (i, j) in enumerate(self.pairs):
            for axis in range(3):
                self.difference[3 * k + axis, 3 * i + axis] = 1
                self.difference[3 * k + axis, 3 * j + axis] = -1

    def separations(self, x: Array) -> Array:
        return (self.difference @ x).reshape(-1, 3)

    def g(self, q: Array) -> Array:
        distances = np.sum(self.separations(q) ** 2, axis=1) - self.lengths**2
        return np.concatenate([distances, [c.value(q.reshape(-1, 3)[c.particles]) for c in self.general]])

    def _general_rows(self, gradients: list[Array]) -> Array:
        """The rows of the general constraints, from the derivatives by their own particles; 0 for anchors."""
        rows = np.zeros((len(self.general), self.masses.size, 3))
        for row, c, gradient in zip(rows, self.general, gradients, strict=True):
            row[c.particles] = gradient
        rows[:, self.masses == 0] = 0
        return rows.reshape(len(self.general), self.m3.size)

    def _distance_jacobian(self, x: Array) -> Array:
        r = self.separations(x)
        return 2 * np.einsum("ka,kan->kn", r, self.difference.reshape(len(self.pairs), 3, -1))

    def jacobian(self, q: Array) -> Array:
        """G = dg/dq."""
        gradients = [c.gradient(q.reshape(-1, 3)[c.particles]) for c in self.general]
        return np.concatenate([self._distance_jacobian(q), self._general_rows(gradients)])

    def velocity_jacobian(self, q: Array, v: Array) -> Array:
        """G(v), with the rows (d^2g/dq^2 v)^T: half the derivative of g''(v,v) with respect to v."""
        shifted = q + 1e-30j * v
        gradients = [c.gradient(shifted.reshape(-1, 3)[c.particles]).imag / 1e-30 for c in self.general]
        return np.concatenate([self._distance_jacobian(v), self._general_rows(gradients)])

    def second(self, q: Array, v: Array) -> Array:
        """g''(v,v)."""
        return self.velocity_jacobian(q, v) @ v

    def sizes(self) -> Array:
        """What values of g are to be compared with."""
        return np.concatenate([2 * self.lengths**2, np.full(len(self.general), 0.1)])

    def matrix(self, q: Array) -> Array:
        """K = G M^-1 G^T."""
        jacobian = self.jacobian(q)
        return (jacobian * self.w3) @ jacobian.T

    def multipliers(self, q: Array, p: Array, gradient: Array) -> Array:
        """Lambda(q,p) of (4.3); p need not be tangent."""
        right = self.second(q, self.w3 * p) - self.jacobian(q) @ (self.w3 * gradient)
        return np.linalg.solve(self.matrix(q), right)

    def relative_errors(self, q: Array) -> Array:
        """(|r| - L)/L of each distance; of a general constraint how far it is from zero, g/|dg/dq|, over 0.1 nm."""
        distances = np.linalg.norm(self.separations(q), axis=1) / self.lengths - 1
        rows = self.jacobian(q)[len(self.pairs) :]
        return np.concatenate([distances, self.g(q)[len(self.pairs) :] / np.linalg.norm(rows, axis=1) / 0.1])

    def tangent(self, q: Array, p: Array) -> Array:
        """The momentum p - G^T mu with G M^-1 p = 0, the nearest in the mass-weighted norm."""
        jacobian = self.jacobian(q)
        return p - jacobian.T @ np.linalg.solve(self.matrix(q), jacobian @ (self.w3 * p))

    def norm(self, p: Array) -> float:
        """|M^-1/2 p|, the norm of momenta and forces in which masses from 1 to 1e15 can be compared."""
        return float(np.linalg.norm(np.sqrt(self.w3) * p))

    def outside_range(self, q: Array, p: Array) -> float:
        """The mass-weighted norm of the part of p that is not in the range of G(q)^T: 0 if p = G^T x for some x."""
        basis = np.sqrt(self.w3)[:, None] * self.jacobian(q).T
        scaled = np.sqrt(self.w3) * p
        x = np.linalg.lstsq(basis, scaled, rcond=None)[0]
        return float(np.linalg.norm(scaled - basis @ x))


def monitor(
    kind: str, c: DenseConstraints, q: Array, p: Array, gradient: Array, order: float = 8.0, energy: float = 0.0
) -> tuple[float, Array]:
    """A monitor U(q,p) and dU/dp. energy is that of the monitor's force group, for ForceGroupEnergy."""
    v = c.w3 * p
    zero = np.zeros_like(p)
    per_particle = np.linalg.norm(gradient.reshape(-1, 3), axis=1)
    if kind in ("ConstraintMultipliers", "ConstraintForce", "ConstraintAndAppliedForce", "MultiplierPNorm"):
        lam = c.multipliers(q, p, gradient)
        k = c.matrix(q)
        # dLambda/dp = 2 K^-1 G(v) M^-1; transposed and applied to x:
        back = 2 * c.w3[:, None] * c.velocity_jacobian(q, v).T
        if kind == "ConstraintMultipliers":
            u = float(np.linalg.norm(lam))
            return u, back @ np.linalg.solve(k, lam) / u
        if kind == "MultiplierPNorm":
            scale = float(np.max(np.abs(lam)))
            u = scale * float(np.sum((np.abs(lam) / scale) ** order) ** (1 / order))
            return u, back @ np.linalg.solve(k, np.sign(lam) * (np.abs(lam) / u) ** (order - 1))
        applied = float(np.sum(c.w3 * gradient**2)) if kind == "ConstraintAndAppliedForce" else 0.0
        u = float(np.sqrt(lam @ k @ lam + applied))
        return u, back @ lam / u
    if kind == "AppliedForce":
        return float(np.sqrt(np.sum(c.w3 * gradient**2))), zero
    if kind == "ForcePNorm":
        scale = float(np.max(per_particle))
        return scale * float(np.sum((per_particle / scale) ** order) ** (1 / order)), zero
    if kind == "VectorField":
        u = float(np.sqrt(p @ v + gradient @ gradient))
        return u, v / u
    if kind == "MaxForce":
        return float(np.max(per_particle)), zero
    if kind == "ArcLength":
        u = float(np.sqrt(v @ v + gradient @ gradient))
        return u, c.w3 * v / u
    if kind == "MaxParticleArcLength":
        each = np.sqrt(np.sum(v.reshape(-1, 3) ** 2, axis=1) + per_particle**2)
        worst = int(np.argmax(each))
        result = zero.copy()
        part = slice(3 * worst, 3 * worst + 3)
        result[part] = c.w3[part] * v[part] / each[worst]
        return float(each[worst]), result
    if kind == "ForceGroupEnergy":
        return energy, zero
    raise ValueError(kind)


@dataclass
class Control:
    """The step control: nominal step h, bounds (0: none), recursion, monitors as (kind, weight, power), references."""

    nominal: float
    minimum: float = -1.0
    maximum: float = -1.0
    update: str = SEMI_EXPLICIT
    monitors: list[tuple[str, float, float]] = field(default_factory=lambda: [("ConstraintMultipliers", 1.0, 1.0)])
    references: list[float] = field(default_factory=list)
    order: float = 8.0

    def __post_init__(self) -> None:
        # A negative bound stands for the default.
        self.minimum = self.nominal / 50 if self.minimum < 0 else self.minimum
        self.maximum = 2 * self.nominal if self.maximum < 0 else self.maximum

    @property
    def a(self) -> float:
        return self.nominal / self.maximum if self.maximum > 0 else 0.0

    @property
    def b(self) -> float:
        return self.nominal / self.minimum if self.minimum > 0 else np.inf

    def mobius(self, u: float) -> tuple[float, float]:
        """B(u) and B'(u): the Moebius function through (0, a), (1, 1), (infinity, b)."""
        a = min(4 * self.a / 3, (1 + 2 * self.a) / 3) if self.update == BOUNDED else self.a
        if np.isinf(self.b):
            return a + (1 - a) * u, 1 - a
        k = (1 - a) / (self.b - 1)
        return (a + self.b * k * u) / (1 + k * u), k * (self.b - a) / (1 + k * u) ** 2

    def f(self, rho: float) -> float:
        return (rho - self.a) - (1 - self.a) ** 2 / (rho - self.a)

    def f_inverse(self, y: float) -> float:
        s = 1 - self.a
        root = np.hypot(y, 2 * s)
        return float(self.a + ((y + root) / 2 if y > 0 else 2 * s * s / (root - y)))

    def u(self, c: DenseConstraints, q: Array, p: Array, gradient: Array, energy: float = 0.0) -> tuple[float, Array]:
        """u = B(sqrt(sum (w (U/U_ref)^power)^2 / sum w^2)) and du/dp."""
        if not self.monitors:
            return 1.0, np.zeros_like(p)
        total, slope, weights = 0.0, np.zeros_like(p), 0.0
        for (kind, weight, power), reference in zip(self.monitors, self.references, strict=True):
            value, derivative = monitor(kind, c, q, p, gradient, self.order, energy)
            x = (value / reference) ** power
            total += (weight * x) ** 2
            slope += weight**2 * x * (power * x / value) * derivative
            weights += weight**2
        combined = np.sqrt(total / weights)
        value, factor = self.mobius(float(combined))
        return value, factor * slope / (weights * combined)

    def density_residual(self, rho: float, rho_before: float, u_after: float, u_before: float, u_on: float) -> float:
        """What is left of (3.14), (3.15) or the bounded recursion; u at (q,p+), (q,p-) and (q,p)."""
        if self.update == SEMI_EXPLICIT:
            return rho + rho_before - u_after - u_before
        if self.update == EXPLICIT:
            return rho + rho_before - 2 * u_on
        return self.f(rho) + self.f(rho_before) - 2 * self.f(u_on)


class DenseStepper:
    """VRATTLE by the full Newton iteration: (3.9) to (3.15), one step after the other."""

    def __init__(
        self,
        constraints: DenseConstraints,
        potential: Potential,
        control: Control,
        q: Array,
        p: Array,
        tolerance: float = 1e-13,
    ) -> None:
        self.c, self.potential, self.control, self.tolerance = constraints, potential, control, tolerance
        self.q, self.p = np.array(q, dtype=float), np.array(p, dtype=float)
        self.energy, self.gradient = potential(self.q)
        self.time, self.iterations, self.last_step = 0.0, 0, 0.0
        self.rho = 1.0
        self.p_half = np.empty(0)

    def set_half(self, rho_before: float) -> None:
        """p[-1/2] that belongs to (q,p) at rest of the recursion and rho[-1/2]."""
        lam = self.c.multipliers(self.q, self.p, self.gradient)
        self.rho = rho_before
        force = self.gradient + self.c.jacobian(self.q).T @ lam
        self.p_half = self.p + self.control.nominal / (2 * rho_before) * force

    def _fixed_neighbour(self, sign: float, step: float) -> tuple[Array, Array, Array]:
        """The state one plain RATTLE step away, forward or backward in time."""
        other = DenseStepper(
            self.c, self.potential, Control(step, 0, 0, EXPLICIT, []), self.q, sign * self.p, self.tolerance
        )
        other.set_half(1.0)
        other.step()
        return other.q, other.p, other.gradient

    def start(self) -> None:
        """Take references that are not given from the first step and start rho without oscillation."""
        h = self.control.nominal
        if not self.control.references and self.control.monitors:
            states = [self._fixed_neighbour(s, h) for s in (1.0, -1.0)] + [(self.q, self.p, self.gradient)]
            for kind, _, _ in self.control.monitors:
                after, before, now = (monitor(kind, self.c, x, y, z, self.control.order)[0] for x, y, z in states)
                self.control.references.append(now + (after - before) / 4)
        here = self.control.u(self.c, self.q, self.p, self.gradient)[0]
        after = self.control.u(self.c, *self._fixed_neighbour(1.0, h / here))[0]
        before = self.control.u(self.c, *self._fixed_neighbour(-1.0, h / here))[0]
        self.set_half(here - (after - before) / 4)

    def solve(self) -> tuple[Array, Array, float]:
        """q[n+1], p[n+1/2] and rho[n+1/2]: (3.9) to (3.11) together with the recursion."""
        c, control, h = self.c, self.control, self.control.nominal
        q, gradient, before = self.q, self.gradient, self.rho
        jacobian = c.jacobian(q)
        lam = c.multipliers(q, self.p, gradient)
        u_before = control.u(c, q, self.p_half, gradient)[0]
        u_on = control.u(c, q, self.p, gradient)[0]
        coupled = control.update == SEMI_EXPLICIT and bool(control.monitors)
        if control.update == BOUNDED:
            rho = control.f_inverse(2 * control.f(u_on) - control.f(before))
        else:
            rho = 2 * u_on - before
        if rho <= 0:
            raise ArithmeticError("no positive density")
        for _ in range(50):
            self.iterations += 1
            impulse = gradient + jacobian.T @ lam
            step_c = h / 2 * (1 / before + 1 / rho)
            p = self.p_half - step_c * impulse
            q_new = q + h / rho * c.w3 * p
            g = c.g(q_new)
            p_rho = h / (2 * rho**2) * impulse
            u, u_p = control.u(c, q, p, gradient)
            rest = rho + before - u - u_before if coupled else 0.0
            if np.all(np.abs(g) < self.tolerance * c.sizes()) and abs(rest) < self.tolerance * rho:
                break
            new_jacobian = c.jacobian(q_new)
            a_matrix = -h * step_c / rho * (new_jacobian * c.w3) @ jacobian.T
            if coupled:
                b = new_jacobian @ (c.w3 * (-h / rho**2 * p + h / rho * p_rho))
                x1, x2 = np.linalg.solve(a_matrix, np.stack([-g, b], axis=1)).T
                row = step_c * jacobian @ u_p
                delta = (-rest - row @ x1) / (1 - u_p @ p_rho - row @ x2)
                lam, rho = lam + x1 - x2 * delta, rho + delta
            else:
                lam = lam + np.linalg.solve(a_matrix, -g)
            if not np.isfinite(rho) or rho <= 0:
                raise ArithmeticError("no positive density")
        else:
            raise ArithmeticError("Newton's iteration did not converge")
        return q_new, p, rho

    def step(self) -> None:
        self.q, self.p_half, self.rho = self.solve()
        self.last_step = self.control.nominal / self.rho
        self.energy, self.gradient = self.potential(self.q)
        self.p = self.c.tangent(self.q, self.p_half - self.last_step / 2 * self.gradient)
        self.time += self.last_step

    def reverse(self) -> None:
        """Turn time around: what would have been (n+1/2) becomes (n-1/2), with the opposite momentum."""
        _, p_half, self.rho = self.solve()
        self.p_half, self.p = -p_half, -self.p

    def total_energy(self) -> float:
        return self.energy + float(np.sum(self.c.w3 * self.p**2)) / 2


def runge_kutta(
    c: DenseConstraints, potential: Potential, q: Array, p: Array, time: float, steps: int
) -> tuple[Array, Array]:
    """The continuous flow dq = M^-1 p, dp = F - G^T Lambda(q,p), by the classical method of order four."""

    def slope(x: Array, y: Array) -> tuple[Array, Array]:
        gradient = potential(x)[1]
        return c.w3 * y, -gradient - c.jacobian(x).T @ c.multipliers(x, y, gradient)

    h = time / steps
    for _ in range(steps):
        q1, p1 = slope(q, p)
        q2, p2 = slope(q + h / 2 * q1, p + h / 2 * p1)
        q3, p3 = slope(q + h / 2 * q2, p + h / 2 * p2)
        q4, p4 = slope(q + h * q3, p + h * p3)
        q, p = q + h / 6 * (q1 + 2 * q2 + 2 * q3 + q4), p + h / 6 * (p1 + 2 * p2 + 2 * p3 + p4)
    return q, p


@dataclass
class Model:
    """Something to integrate: masses, distance constraints, a start that satisfies them, and the forces in OpenMM."""

    name: str
    masses: Array
    pairs: list[tuple[int, int]]
    lengths: Array
    positions: Array
    velocities: Array
    step: float
    add_forces: Callable[[Any], None]
    general: list[GeneralConstraint] = field(default_factory=list)

    def constraints(self) -> DenseConstraints:
        return DenseConstraints(self.masses, self.pairs, self.lengths, self.general)

    def constrain(self, integrator: Any) -> None:
        """Give an integrator the constraints that a System cannot have."""
        for c in self.general:
            integrator.addConstraint(c.expression, c.particles, c.parameters)

    def system(self) -> Any:
        import openmm

        system = openmm.System()
        for mass in self.masses:
            system.addParticle(float(mass))
        for (i, j), length in zip(self.pairs, self.lengths, strict=True):
            system.addConstraint(i, j, float(length))
        self.add_forces(system)
        return system

    def potential(self) -> Potential:
        """The potential of the OpenMM system, computed by OpenMM in a Context of its own in double precision."""
        import openmm

        system = self.system()
        context = openmm.Context(system, openmm.VerletIntegrator(0.001), openmm.Platform.getPlatformByName("Reference"))

        def evaluate(q: Array) -> tuple[float, Array]:
            context.setPositions(q.reshape(-1, 3))
            state = context.getState(energy=True, forces=True)
            return state.getPotentialEnergy()._value, -state.getForces(asNumpy=True)._value.ravel()

        return evaluate


def value(x: Any) -> float:
    """A number in OpenMM's units, whether or not it comes with a unit."""
    import openmm.unit

    return float(x.value_in_unit_system(openmm.unit.md_unit_system) if openmm.unit.is_quantity(x) else x)


def open_context(system: Any, integrator: Any, platform: str, model: Model | None = None) -> Any:
    """A Context in the state of a model. On CPU one thread and forces summed in a fixed order, to be reproducible."""
    import openmm

    properties = {"Threads": "1", "DeterministicForces": "true"} if platform == "CPU" else {}
    context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName(platform), properties)
    if model is not None:
        context.setPositions(model.positions)
        context.setVelocities(model.velocities)
    return context


def positions_of(context: Any) -> Array:
    """Positions (N x 3) in nm."""
    return context.getState(positions=True).getPositions(asNumpy=True)._value


def velocities_of(context: Any) -> Array:
    """Velocities (N x 3) in nm/ps."""
    return context.getState(velocities=True).getVelocities(asNumpy=True)._value


def energy_of(context: Any) -> float:
    """Kinetic plus potential energy in kJ/mol."""
    state = context.getState(energy=True)
    return state.getKineticEnergy()._value + state.getPotentialEnergy()._value


def time_of(context: Any) -> float:
    """The Context's time in ps."""
    return context.getTime()._value


def thermal_velocities(c: DenseConstraints, q: Array, temperature: float, seed: int) -> Array:
    """Maxwell-Boltzmann velocities (N x 3) made tangent to the constraints, with no total momentum."""
    kt = 0.00831446261815324 * temperature
    v = np.random.default_rng(seed).normal(size=q.size) * np.sqrt(kt * c.w3)
    mean = np.sum(c.masses[:, None] * v.reshape(-1, 3), axis=0) / np.sum(c.masses)
    p = c.m3 * (v - np.tile(mean, c.masses.size))
    return (c.w3 * c.tangent(q, p)).reshape(-1, 3)


def double_pendulum(inner: float = 1.0, outer: float = 1000.0, angles: tuple[float, float] = (2.2, 0.5)) -> Model:
    """A pivot of mass 1e15 at the origin, two bobs on rods of 1 nm, gravity 1 nm/ps^2."""
    import openmm

    first = np.array([np.sin(angles[0]), -np.cos(angles[0]), 0.0])
    second = first + np.array([np.sin(angles[1]), -np.cos(angles[1]), 0.0])

    def gravity(system: Any) -> None:
        force = openmm.CustomExternalForce("w*y")
        force.addPerParticleParameter("w")
        force.addParticle(1, [inner])
        force.addParticle(2, [outer])
        system.addForce(force)

    return Model(
        "pendulum",
        np.array([1e15, inner, outer]),
        [(0, 1), (1, 2)],
        np.ones(2),
        np.stack([np.zeros(3), first, second]),
        np.zeros((3, 3)),
        0.01,
        gravity,
    )


def pendulum_potential(model: Model) -> Potential:
    """The pendulum's gravity in NumPy."""
    weight = np.zeros(9)
    weight[[4, 7]] = model.masses[1:]
    return lambda q: (float(weight @ q), weight)


def pendulum_at(time: float, inner: float, outer: float, steps: int = 16000) -> tuple[Array, Array]:
    """Positions and velocities of double_pendulum(inner, outer), by the classical method of order four.

    From Lagrange's equations for its two angles, which know of no constraint.
    """
    sin, cos = math.sin, math.cos

    def slope(a: float, b: float, va: float, vb: float) -> tuple[float, float, float, float]:
        s, c = sin(a - b), cos(a - b)
        first = -outer * s * vb * vb - (inner + outer) * sin(a)
        second = s * va * va - sin(b)
        pull = (first - outer * c * second) / (inner + outer * s * s)
        return va, vb, pull, second - c * pull

    state, h = (2.2, 0.5, 0.0, 0.0), time / steps
    for _ in range(steps):
        k1 = slope(*state)
        k2 = slope(*(x + h / 2 * k for x, k in zip(state, k1, strict=True)))
        k3 = slope(*(x + h / 2 * k for x, k in zip(state, k2, strict=True)))
        k4 = slope(*(x + h * k for x, k in zip(state, k3, strict=True)))
        state = tuple(x + h / 6 * (p + 2 * q + 2 * r + t) for x, p, q, r, t in zip(state, k1, k2, k3, k4, strict=True))
    a, b, va, vb = state
    bobs = np.array([[sin(a), -cos(a), 0], [sin(b), -cos(b), 0]])
    motions = np.array([[va * cos(a), va * sin(a), 0], [vb * cos(b), vb * sin(b), 0]])
    return np.vstack([np.zeros(3), np.cumsum(bobs, axis=0)]), np.vstack([np.zeros(3), np.cumsum(motions, axis=0)])


def chain() -> Model:
    """Eight masses from 1 to 150 amu in a crooked chain, stiff angles, Lennard-Jones between distant members."""
    import openmm

    rng = np.random.default_rng(7)
    masses = np.exp(rng.uniform(np.log(1.0), np.log(150.0), 8))
    masses[2], masses[5] = 1.0, 150.0
    lengths = rng.uniform(0.1, 0.2, 7)
    positions = [np.zeros(3)]
    while len(positions) < 8:
        direction = rng.normal(size=3)
        trial = positions[-1] + lengths[len(positions) - 1] * direction / np.linalg.norm(direction)
        # No bend sharper than a right angle and nobody nearer than 0.2 nm but the neighbours.
        if all(np.linalg.norm(trial - other) > 0.2 for other in positions[:-1]):
            positions.append(trial)
    q = np.array(positions)

    def forces(system: Any) -> None:
        angle = openmm.HarmonicAngleForce()
        for i in range(6):
            angle.addAngle(i, i + 1, i + 2, 1.9, 100.0)
        system.addForce(angle)
        pair = openmm.CustomBondForce("4*2*((0.2/r)^12-(0.2/r)^6)")
        for i in range(8):
            for j in range(i + 3, 8):
                pair.addBond(i, j, [])
        system.addForce(pair)

    pairs = [(i, i + 1) for i in range(7)]
    velocities = thermal_velocities(DenseConstraints(masses, pairs, lengths), q.ravel(), 300.0, 8)
    return Model("chain", masses, pairs, lengths, q, velocities, 0.001, forces)


def _angle_gradient(x: Any) -> Any:
    """The derivative of the cosine of the angle at the second of three particles."""
    a, b = x[0] - x[1], x[2] - x[1]
    aa, bb, ab = np.sum(a * a), np.sum(b * b), np.sum(a * b)
    first = b / np.sqrt(aa * bb) - ab / np.sqrt(aa * bb) * a / aa
    last = a / np.sqrt(aa * bb) - ab / np.sqrt(aa * bb) * b / bb
    return np.stack([first, -first - last, last])


def _distance_gradient(x: Any) -> Any:
    r = x[0] - x[1]
    unit = r / np.sqrt(np.sum(r * r))
    return np.stack([unit, -unit])


def general() -> Model:
    """A chain of four with a fixed angle, whose last member is on a sphere about a particle without mass; a fifth
    coupled to the others by a plane between them and by a surface that is curved every way."""
    import openmm

    q = np.array(
        [[0, 0.1, 0], [0.11, 0.02, 0.01], [0.2, 0.12, 0], [0.33, 0.08, 0.05], [0.4, 0.2, 0.1], [0.1, 0.3, 0.2]]
    )
    masses = np.array([12.0, 1.0, 16.0, 14.0, 0.0, 32.0])
    pairs = [(0, 1), (1, 2), (2, 3)]
    lengths = np.array([np.linalg.norm(q[i] - q[j]) for i, j in pairs])

    def cosine(x: Any) -> Any:
        a, b = x[0] - x[1], x[2] - x[1]
        return np.sum(a * b) / np.sqrt(np.sum(a * a) * np.sum(b * b))

    def distance(x: Any) -> Any:
        return np.sqrt(np.sum((x[0] - x[1]) ** 2))

    def surface(x: Any) -> Any:
        return np.sin(3 * x[0, 0]) * x[1, 1] + x[0, 2] * x[1, 2] ** 2 + 0.7 * x[1, 0] + np.exp(x[0, 1])

    def surface_gradient(x: Any) -> Any:
        first = [3 * np.cos(3 * x[0, 0]) * x[1, 1], np.exp(x[0, 1]), x[1, 2] ** 2]
        return np.array([first, [0.7, np.sin(3 * x[0, 0]), 2 * x[0, 2] * x[1, 2]]])

    def plane(x: Any) -> Any:
        return 0.3 * x[0, 0] + 0.7 * x[1, 0]

    angle, radius, level, height = cosine(q[[0, 1, 2]]), distance(q[[4, 3]]), surface(q[[5, 0]]), plane(q[[2, 5]])
    constraints = [
        GeneralConstraint(
            "(ax*bx+ay*by+az*bz)/sqrt((ax^2+ay^2+az^2)*(bx^2+by^2+bz^2))-cosine;"
            "ax=x1-x2; ay=y1-y2; az=z1-z2; bx=x3-x2; by=y3-y2; bz=z3-z2",
            [0, 1, 2],
            {"cosine": angle},
            lambda x: cosine(x) - angle,
            _angle_gradient,
        ),
        GeneralConstraint(
            "sqrt((x1-x2)^2+(y1-y2)^2+(z1-z2)^2)-r",
            [4, 3],
            {"r": radius},
            lambda x: distance(x) - radius,
            _distance_gradient,
        ),
        GeneralConstraint(
            "sin(3*x1)*y2+z1*z2^2+k*x2+exp(y1)-level",
            [5, 0],
            {"level": level, "k": 0.7},
            lambda x: surface(x) - level,
            surface_gradient,
        ),
        GeneralConstraint(
            "w*x1+(1-w)*x2-height",
            [2, 5],
            {"w": 0.3, "height": height},
            lambda x: plane(x) - height,
            lambda x: np.array([[0.3, 0, 0], [0.7, 0, 0]]) + 0 * x,
        ),
    ]

    def forces(system: Any) -> None:
        bond = openmm.CustomBondForce("500*(r-0.3)^2+20*(r-0.3)^4")
        for i, j in ((0, 3), (1, 5), (3, 5), (2, 5)):
            bond.addBond(i, j, [])
        system.addForce(bond)

    c = DenseConstraints(masses, pairs, lengths, constraints)
    velocities = thermal_velocities(c, q.ravel(), 300.0, 13)
    return Model("general", masses, pairs, lengths, q, velocities, 0.001, forces, constraints)


def ring() -> Model:
    """A puckered ring of six: a closed loop of constraints, and springs across it."""
    import openmm

    angle = np.arange(6) * np.pi / 3
    q = np.stack([0.14 * np.cos(angle), 0.14 * np.sin(angle), 0.025 * (-1.0) ** np.arange(6)], axis=1)
    masses = np.array([12.0, 14.0, 1.0, 12.0, 32.0, 16.0])
    pairs = [(i, (i + 1) % 6) for i in range(6)]
    lengths = np.array([np.linalg.norm(q[i] - q[j]) for i, j in pairs])

    def forces(system: Any) -> None:
        bond = openmm.HarmonicBondForce()
        for i in range(3):
            bond.addBond(i, i + 3, 0.27, 20000.0)
        system.addForce(bond)

    velocities = thermal_velocities(DenseConstraints(masses, pairs, lengths), q.ravel(), 300.0, 9)
    return Model("ring", masses, pairs, lengths, q, velocities, 0.001, forces)


def waters(count: int = 2) -> Model:
    """count^3 rigid TIP3P-like waters on a lattice, Lennard-Jones and Coulomb without cutoff."""
    import openmm

    rng = np.random.default_rng(11)
    # OpenMM's SETTLE holds the distances to single precision, so choose numbers that have no more digits.
    oh, hh = float(np.float32(0.09572)), float(np.float32(0.15139))
    height = np.sqrt(oh**2 - hh**2 / 4)
    shape = np.array([[0, 0, 0], [hh / 2, height, 0], [-hh / 2, height, 0]])
    positions, masses, pairs, lengths = [], [], [], []
    for site in np.ndindex(count, count, count):
        rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        first = len(masses)
        positions.append(0.31 * np.array(site) + shape @ rotation.T)
        masses += [15.9994, 1.008, 1.008]
        pairs += [(first, first + 1), (first, first + 2), (first + 1, first + 2)]
        lengths += [oh, oh, hh]
    q = np.concatenate(positions)

    def forces(system: Any) -> None:
        force = openmm.NonbondedForce()
        for i in range(len(masses)):
            oxygen = i % 3 == 0
            force.addParticle(-0.834 if oxygen else 0.417, 0.315061 if oxygen else 1.0, 0.6364 if oxygen else 0.0)
        for i in range(0, len(masses), 3):
            for j, k in ((i, i + 1), (i, i + 2), (i + 1, i + 2)):
                force.addException(j, k, 0.0, 1.0, 0.0)
        system.addForce(force)

    velocities = thermal_velocities(DenseConstraints(masses, pairs, np.array(lengths)), q.ravel(), 300.0, 12)
    return Model("waters", np.array(masses), pairs, np.array(lengths), q, velocities, 0.001, forces)


def whip() -> Model:
    """Iodine - hydrogen - iodine, both bonds constrained and no force: the light middle is whipped about."""
    x, y = 0.13035287991719496, 0.094323574451424086
    vx, vy, vh = 0.13914834428899867, -0.00076072186030887707, 0.19153889697062798
    return Model(
        "whip",
        np.array([126.9, 1.008, 126.9]),
        [(0, 1), (1, 2)],
        np.array([0.1609, 0.1609]),
        np.array([[-x, 0, 0], [0, y, 0], [x, 0, 0]]),
        np.array([[vx, vy, 0], [0, vh, 0], [-vx, vy, 0]]),
        0.001,
        lambda system: None,
    )
