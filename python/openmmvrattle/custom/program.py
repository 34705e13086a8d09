# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""The computations of CustomVariableStepRattleIntegrator; docs/custom.md explains the method.

A `Program` is a list of steps for openmm.CustomIntegrator. Names of our variables are written ``$name`` here and become
``vrattle_name`` there, so that no parameter of a Force can have the same name. (``f0``, ``energy1`` and the like are
OpenMM's own: forces and energies of force groups.)
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field

import openmm

from .settings import BOUNDED, PREFIX, Monitor, Settings

MAXIMUM_PASSES = 30
"""How often the constraints are solved in search of one step density before the step is rescued."""
CHANGE = 1e-8
"""Squared relative change of positions, velocities and forces between two steps that counts as a change of the state.

Removing the motion of the centre of mass, or moving molecules back into the periodic box on a GPU, changes them by
rounding only.
"""

# The phases of the search for the next density: what the pass through the constraints is for.
SOLVE, REDEFINE, START_BACKWARD, START_FORWARD, PRESCRIBED = 0, 1, 2, 3, 4


@dataclass
class Program:
    """What a CustomIntegrator consists of."""

    per_dof: list[str] = field(default_factory=list)
    variables: dict[str, float] = field(default_factory=dict)
    steps: list[tuple[str, ...]] = field(default_factory=list)

    def compute(self, variable: str, expression: str) -> None:
        self.steps.append(("addComputeGlobal", variable, expression))

    def per_particle(self, variable: str, expression: str) -> None:
        self.steps.append(("addComputePerDof", variable, expression))

    def sum(self, variable: str, expression: str) -> None:
        self.steps.append(("addComputeSum", variable, expression))

    def constrain_positions(self) -> None:
        self.steps.append(("addConstrainPositions",))

    def constrain_velocities(self) -> None:
        self.steps.append(("addConstrainVelocities",))

    def update_context_state(self) -> None:
        self.steps.append(("addUpdateContextState",))

    def changes(self, variable: str) -> bool:
        """Whether a step changes a global variable."""
        return any(
            step[:2] in {("addComputeGlobal", f"${variable}"), ("addComputeSum", f"${variable}")} for step in self.steps
        )

    @contextmanager
    def block(self, condition: str, kind: str = "beginIfBlock") -> Iterator[None]:
        """Steps that are taken if a condition holds."""
        self.steps.append((kind, condition))
        yield
        self.steps.append(("endBlock",))

    def loop(self, condition: str) -> AbstractContextManager[None]:
        """Steps that are repeated while a condition holds."""
        return self.block(condition, "beginWhileBlock")

    def make(self, step_size: float, others: dict[str, float] | None = None) -> openmm.CustomIntegrator:
        """A CustomIntegrator with this program, and with other global variables besides its own."""
        integrator = openmm.CustomIntegrator(step_size)
        for name, value in (self.variables | (others or {})).items():
            integrator.addGlobalVariable(PREFIX + name, value)
        for name in self.per_dof:
            integrator.addPerDofVariable(PREFIX + name, 0.0)
        for method, *arguments in self.steps:
            getattr(integrator, method)(*(re.sub(r"\$(\w+)", PREFIX + r"\1", argument) for argument in arguments))
        return integrator


# The variables of a run besides the settings, with their values before the first step.
_RUN = {
    "clock": 0.0,  # the true time, ps
    "step": 0.0,  # the size of the last step, ps
    "density": 1.0,  # rho of the last step
    "started": 0.0,  # whether there is a last step
    "fresh": 0.0,  # whether the last step was a first one
    "entering": 0.0,  # set by step(): the user may have changed the state since the last step
    "changed": 0.0,  # positive if positions, velocities or forces differ from those after the last step
    "change": 0.0,  # whether u has changed since the last step, for that reason or because of new settings
    "lost": 0.0,  # whether the last step has led to something that is not finite; then no more are taken
    "skipped": 0.0,  # how many have not been taken for that reason
    "total": 0.0,  # finite if all is that the last step has led to
    "moved": 0.0,  # whether a step is under way: an exception then leaves the particles anywhere
    "pending": 0.0,  # 1: settings have changed; 2: only the backward constraint force is to be computed anew
    "prescribed": 0.0,  # density of the next step; 0 if it is to be found
    "known": 0.0,  # whether all reference values are known
    "solverTolerance": 1e-9,  # of the density, relative
    "evaluations": 0.0,
    "passes": 0.0,
    "rescues": 0.0,
    "phase": 0.0,
    "nextPhase": 0.0,
    "back": 0.0,  # whether a pass goes backwards in time
    "sigma": 1.0,
    "trial": 1.0,  # the density of a pass
    "iterate": 0.0,  # whether there is one more
    "count": 0.0,  # of passes in this step
    "solved": 0.0,  # those of them that search for the density
    "failed": 0.0,
    "target": 1.0,  # the density that the recursion gives for the u of a pass
    "residual": 0.0,
    "lastTrial": 0.0,
    "lastTarget": 0.0,
    "lastResidual": 0.0,
    "rate": 0.0,  # d target/d trial
    "uMinus": 0.0,  # u of the half steps before and after the current positions
    "uPlus": 0.0,
    "uOld": 0.0,
    "difference": 0.0,  # u+ - u- of the last step, and of the one before
    "differenceBefore": 0.0,
    "pass": 0.0,
    # Sums over the particles. The first three belong to half steps, the others to positions.
    "constraintMinus": 0.0,
    "constraintPlus": 0.0,
    "kineticMinus": 0.0,
    "kineticPlus": 0.0,
    "speedMinus": 0.0,
    "speedPlus": 0.0,
    "applied": 0.0,
    "forceSquared": 0.0,
    "norm": 0.0,
    "scale": 0.0,
    "energy": 0.0,
    "candidate": 0.0,  # a reference value that may be taken, and the rounding that it has to be above
    "rounding": 0.0,
    "applies": 0.0,  # whether the default monitor includes the applied force: where there are no constraints
}
KEPT = "kept_"
"""What begins the names of variables that hold, during a step, the values from before it."""
_OF_ONE_STEP = {
    *("entering", "fresh", "changed", "change", "known", "phase", "nextPhase", "back", "sigma", "trial", "iterate"),
    *("count", "solved", "failed", "target", "residual", "lastTrial", "lastTarget", "lastResidual", "uPlus", "uOld"),
    *("pass", "constraintPlus", "kineticPlus", "speedPlus", "candidate", "rounding", "applies", "scale"),
    *("lost", "skipped", "moved", "total", "prescribed", "solverTolerance"),
}
"""Variables of the run that no later step depends on."""


def make_program(settings: Settings) -> Program:
    """The program of an integrator with these settings."""
    program = Program(per_dof=["start", "startVelocity", "force", "velocity", "end"])
    program.variables = settings.globals() | _RUN | {"step": settings.nominal}
    for k, monitor in enumerate(settings.monitors):
        program.variables[f"reference{k}"] = monitor.reference
        # U at the start, its change over the half steps around it, and U at the next step: for the start of the
        # density.
        program.variables |= {f"mean{k}": 0.0, f"half{k}": 0.0, f"next{k}": 0.0}
    step = Program()
    _begin(step, settings)
    if settings.is_iterative:
        _solve(step, settings)
    else:
        _step_explicitly(step, settings)
    _finish(step, settings)
    references = [f"reference{k}" for k in range(len(settings.monitors))]
    kept = [name for name in [*_RUN, *references] if name not in _OF_ONE_STEP and step.changes(name)]
    program.variables |= {KEPT + name: 0.0 for name in kept}
    _notice_changes(program)
    with program.block("$lost > 0"):
        program.compute("$skipped", "$skipped + 1")
    with program.block("$lost <= 0"):
        _keep(program, kept)
        program.steps += step.steps
    return program


def _notice_changes(program: Program) -> None:
    """Notice changes of the state by the user or by a Force, and whether the last step has lost it."""
    velocity = "(v-$velocity)^2 + ($step*(f-$force)/m)^2"
    # On a GPU molecules are moved back into the periodic box now and then, by a length of the box: that is no change.
    position = "select(step(0.3 - abs(x-$end)), ((x-$end)/$step)^2, 0)"
    # The root is no number where a mass that Context.reinitialize() has brought is negative.
    difference = f"sqrt(step(m) - 0.5)*m*({velocity} + {position} - {CHANGE}*(v^2 + ($step*f/m)^2))"
    with program.block("$entering > 0"):
        # Before anything is changed: a force may raise an exception here.
        program.sum("$changed", difference)
        program.compute("$entering", "0")
        with program.block("$changed > 0"):
            program.compute("$started", "0")
            program.constrain_positions()
            program.constrain_velocities()
    program.update_context_state()
    program.sum("$changed", difference)
    # No comparison holds for what is not a number.
    program.compute("$lost", "1")
    with program.block("abs($changed) < 1e300"):
        program.compute("$lost", "0")


def _keep(program: Program, names: list[str]) -> None:
    """Keep what is needed to go back to the state before this step, and to repeat passes from it."""
    for name in names:
        program.compute(f"${KEPT}{name}", f"${name}")
    program.per_particle("$start", "x")
    program.per_particle("$startVelocity", "v")
    program.compute("$moved", "1")


def _begin(program: Program, settings: Settings) -> None:
    """The forces, and after a change of the state what depends on it."""
    program.compute("$change", "max(1 - $started, max(1 - step(-$changed), min($pending, 1)))")
    program.per_particle("$force", "f")
    with program.block("$change > 0"):
        program.constrain_velocities()
        program.per_particle("$startVelocity", "v")
        _energy(program, settings)
        _position_sums(program, settings, "$force")
        if not settings.is_iterative:
            _velocity_sums(program, settings)
    program.compute("$fresh", "1 - $started")
    known = [f"(1 - step(-$reference{k}))" for k in range(len(settings.monitors))]
    program.compute("$known", "*".join(known) or "1")
    program.compute("$uOld", "$uMinus")


def _energy(program: Program, settings: Settings) -> None:
    # Before anything that needs the forces: OpenMM keeps for the next step those that were computed last.
    if settings.uses("ForceGroupEnergy"):
        program.compute("$energy", f"energy{settings.group}")


def _position_sums(program: Program, settings: Settings, force: str) -> None:
    """Sums that depend on positions alone, with the forces in the variable `force`."""
    if settings.uses("AppliedForce", "ConstraintAndAppliedForce"):
        program.sum("$applied", f"{force}^2/m")
    elif settings.has_default:
        with program.block("$applies > 0"):
            program.sum("$applied", f"{force}^2/m")
    if settings.uses("VectorField", "ArcLength", "ForcePNorm"):
        program.sum("$forceSquared", f"{force}^2")
    if settings.uses("ForcePNorm"):
        # Each |F| relative to the norm of all: no power of it overflows, even in single precision. A function of
        # vectors
        # is summed over its three components, which are equal here.
        program.compute("$scale", "select($forceSquared, 1/$forceSquared, 0)")
        program.sum("$norm", f"(dot({force},{force})*$scale)^($normOrder/2)/3")


def _velocity_sums(program: Program, settings: Settings) -> None:
    """Sums of the velocities of the whole step, for updates that use u(q,p) of the whole step."""
    if settings.uses("VectorField"):
        program.sum("$kineticMinus", "m*v^2")
    if settings.uses("ArcLength"):
        program.sum("$speedMinus", "v^2")


def _raw(monitor: Monitor, which: str) -> str:
    """U of a monitor, from the sums of the half step before (Minus) or after (Plus)."""
    return {
        "ConstraintForce": f"sqrt($constraint{which}{' + $applies*$applied' if monitor.is_default else ''})",
        "AppliedForce": "sqrt($applied)",
        "ConstraintAndAppliedForce": f"sqrt($constraint{which} + $applied)",
        "ForcePNorm": "sqrt($forceSquared)*$norm^(1/$normOrder)",
        "VectorField": f"sqrt($kinetic{which} + $forceSquared)",
        "ArcLength": f"sqrt($speed{which} + $forceSquared)",
        "ForceGroupEnergy": "$energy",
    }[monitor.name]


def _u(settings: Settings, which: str) -> str:
    """u = B(U_rel) of docs/method.md, sections 5 and 6."""
    if not settings.monitors:
        return "1"
    # A monitor without a reference value asks for nothing.
    relative = [
        f"select($reference{k}, (({_raw(m, which)})/$reference{k})^$power{k}, 1)"
        for k, m in enumerate(settings.monitors)
    ]
    if len(relative) > 1:
        terms = " + ".join(f"($weight{k}*{each})^2" for k, each in enumerate(relative))
        weights = " + ".join(f"$weight{k}^2" for k in range(len(relative)))
        relative = [f"sqrt(({terms})/({weights}))"]
    return f"($boundOffset + $boundSlope*r)/(1 + $boundCurvature*r); r = {relative[0]}"


def _f(density: str) -> str:
    """The f of the update Bounded, docs/method.md, section 3, with a margin for densities that a sum update has
    left."""
    inside = f"(max({density} - $smallestDensity, 0.001*(1 - $smallestDensity)))"
    return f"({inside} - (1 - $smallestDensity)^2/{inside})"


def _bounded_density(right_side: str) -> str:
    """The density with f(density) = right_side: the positive root of a quadratic, without cancellation."""
    return (
        "$smallestDensity + select(step(y), (y + root)/2, 2*one^2/(root - y)); "
        f"root = sqrt(y^2 + 4*one^2); y = {right_side}; one = 1 - $smallestDensity"
    )


def _recursion(settings: Settings, u_plus: str, u_minus: str) -> str:
    """The next density from u of the two half steps, or twice the same u of the whole step."""
    if settings.update == BOUNDED:
        return _bounded_density(f"{_f(u_plus)} + {_f(u_minus)} - {_f('$density')}")
    return f"{u_plus} + {u_minus} - $density"


_RESCUE = f"2*{_f('$uMinus')} - {_f('$density')}"


def _lowest(settings: Settings) -> str:
    """The density below which a step is rescued: one of more than twice the maximum step, or beyond all measure."""
    return "0" if settings.update == BOUNDED else "max(0.5*$smallestDensity, 0.001*$density)"


def _drift(program: Program) -> None:
    """Positions after a step of density $trial, forwards (sigma 1) or backwards (sigma -1) from the stored state."""
    program.compute("$step", "$nominalStep/$trial")
    program.per_particle("x", "$start + $sigma*$step*v + 0.5*$step^2*$force/m")
    program.constrain_positions()
    program.compute("$passes", "$passes + 1")


def _step_explicitly(program: Program, settings: Settings) -> None:
    """A step whose density is known before the constraints are solved."""
    compute = program.compute
    with program.block("$prescribed > 0"):
        compute("$trial", "$prescribed")
    with program.block("$prescribed <= 0"):
        if not settings.monitors:
            compute("$trial", "1")
        else:
            with program.block("$change > 0"):
                compute("$uMinus", _u(settings, "Minus"))
                _scale_density(program)
            with program.block("$started > 0"):
                compute("$trial", _recursion(settings, "$uMinus", "$uMinus"))
                compute("$failed", f"1 - step($trial - {_lowest(settings)})")
                with program.block("$failed > 0"):
                    compute("$rescues", "$rescues + 1")
                    compute("$trial", _bounded_density(_RESCUE))
            with program.block("$started <= 0"):
                compute("$trial", "select($known, $uMinus, 1)")
    compute("$sigma", "1")
    _drift(program)


def _scale_density(program: Program) -> None:
    """Let the density follow a change of u, so that it starts no oscillation."""
    with program.block("$started > 0"):
        with program.block("$pending < 1.5"):
            program.compute("$density", "$density*$uMinus/$uOld")


def _solve(program: Program, settings: Settings) -> None:
    """Find the density together with the constraint force that belongs to it.

    Each pass repeats kick, drift and constraints from the stored state. OpenMM takes the positions that were
    constrained last as the reference of the next constraint, so between two passes the stored positions are
    constrained once.
    """
    compute = program.compute
    compute("$count", "0")
    compute("$solved", "0")
    compute("$iterate", "1")
    _first_pass(program, settings)
    with program.loop("$iterate > 0"):
        compute("$back", f"delta($phase - {REDEFINE}) + delta($phase - {START_BACKWARD})")
        compute("$sigma", "1 - 2*$back")
        _drift(program)
        compute("$count", "$count + 1")
        _half_step_sums(program, settings)
        compute("$uMinus", _u(settings, "Minus"))
        compute("$uPlus", _u(settings, "Plus"))
        _next_pass(program, settings)
        with program.block("$iterate > 0"):
            program.per_particle("x", "$start")
            program.constrain_positions()
    compute("$differenceBefore", "select($fresh, 0, $difference)")
    compute("$difference", "select($fresh, 0, $uPlus - $uMinus)")


def _first_pass(program: Program, settings: Settings) -> None:
    compute = program.compute
    compute("$phase", f"select($started, select($change, {REDEFINE}, {SOLVE}), {START_BACKWARD})")
    compute("$phase", f"select($prescribed, {PRESCRIBED}, $phase)")
    with program.block(f"$phase = {SOLVE}"):
        _guess(program, settings)
    with program.block(f"$phase = {REDEFINE}"):
        compute("$trial", "$density")
    with program.block(f"$phase = {START_BACKWARD}"):
        compute("$trial", "select($known, $startDensity, 1)")
    with program.block(f"$phase = {PRESCRIBED}"):
        compute("$trial", "$prescribed")


def _guess(program: Program, settings: Settings) -> None:
    """A first density from u of the half step before, and the changes of u over the last two steps."""
    program.compute("$uPlus", "max($uMinus + 2*$difference - $differenceBefore, 0.5*$uMinus)")
    program.compute("$target", _recursion(settings, "$uPlus", "$uMinus"))
    program.compute("$trial", "max($density/3, min(3*$density, $target))")


def _half_step_sums(program: Program, settings: Settings) -> None:
    """What the constraints did to the positions is the constraint force; sums of this pass go to its side."""
    sums = {}
    if settings.uses_constraint_force:
        drift = "$start - $sigma*$step*v - 0.5*$step^2*$force/m"
        sums["constraint"] = f"m*(2*(x - {drift})/$step^2)^2"
    if settings.uses("VectorField"):
        sums["kinetic"] = "m*((x - $start)/$step)^2"
    if settings.uses("ArcLength"):
        sums["speed"] = "((x - $start)/$step)^2"
    for name, expression in sums.items():
        program.sum("$pass", expression)
        program.compute(f"${name}Minus", f"select($back, $pass, ${name}Minus)")
        program.compute(f"${name}Plus", f"select($back, ${name}Plus, $pass)")


def _next_pass(program: Program, settings: Settings) -> None:
    """Decide whether the density is found, and if not, what the next pass is."""
    compute = program.compute
    compute("$nextPhase", "$phase")
    with program.block(f"$phase = {PRESCRIBED}"):
        compute("$iterate", "0")
    with program.block(f"$phase = {REDEFINE}"):
        _scale_density(program)
        _guess(program, settings)
        compute("$nextPhase", str(SOLVE))
    with program.block(f"$phase = {START_BACKWARD}"):
        compute("$nextPhase", str(START_FORWARD))
    with program.block(f"$phase = {START_FORWARD}"):
        compute("$residual", "($uPlus + $uMinus)/2 - $trial")
        compute("$iterate", "$known*step(abs($residual) - 0.01*$trial)*step(20.5 - $count)")
        with program.block("$iterate > 0"):
            compute("$trial", "max($trial/8, $trial + $residual)")
            compute("$nextPhase", str(START_BACKWARD))
    with program.block(f"$phase = {SOLVE}"):
        _next_trial(program, settings)
    compute("$phase", "$nextPhase")


def _next_trial(program: Program, settings: Settings) -> None:
    """The secant iteration for the density; its first slope is the last of the step before."""
    compute = program.compute
    compute("$target", _recursion(settings, "$uPlus", "$uMinus"))
    compute("$lastResidual", "$residual")
    compute("$residual", "$target - $trial")
    with program.block("$solved > 0"):
        with program.block("$trial != $lastTrial"):
            compute("$rate", "max(-3, min(0.8, ($target - $lastTarget)/($trial - $lastTrial)))")
    compute("$solved", "$solved + 1")
    compute("$lastTrial", "$trial")
    compute("$lastTarget", "$target")
    compute("$iterate", "1 - step($solverTolerance*($trial + $density) - abs($residual))")
    # Where rounding, or what the constraint solver leaves, keeps the residual from falling, more passes do not help.
    with program.block("$solved > 3.5"):
        with program.block("abs($residual) >= 0.5*abs($lastResidual)"):
            compute("$iterate", "$iterate*step(abs($residual) - 0.001*($trial + $density))")
    compute("$failed", f"max(1 - step($target - {_lowest(settings)}), $iterate*step($solved - {MAXIMUM_PASSES}))")
    with program.block("$failed > 0"):
        compute("$rescues", "$rescues + 1")
        compute("$trial", _bounded_density(_RESCUE))
        compute("$iterate", "1")
        compute("$nextPhase", str(PRESCRIBED))
    with program.block("$iterate > $failed"):
        compute("$trial", "max(0.25*$trial, min(4*$trial, $trial + $residual/(1 - $rate)))")


def _finish(program: Program, settings: Settings) -> None:
    """The new forces, the velocities of the whole step, and the constraint force of the half step before it."""
    compute = program.compute
    compute("dt", "$step")
    with program.block("$fresh > 0"):
        for k, monitor in enumerate(settings.monitors):
            plus, minus = _raw(monitor, "Plus" if settings.is_iterative else "Minus"), _raw(monitor, "Minus")
            compute(f"$mean{k}", f"({plus} + {minus})/2")
            compute(f"$half{k}", f"({plus} - {minus})/2")
    _energy(program, settings)
    program.per_particle("v", "(x - $start)/$step + 0.5*$step*f/m")
    program.per_particle("$velocity", "v")
    program.constrain_velocities()
    if settings.uses_constraint_force:
        program.sum("$constraintMinus", "m*(2*(v - $velocity)/$step)^2")
    program.per_particle("$velocity", "v")
    program.per_particle("$force", "f")
    program.per_particle("$end", "x")
    _position_sums(program, settings, "$force")
    if settings.is_iterative:
        if settings.uses_velocities:
            compute("$kineticMinus", "$kineticPlus")
            compute("$speedMinus", "$speedPlus")
    else:
        _velocity_sums(program, settings)
    with program.block("$fresh > 0"):
        for k, monitor in enumerate(settings.monitors):
            compute(f"$next{k}", f"{_raw(monitor, 'Minus')} + $half{k}")
    for k, monitor in enumerate(settings.monitors):
        with program.block(f"$reference{k} <= 0"):
            _take_reference(program, k, monitor)
    compute("$uMinus", _u(settings, "Minus"))
    compute("$density", "$trial")
    _sum_up(program, settings)
    compute("$clock", "$clock + $step")
    compute("$evaluations", "$evaluations + 1 + $fresh")
    for name, value in (("started", "1"), ("pending", "0"), ("prescribed", "0"), ("moved", "0")):
        compute("$" + name, value)


def _sum_up(program: Program, settings: Settings) -> None:
    """A number that is finite only if the step has led to forces and velocities that are."""
    if settings.uses_constraint_force or settings.uses("AppliedForce", "VectorField", "ArcLength", "ForcePNorm"):
        program.compute("$total", "$density + $uMinus + $constraintMinus + $applied + $forceSquared + $energy")
    else:
        program.sum("$pass", "v^2")
        program.compute("$total", "$density + $uMinus + $energy + $pass")


def _take_reference(program: Program, k: int, monitor: Monitor) -> None:
    """Take the reference value of a monitor as soon as the monitor is above rounding.

    A start at rest is calm, so the steps are nominal until then.
    """
    program.compute("$candidate", f"select($fresh, ($mean{k} + $next{k})/2, {_raw(monitor, 'Minus')})")
    program.compute("$rounding", "0")
    if monitor.name in ("ConstraintForce", "ConstraintAndAppliedForce"):
        # A constraint force that is rounding and nothing else changes velocities in a step by less than this.
        program.sum("$pass", "m*v^2")
        program.compute("$rounding", "1e-7*sqrt($pass)/$step")
    with program.block("$candidate > $rounding"):
        program.compute(f"$reference{k}", "$candidate")
