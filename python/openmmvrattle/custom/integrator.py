# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""The integrator as its user sees it: settings, steps, copies."""

from __future__ import annotations

import contextlib
import copy
import functools
import math
import operator
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import openmm
from openmm import unit

from .._arguments import integer, monitor_arguments, number
from .checks import explain_largest_force, explain_not_finite, require_masses, require_sound_start
from .program import KEPT, make_program
from .run import Run, find_context, positions_of, redundant_constraints, vectors, velocities_of
from .settings import (
    BOUNDED,
    EXPLICIT,
    INSTEAD,
    MONITOR_KINDS,
    PREFIX,
    REFUSED_MONITORS,
    SEMI_EXPLICIT,
    VERSION,
    Monitor,
    Settings,
    bound,
    check,
    density_of,
    error,
    positive,
    step_size,
)

__all__ = ["ConstraintWarning", "CustomVariableStepRattleIntegrator"]

_SINGLE_PRECISION_TOLERANCE = 1e-5
"""The default constraint tolerance where positions have single precision."""


class ConstraintWarning(UserWarning):
    """The constraints of a run are not met well enough for its steps: OpenMM's solver stops early, and tells nobody."""


class CustomVariableStepRattleIntegrator(openmm.CustomIntegrator):
    """The method VRATTLE of VariableStepRattleIntegrator as a CustomIntegrator, for every platform of OpenMM.

    Steps of variable size that are nevertheless time-reversible, so that the energy error stays bounded over long
    runs; see VariableStepRattleIntegrator for the method and for every setting, which have the same names here. It
    needs no compiled code of this package, so it also runs on GPUs (OpenCL, CUDA, HIP), where precision should be
    ``mixed`` or ``double``. One evaluation of the forces a step; a run costs one more at its start, or three more if
    reference values were set.

    What differs from VariableStepRattleIntegrator:

    - OpenMM's own solver meets the constraints. Where it stops early (strongly coupled bonds with a light atom between
      heavy ones) a ConstraintWarning says so.
    - The constraint force is taken from what that solver did to positions and velocities in the half steps before and
      after, not from Lambda(q,p). The step densities differ by a term of second order in the step.
    - Monitors: ConstraintForce (the default), AppliedForce, ConstraintAndAppliedForce, ForcePNorm, VectorField,
      ArcLength and ForceGroupEnergy. The others cannot be expressed and are refused. Explicit cannot be combined with
      monitors of the constraint force.
    - Monitors, update method and monitor force group are fixed once there is a Context; all else may change.
    - In a CompoundIntegrator it needs to be told its Context, see attachContext().
    - No multipliers, and no virtual sites on the platforms Reference and CPU.

    openmm.XmlSerializer stores it as an openmm.CustomIntegrator; `cast` makes what it reads one of ours again, and
    openmmvrattle.XmlSerializer does so by itself. Checkpoints, and States with integrator parameters, hold the whole
    run.
    """

    SemiExplicit, Explicit, Bounded = SEMI_EXPLICIT, EXPLICIT, BOUNDED
    (
        ConstraintMultipliers,
        ConstraintForce,
        AppliedForce,
        ConstraintAndAppliedForce,
        MultiplierPNorm,
        ForcePNorm,
        VectorField,
        MaxForce,
        ArcLength,
        MaxParticleArcLength,
        ForceGroupEnergy,
    ) = range(len(MONITOR_KINDS))

    def __init__(
        self,
        stepSize: float | unit.Quantity,
        updateMethod: int | None = None,
        minimumStepSize: float | unit.Quantity | None = None,
        maximumStepSize: float | unit.Quantity | None = None,
        constraintTolerance: float | None = None,
        monitors: Sequence[int | tuple[int, float, float]] | None = None,
        referenceMonitorValue: float | None = None,
        normOrder: float | None = None,
        monitorForceGroup: int | None = None,
    ) -> None:
        """Create a CustomVariableStepRattleIntegrator. None leaves the default of a setting.

        Parameters
        ----------
        stepSize : float or Quantity
            the nominal step size, taken where the monitor has its reference value (in ps); 0 for a Context that only
            computes energies
        updateMethod : int
            the recursion of the step density: SemiExplicit (the default), Explicit or Bounded
        minimumStepSize : float or Quantity
            the smallest step size the monitor can ask for (in ps); 0 means no bound. Default: 1/50 of stepSize
        maximumStepSize : float or Quantity
            the largest step size the monitor can ask for (in ps); 0 means no bound. Default: twice stepSize
        constraintTolerance : float
            the relative tolerance of constrained distances. Default: 1e-8, or 1e-5 with positions in single precision
        monitors : list
            the monitors in place of the default one, which is ConstraintForce, or ConstraintAndAppliedForce in a System
            without constraints: each a kind, or a tuple (kind, weight, power). The empty list means fixed steps
        referenceMonitorValue : float
            the value of the first monitor at which the nominal step is taken; 0 (the default) means that it is taken
            at the first step at which the monitor is above rounding
        normOrder : float
            the order p of the monitor ForcePNorm. Default: 8
        monitorForceGroup : int
            the force group whose energy is the monitor ForceGroupEnergy. Default: 31
        """
        nominal = step_size(stepSize, "stepSize")
        super().__init__(nominal)
        super().setConstraintTolerance(1e-8)
        self._install(Settings(nominal))
        if minimumStepSize is not None:
            self.setMinimumStepSize(minimumStepSize)
        if maximumStepSize is not None:
            self.setMaximumStepSize(maximumStepSize)
        if constraintTolerance is not None:
            self.setConstraintTolerance(constraintTolerance)
        if normOrder is not None:
            self.setNormOrder(normOrder)
        if monitorForceGroup is not None:
            self.setMonitorForceGroup(monitorForceGroup)
        if monitors is not None:
            each = monitor_arguments(monitors)
            self.clearMonitors()
            for arguments in each:
                self.addMonitor(*arguments)
        if updateMethod is not None:
            self.setUpdateMethod(updateMethod)
        if referenceMonitorValue is not None:
            self.setReferenceMonitorValue(referenceMonitorValue)

    # Settings

    def getNominalStepSize(self) -> unit.Quantity:
        """Get the nominal step size: the step taken where the monitor has its reference value."""
        return unit.Quantity(self._get("nominalStep"), unit.picosecond)

    def setNominalStepSize(self, size: float | unit.Quantity) -> None:
        """Set the nominal step size: the step taken where the monitor has its reference value.

        In the course of a run the density is kept, so the steps change in proportion.

        Parameters
        ----------
        size : float or Quantity
            the nominal step size (in ps). Nominal step and bounds can be set in any order; the next step raises an
            exception if it does not lie between them
        """
        settings = self._settings()
        settings.nominal = step_size(size, "size")
        self._change(settings)
        self._set("step", settings.nominal)

    def getStepSize(self) -> unit.Quantity:
        """Get the size of the most recent step, or the nominal step size if it has been set since, or before the first
        step."""
        size = self._get("step") if self._get("started") else self._get("nominalStep")
        return unit.Quantity(size, unit.picosecond)

    def setStepSize(self, size: float | unit.Quantity) -> None:
        """The same as setNominalStepSize(), so that scripts written for a fixed step keep working."""
        self.setNominalStepSize(size)

    def getMinimumStepSize(self) -> unit.Quantity:
        """Get the smallest step size the monitor can ask for, 0 if there is no bound."""
        return unit.Quantity(self._settings().minimum_in_force, unit.picosecond)

    def setMinimumStepSize(self, size: float | unit.Quantity) -> None:
        """Set the smallest step size the monitor can ask for (in ps); 0 means no bound. Default: 1/50 of the nominal
        one."""
        settings = self._settings()
        settings.minimum = bound(size, "minimum")
        self._change(settings)

    def getMaximumStepSize(self) -> unit.Quantity:
        """Get the largest step size the monitor can ask for, 0 if there is no bound."""
        return unit.Quantity(self._settings().maximum_in_force, unit.picosecond)

    def setMaximumStepSize(self, size: float | unit.Quantity) -> None:
        """Set the largest step size the monitor can ask for (in ps); 0 means no bound. Default: twice the nominal one.

        With the update Bounded no step is ever larger; with the others a step of more than twice the bound is rescued
        (see getNumRescues()).
        """
        settings = self._settings()
        settings.maximum = bound(size, "maximum")
        self._change(settings)

    def getUpdateMethod(self) -> int:
        """Get the recursion of the step density: SemiExplicit, Explicit or Bounded."""
        return int(self._get("updateMethod"))

    def setUpdateMethod(self, method: int) -> None:
        """Set the recursion of the step density, before there is a Context.

        SemiExplicit takes u of the half steps before and after; Bounded does so for monitors of the constraint force,
        and else takes u of the whole step; Explicit always does, so it needs monitors other than those of the
        constraint force.

        Parameters
        ----------
        method : int
            SemiExplicit (the default), Explicit or Bounded
        """
        settings = self._settings()
        settings.update = integer(method, "method")
        if settings.update not in (SEMI_EXPLICIT, EXPLICIT, BOUNDED):
            raise error(f"there is no update method {settings.update}: take SemiExplicit, Explicit or Bounded")
        self._rebuild(settings)

    def addMonitor(self, kind: int, weight: float = 1.0, power: float = 1.0, order: float = 0.0) -> int:
        """Add a monitor, before there is a Context. Several are combined as in VariableStepRattleIntegrator.

        Parameters
        ----------
        kind : int
            ConstraintForce, AppliedForce, ConstraintAndAppliedForce, ForcePNorm, VectorField, ArcLength or
            ForceGroupEnergy
        weight : float
            its positive weight in the combination
        power : float
            the positive power to which U/U_ref is raised
        order : float
            the order p, at least 1, of ForcePNorm, the same for all of them; 0 stands for getNormOrder(), which is 8

        Returns
        -------
        int
            the index of the monitor
        """
        settings = self._settings()
        kind = integer(kind, "kind")
        if not 0 <= kind < len(MONITOR_KINDS):
            raise error(f"there is no kind of monitor {kind}")
        if MONITOR_KINDS[kind] in REFUSED_MONITORS:
            name = MONITOR_KINDS[kind]
            raise error(f"the monitor {name} {REFUSED_MONITORS[name]}, or {INSTEAD}")
        weight = positive(number(weight, "weight"), "the weight of a monitor")
        power = positive(number(power, "power"), "the power of a monitor")
        order = number(order, "order")
        if order != 0 and MONITOR_KINDS[kind] == "ForcePNorm":
            if settings.uses("ForcePNorm") and order != settings.order:
                raise error(f"all monitors ForcePNorm have one order, which is {settings.order:g}; or use {INSTEAD}")
            settings.order = _norm_order(order)
        settings.monitors.append(Monitor(kind, weight, power))
        self._rebuild(settings)
        return len(settings.monitors) - 1

    def clearMonitors(self) -> None:
        """Remove all monitors, before there is a Context. With none the steps are fixed at the nominal size."""
        settings = self._settings()
        settings.monitors.clear()
        self._rebuild(settings)

    def getNumMonitors(self) -> int:
        """Get the number of monitors."""
        return int(self._get("monitors"))

    def getMonitor(self, index: int) -> tuple[int, float, float]:
        """Get kind, weight and power of a monitor."""
        monitor = self._settings().monitors[self._monitor_index(index)]
        if monitor.is_default and self._get("applies"):
            return self.ConstraintAndAppliedForce, monitor.weight, monitor.power
        return monitor.kind, monitor.weight, monitor.power

    def getMonitorForceGroup(self) -> int:
        """Get the force group whose energy the monitor ForceGroupEnergy uses."""
        return int(self._get("energyGroup"))

    def setMonitorForceGroup(self, group: int) -> None:
        """Set the force group whose energy the monitor ForceGroupEnergy uses; it is then left out of the dynamics.

        Parameters
        ----------
        group : int
            the force group, between 0 and 31. Default: 31
        """
        settings = self._settings()
        settings.group = integer(group, "group")
        if not 0 <= settings.group <= 31:
            raise error(f"a force group lies between 0 and 31, not {settings.group}")
        self._rebuild(settings)

    def getNormOrder(self) -> float:
        """Get the order p of the monitor ForcePNorm."""
        return self._get("normOrder")

    def setNormOrder(self, order: float) -> None:
        """Set the order p of the monitor ForcePNorm, at least 1. Default: 8."""
        settings = self._settings()
        settings.order = _norm_order(number(order, "order"))
        self._change(settings)

    def getMonitorNormOrder(self, index: int) -> float:
        """Get the order p of a monitor, which is that of a norm if it is ForcePNorm."""
        self._monitor_index(index)
        return self.getNormOrder()

    def getReferenceMonitorValue(self, index: int = 0) -> float:
        """Get the reference value of a monitor: the value in force, 0 if none was set and the monitor has been zero in
        all steps so far."""
        return self._get(f"reference{self._monitor_index(index)}")

    def setReferenceMonitorValue(self, value: float, index: int = 0) -> None:
        """Set the reference value of a monitor, at which the nominal step is taken.

        Parameters
        ----------
        value : float
            the reference value in the monitor's unit; 0 means that it is taken at the next step at which the monitor
            is above rounding, and starts the density afresh
        index : int
            the index of the monitor
        """
        settings, index = self._settings(), self._monitor_index(index)
        value = number(value, "value")
        if not (math.isfinite(value) and value >= 0):
            raise error(f"a reference value must be positive, or 0 for the value at the first step, not {value:g}")
        settings.monitors[index].reference = value
        self._change(settings)
        self._set(f"reference{index}", value)
        if value == 0:
            self._set("started", 0.0)

    def setConstraintTolerance(self, tol: float) -> None:
        """Set the relative tolerance of constrained distances. Default: 1e-8, or 1e-5 with positions in single
        precision.

        The reversibility of a run goes with it, as the constraint force is measured by what the constraints did.
        """
        super().setConstraintTolerance(positive(number(tol, "tol"), "the constraint tolerance"))
        self._set("toleranceSet", 1.0)

    def getIntegrationForceGroups(self) -> int:
        """Get which force groups to use for integration, as a set of bit flags: without that of a monitor."""
        groups = self._chosen_force_groups()
        settings = self._settings()
        if settings.uses("ForceGroupEnergy"):
            groups &= ~(1 << settings.group)
        return _signed(groups)

    def setIntegrationForceGroups(self, groups: int | set) -> None:
        """Set which force groups to use for integration, before the first step: bit flags, or a set of groups."""
        if self._get("started"):
            raise error("the integration force groups cannot change after the first step: make another integrator")
        if isinstance(groups, (set, frozenset)):
            groups = functools.reduce(operator.or_, (1 << integer(group, "group") for group in groups), 0)
        self._set("forceGroups", float(_signed(integer(groups, "groups", 2**32 - 1))))
        self._apply_force_groups()

    def _chosen_force_groups(self) -> int:
        """Those that were set, whatever the monitor, as bits."""
        return int(self._get("forceGroups")) & 0xFFFFFFFF

    # What a run has come to

    def getStepDensity(self) -> float:
        """Get the step density rho of the last step; 1 before the first step."""
        return self._get("density")

    def getMonitorValue(self, index: int = 0) -> float:
        """Get the value of a monitor at the current positions, after the first step.

        For monitors of the constraint force, and with SemiExplicit those of velocities, it belongs to the half step
        before.
        """
        monitor = self._settings().monitors[self._monitor_index(index)]
        if not self._get("started"):
            raise error("the value of a monitor is known after the first step")
        return self._monitor_value(monitor)

    def getMultipliers(self) -> None:
        """Refused: a CustomIntegrator has no multipliers."""
        raise error(f"OpenMM's constraint solver does not tell the multipliers: use {INSTEAD}")

    def getNumForceEvaluations(self) -> int:
        """Get how often the method has asked for the forces: once a step, and once more for each start of a density.

        It does not know of evaluations that OpenMM adds, as after a change of a Context parameter, or on a GPU
        whenever the atoms have been sorted anew (every 250 steps).
        """
        return int(self._get("evaluations"))

    def getNumSolverIterations(self) -> int:
        """Get how often positions have been constrained in search of a step and its density: the passes of all
        steps."""
        return int(self._get("passes"))

    def getNumRescues(self) -> int:
        """Get how many steps had to be rescued, because the recursion gave no step that could be taken.

        The run goes on with the density of Bounded from u of the half step before, but is not reversible across that
        step. A number that grows says that the nominal step size is too large.
        """
        return int(self._get("rescues"))

    # Running

    def step(self, steps: int) -> None:
        """Advance the simulation by a number of steps.

        Parameters
        ----------
        steps : int
            the number of steps to take
        """
        steps = integer(steps, "steps")
        run = self._enter()
        if run is None:  # a member of a CompoundIntegrator that was not told
            super().step(steps)
            return
        try:
            while steps > 0:
                chunk = min(steps, run.steps_to_check())
                self._advance(run, chunk)
                steps -= chunk
        finally:
            self._set_time(run.context)

    def stepTo(self, time: float | unit.Quantity) -> None:
        """Advance the simulation until a given time, which is met exactly by a shortened last step.

        The shortened step is not part of the reversible sequence: to retrace a run, use step(). It costs two more
        evaluations of the forces, as the step that reaches beyond the time is taken back. A time earlier than the
        current one does nothing.

        Parameters
        ----------
        time : float or Quantity
            the time to which the simulation is advanced (in ps)
        """
        time = number(time, "time", unit.picosecond)
        if not math.isfinite(time):
            raise error(f"the time to step to must be finite, not {time:g}")
        run = self._enter(required=True)
        try:
            while self._get("clock") < time:
                saved = self._variables()
                self._advance(run, 1)
                size, clock = self._get("step"), self._get("clock")
                if clock > time - 1e-6 * size:
                    self._shorten(run, saved, time)
        finally:
            self._set_time(run.context)

    def reverse(self) -> None:
        """Turn time around: velocities change sign, and the following steps retrace the trajectory; time goes on
        forward.

        The density of the step that would have come next is found by taking that step and putting everything back,
        which costs two evaluations of the forces. (Velocities that the user sets start the density afresh instead.)
        """
        run = self._enter(required=True)
        context = run.context
        if not self._get("started"):
            context.setVelocities(-velocities_of(context))
            return
        # A copy, since a step overwrites it: the velocities with which the program notices changes.
        known = np.array(self.getPerDofVariableByName(PREFIX + "velocity"))
        velocities = velocities_of(context)
        saved = context.createCheckpoint()
        try:
            self._take(context)
            after = self._variables()
        finally:
            context.loadCheckpoint(saved)
        fresh = bool(after["fresh"])
        self._set("evaluations", after["evaluations"] + 1)
        context.setVelocities(-velocities)
        self.setPerDofVariableByName(PREFIX + "velocity", vectors(-known))
        if fresh:  # The user had changed the state: there is no sequence of densities to turn round.
            self._set("started", 0.0)
            return
        self._set("density", after["density"])
        self._set("difference", 0.0)
        self._set("differenceBefore", 0.0)
        if self._settings().is_iterative:
            for name in ("u", "constraint", "kinetic", "speed"):
                self._set(name + "Minus", after[name + "Plus"])

    def calibrate(self, steps: int) -> None:
        """Set the reference value of every monitor to its mean over a trial run of fixed steps of the nominal size.

        The trial run starts at the current state, and everything but the reference values and the number of force
        evaluations is put back as it was.

        Parameters
        ----------
        steps : int
            the number of trial steps
        """
        steps = integer(steps, "steps")
        run = self._enter(required=True)
        monitors = self._settings().monitors
        if steps <= 0 or not monitors:
            raise error("calibrate() needs a monitor and a positive number of steps")
        context = run.context
        saved = context.createCheckpoint()
        sums = np.zeros(len(monitors))
        try:
            if not self._get("started"):
                self._apply_constraints(context)
            for _ in range(steps):
                self._set("prescribed", 1.0)
                self._take(context)
                sums += [self._monitor_value(monitor) for monitor in monitors]
            evaluations = self._get("evaluations")
        finally:
            context.loadCheckpoint(saved)
        self._set("evaluations", evaluations)
        for index, mean in enumerate(sums / steps):
            if mean > 0:  # otherwise it is taken as soon as it is
                self.setReferenceMonitorValue(float(mean), index)

    def attachContext(self, context: openmm.Context) -> None:
        """Tell the integrator its Context, where it cannot find it: as a member of a CompoundIntegrator, or after
        gc.freeze(), which hides the Context. It does not look for one then.

        In a CompoundIntegrator step(), stepTo(), reverse() and calibrate() of this object are ours, while the steps of
        the CompoundIntegrator are without the checks of constraints, and on the platforms Reference and CPU do not set
        the time of the Context right.

        Parameters
        ----------
        context : Context
            the Context that was made with this integrator, or with the CompoundIntegrator of which it is a member
        """
        if not isinstance(context, openmm.Context):
            raise TypeError(f"context must be a Context, not {context!r}")
        self._run = Run(context, self._settings())
        self._set("applies", float(self._run.applies_default))
        self._fit_tolerances(self._run)

    # Copies

    @staticmethod
    def isinstance(integrator: openmm.Integrator) -> bool:
        """Get whether an integrator is one of ours, though its class may be openmm.CustomIntegrator."""
        if not isinstance(integrator, openmm.CustomIntegrator):
            return False
        names = (integrator.getGlobalVariableName(i) for i in range(integrator.getNumGlobalVariables()))
        return PREFIX + "version" in names

    @classmethod
    def cast(cls, integrator: openmm.Integrator) -> CustomVariableStepRattleIntegrator:
        """Make what OpenMM has returned as an openmm.CustomIntegrator a CustomVariableStepRattleIntegrator again.

        Parameters
        ----------
        integrator : Integrator
            for example from openmm.XmlSerializer.deserialize()

        Returns
        -------
        CustomVariableStepRattleIntegrator
            the same Python object, whose class has been changed; one that has no Context yet has its settings alone,
            and nothing of a run in which it may have been written
        """
        if isinstance(integrator, cls):
            return integrator
        if not cls.isinstance(integrator):
            raise TypeError(f"a {type(integrator).__name__} is not a CustomVariableStepRattleIntegrator")
        version = int(integrator.getGlobalVariableByName(PREFIX + "version"))
        if version != VERSION:
            raise error(
                f"this integrator has version {version} of its program and this package reads version {VERSION}"
            )
        integrator.__class__ = cls
        if not integrator._is_fixed():
            integrator._install(integrator._settings(), integrator._chosen_force_groups())
        return integrator

    def __copy__(self) -> CustomVariableStepRattleIntegrator:
        duplicate = type(self).__new__(type(self))
        duplicate.__setstate__(copy.deepcopy(self.__getstate__()))
        return duplicate

    def __deepcopy__(self, memo: dict) -> CustomVariableStepRattleIntegrator:
        return self.__copy__()

    def __getstate__(self) -> tuple[Any, ...]:
        attributes = {name: value for name, value in self.__dict__.items() if name not in ("this", "_run")}
        numbers = (self.getConstraintTolerance(), self._chosen_force_groups(), self.getRandomNumberSeed())
        return self._settings(), numbers, self.getKineticEnergyExpression(), attributes

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        settings, (tolerance, groups, seed), kinetic_energy, attributes = state
        openmm.CustomIntegrator.__init__(self, settings.nominal)
        openmm.CustomIntegrator.setConstraintTolerance(self, tolerance)
        self.setRandomNumberSeed(seed)
        self.setKineticEnergyExpression(kinetic_energy)
        self._install(settings, groups)
        self.__dict__.update(attributes)

    # Variables of the CustomIntegrator. All there is to remember is kept in them, as they are what OpenMM saves.

    def _get(self, name: str) -> float:
        return self.getGlobalVariableByName(PREFIX + name)

    def _set(self, name: str, value: float) -> None:
        self.setGlobalVariableByName(PREFIX + name, value)

    def _variables(self) -> dict[str, float]:
        count = self.getNumGlobalVariables()
        return {self.getGlobalVariableName(i).removeprefix(PREFIX): self.getGlobalVariable(i) for i in range(count)}

    def _settings(self) -> Settings:
        return Settings.from_globals(self._variables())

    def _is_fixed(self) -> bool:
        """Whether the program can no longer be replaced: there is a Context, or another object owns this integrator."""
        if not self.thisown:
            return True
        try:
            # OpenMM does not tell, but refuses. Otherwise the next thing is to replace this program.
            self.addGlobalVariable(PREFIX + "replaced", 0.0)
        except openmm.OpenMMException:
            return True
        return False

    def _install(self, settings: Settings, groups: int | None = None) -> None:
        """Put another CustomIntegrator with the program of these settings behind this Python object."""
        if groups is None:
            groups = int(self._variables().get("forceGroups", -1))
        fresh = make_program(settings).make(settings.nominal, {"forceGroups": float(_signed(groups))})
        fresh.setConstraintTolerance(self.getConstraintTolerance())
        fresh.setRandomNumberSeed(self.getRandomNumberSeed())
        fresh.setKineticEnergyExpression(self.getKineticEnergyExpression())
        self.this = fresh.this
        self._apply_force_groups()

    def _apply_force_groups(self) -> None:
        super().setIntegrationForceGroups(self.getIntegrationForceGroups())

    def _rebuild(self, settings: Settings) -> None:
        """Take new settings that need another program."""
        if settings == self._settings():
            return
        check(settings)
        if self._is_fixed():
            raise error(
                "monitors, update method and monitor force group are fixed once there is a Context, or the integrator "
                "is part of another one: make another integrator"
            )
        self._install(settings)

    def _change(self, settings: Settings) -> None:
        """Take new settings that are variables of the program."""
        check(settings)
        for name, value in settings.globals().items():
            self._set(name, value)
        if self._get("started"):
            self._set("pending", 1.0)

    def _monitor_index(self, index: int) -> int:
        index, count = integer(index, "index"), self.getNumMonitors()
        if not 0 <= index < count:
            raise error(f"there is no monitor {index}; the number of monitors is {count}")
        return index

    def _monitor_value(self, monitor: Monitor) -> float:
        values = self._variables()
        constraint, applied, force = values["constraintMinus"], values["applied"], values["forceSquared"]
        default = applied * values["applies"] if monitor.is_default else 0.0
        return {
            "ConstraintForce": lambda: math.sqrt(constraint + default),
            "AppliedForce": lambda: math.sqrt(applied),
            "ConstraintAndAppliedForce": lambda: math.sqrt(constraint + applied),
            "ForcePNorm": lambda: math.sqrt(force) * values["norm"] ** (1 / values["normOrder"]),
            "VectorField": lambda: math.sqrt(values["kineticMinus"] + force),
            "ArcLength": lambda: math.sqrt(values["speedMinus"] + force),
            "ForceGroupEnergy": lambda: values["energy"],
        }[monitor.name]()

    # Steps

    def _enter(self, required: bool = False) -> Run | None:
        """Prepare for steps: find the Context, and take over the time that it has."""
        run = self.__dict__.get("_run")
        if run is None or run.context is None:
            context = find_context(self)
            if context is None:
                super().step(0)  # raises where there is none
                if required or self.thisown:
                    raise error(
                        "this integrator has a Context and cannot find it, as a member of a CompoundIntegrator cannot, "
                        "nor any integrator after gc.freeze(): tell it with attachContext()"
                    )
                return None
            self.attachContext(context)
        elif not self._get("started"):  # the System may be another, by Context.reinitialize()
            self.attachContext(run.context)
        run = self._run
        if self._get("conflict"):
            raise error(str(self._settings().conflict()))
        time = run.context.getTime()._value
        if time != self._get("clock"):
            self._set("clock", time)
        if self._get("started"):
            self._set("entering", 1.0)
        return run

    def _fit_tolerances(self, run: Run) -> None:
        """Tolerances that the precision of the platform can meet."""
        if run.precision == "single" and not self._get("toleranceSet"):
            super().setConstraintTolerance(_SINGLE_PRECISION_TOLERANCE)
        # What the constraints leave dominates: a smaller tolerance of the density makes a run no more reversible.
        rounding = {"single": 2e-4, "mixed": 1e-9}.get(run.precision, 1e-11)
        tolerance = max(min(10 * self.getConstraintTolerance(), 1e-5), rounding)
        if self._get("solverTolerance") != tolerance:
            self._set("solverTolerance", tolerance)

    def _advance(self, run: Run, steps: int) -> None:
        """Take steps, the first of which may be a first one of a sequence of densities."""
        context, before, unseen = run.context, None, steps
        self._fit_tolerances(run)
        is_start = not self._get("started")
        if is_start or run.keeps_variables:
            before = positions_of(context), velocities_of(context)
        try:
            if is_start:
                self._apply_constraints(context)
            self._take(context)
            is_fresh = bool(self._get("fresh"))
            if is_fresh:
                self._improve_start(run)
        except BaseException:
            if before is not None:
                context.setPositions(before[0])
                context.setVelocities(before[1])
            raise
        if is_fresh:
            run.begin()
            self._check(run, 1)
            unseen -= 1
        if steps > 1:
            self._take(context, steps - 1)
        if unseen:
            self._check(run, unseen)

    def _apply_constraints(self, context: openmm.Context) -> None:
        """Put the state onto the constraints, as at the start of every run."""
        require_sound_start(context)
        context.applyConstraints(self.getConstraintTolerance())
        context.applyVelocityConstraints(self.getConstraintTolerance())

    def _take(self, context: openmm.Context, steps: int = 1) -> None:
        """Take steps; if one cannot be completed, the Context is in the state before that one."""
        try:
            openmm.CustomIntegrator.step(self, steps)
        except BaseException as failure:
            if self._get("moved"):
                self._undo(context, self._kept())
            elif self._run.keeps_variables:  # They are those after the last step that was completed, and so are these.
                self._put_back(context, "end", "velocity")
            if isinstance(failure, openmm.OpenMMException) and "NaN" in str(failure):  # of platforms that look for it
                raise error(self._explain_not_finite(context)) from failure
            raise
        if self._get("lost"):
            skipped = int(self._get("skipped"))
            self._set("lost", 0.0)
            self._set("skipped", 0.0)
            context.setStepCount(context.getStepCount() - skipped)
            if skipped == steps:  # what was found at the beginning is not the result of a step of ours
                require_masses(context.getSystem())
                raise error(f"no step can be taken, as {explain_not_finite(context)}")
        elif math.isfinite(self._get("total")):
            return
        self._undo(context, self._kept())
        context.setStepCount(context.getStepCount() - 1)
        raise error(self._explain_not_finite(context))

    def _explain_not_finite(self, context: openmm.Context) -> str:
        """Of a step that has been undone."""
        groups = self.getIntegrationForceGroups()
        return (
            "a step could not be taken, as forces, monitors or the constraint solver gave numbers that are not finite; "
            "the Context is in the state before this step: "
            + (
                redundant_constraints(context.getSystem(), positions_of(context))
                or f"{explain_largest_force(context, groups)}; take a smaller nominal step size, or move apart what "
                "overlaps"
            )
        )

    def _kept(self) -> dict[str, float]:
        """The variables as they were before the last step."""
        return {name[len(KEPT) :]: value for name, value in self._variables().items() if name.startswith(KEPT)}

    def _undo(self, context: openmm.Context, variables: dict[str, float]) -> None:
        """Go back to the particles before the last step, and to variables."""
        self._put_back(context, "start", "startVelocity")
        if not self._get("moved"):
            # The step was completed, so the program would take this state for one that the user has changed.
            self._know_state(context)
        for name, value in ({"prescribed": 0.0} | variables).items():
            self._set(name, value)
        self._set("moved", 0.0)

    def _know_state(self, context: openmm.Context) -> None:
        """Let the state before the last step be the one to which the next step compares what it finds."""
        for name, start in (("velocity", "startVelocity"), ("end", "start")):
            self.setPerDofVariableByName(PREFIX + name, self.getPerDofVariableByName(PREFIX + start))
        groups = self.getIntegrationForceGroups()
        with contextlib.suppress(openmm.OpenMMException):  # then the density starts afresh
            forces = context.getState(forces=True, groups=groups).getForces(asNumpy=True)._value
            self.setPerDofVariableByName(PREFIX + "force", vectors(forces))

    def _improve_start(self, run: Run) -> None:
        """Take the first step again with a density that starts no oscillation, if it was not of its own making.

        Without reference values it was: they are such that its density is 1. Otherwise its density was u at the start,
        and has to be (7.1) of docs/method.md, for which u after the step is known now.
        """
        settings, values = self._settings(), self._variables()
        if not settings.monitors or not all(values[f"reference{k}"] > 0 for k in range(len(settings.monitors))):
            return
        here, after = (density_of(settings, values, name) for name in ("mean", "next"))
        wanted = (here + after) / 2
        if not 0.5 * here < wanted < 2 * here or math.isclose(wanted, values["density"], rel_tol=1e-9):
            return
        if all(monitor.reference == 0 for monitor in settings.monitors) and values["density"] == 1:
            return
        before = self._kept()
        self._take_back(run.context)
        self._set("prescribed", wanted)
        try:
            self._take(run.context)
        except BaseException:
            self._undo(run.context, before)
            raise

    def _put_back(self, context: openmm.Context, position: str, velocity: str) -> None:
        """Set positions and velocities to those in two variables of the particles."""
        system = context.getSystem()
        moving = np.array([system.getParticleMass(i)._value > 0 for i in range(system.getNumParticles())])[:, None]
        positions = np.array(self.getPerDofVariableByName(PREFIX + position))
        velocities = np.array(self.getPerDofVariableByName(PREFIX + velocity))
        context.setPositions(np.where(moving, positions, positions_of(context)))
        context.setVelocities(np.where(moving, velocities, 0.0))
        context.computeVirtualSites()

    def _take_back(self, context: openmm.Context) -> None:
        """Go back to the state before the last step, with which the program has begun it."""
        self._put_back(context, "start", "startVelocity")
        context.setStepCount(context.getStepCount() - 1)
        self._set("clock", self._get("clock") - self._get("step"))
        self._set_time(context)
        self._set("started", 0.0)

    def _shorten(self, run: Run, saved: dict[str, float], time: float) -> None:
        """Take the last step, which reached or passed the time, once more and end it at the time."""
        remaining, full = time - saved["clock"], self._get("step")
        before, after = saved["density"], self._get("density")
        evaluations, fresh = self._get("evaluations"), self._get("fresh")
        self._take_back(run.context)
        for name, value in saved.items():
            self._set(name, value)
        for name, start in (("velocity", "startVelocity"), ("end", "start")):
            self.setPerDofVariableByName(PREFIX + name, self.getPerDofVariableByName(PREFIX + start))
        self._set("prescribed", self._get("nominalStep") / remaining)
        self._set("entering", 0.0)
        try:
            self._take(run.context)
        except BaseException:
            self._undo(run.context, saved)
            raise
        # The density moves by the part of a full step.
        self._set("density", after if fresh else before + (after - before) * min(1.0, remaining / full))
        self._set("pending", 2.0)
        self._set("clock", time)
        self._set("evaluations", evaluations + 2)

    def _set_time(self, context: openmm.Context) -> None:
        # On Reference and CPU the Context's time advances by the step size with which the Context was made.
        context.setTime(self._get("clock"))

    def _check(self, run: Run, steps: int) -> None:
        """Raise or warn if the constraint solver does not do its work, after some steps."""
        messages, failure = run.check(steps, self.getConstraintTolerance(), int(self._get("rescues")))
        if failure is not None:
            raise error(f"{failure}; {self._go_back(run)}")
        for message in messages:
            warnings.warn(message, ConstraintWarning, stacklevel=4)

    def _go_back(self, run: Run) -> str:
        """Go back to the last state whose constraints were met, and say so."""
        context = run.context
        if run.good is None:  # the first step of a sequence
            self._undo(context, self._kept())
            context.setStepCount(context.getStepCount() - 1)
            return "the Context is in the state before this step"
        # What the user has set since is not part of that state.
        settings, parameters = self._settings(), dict(context.getParameters())
        context.loadCheckpoint(run.good)
        for name, value in parameters.items():
            if context.getParameter(name) != value:
                context.setParameter(name, value)
        if settings != self._settings():
            self._change(settings)
        run.begin()
        return (
            f"the Context is in the state after step {context.getStepCount():,}, the last one whose constraints are "
            "known to have been met"
        )


def _norm_order(order: float) -> float:
    if not (math.isfinite(order) and order >= 1):
        raise error(f"the order of a norm must be at least 1, not {order:g}")
    return order


def _signed(groups: int) -> int:
    """Force groups as OpenMM returns them: the bits as a signed integer of 32 bits."""
    groups &= 0xFFFFFFFF
    return groups - (1 << 32) if groups >> 31 else groups
