# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""The integrators that are compiled, as Python sees them: units, documentation, copies.

The compiled classes are in the module vrattle, which SWIG makes from the C++ headers and which takes plain numbers.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import openmm
from openmm import unit

from . import vrattle
from ._arguments import (
    PARAMETER_NAME,
    boolean,
    constraint_arguments,
    integer,
    monitor_arguments,
    number,
    parameter,
    string,
)

if TYPE_CHECKING:
    from typing_extensions import Self

__all__ = ["ConstrainedIntegrator", "VariableStepRattleIntegrator", "VariableStepRattleLangevinIntegrator"]

_TIME = unit.picosecond
_FRICTION = unit.picosecond**-1
_MANY_SHORT_STEPS = 1000
_STEPS_AT_ONCE = 1000  # after which Python can interrupt, and warn
_MULTIPLIER = unit.kilojoule_per_mole / unit.nanometer**2


def _deprecated(name: str, instead: str) -> None:
    warnings.warn(f"{name} is deprecated: use {instead}", DeprecationWarning, stacklevel=3)


class ConstrainedIntegrator(vrattle.ConstrainedIntegrator):
    """What the compiled integrators have in common: constraints given as expressions, and their multipliers; counts of
    work; copies."""

    this: Any  # what SWIG keeps the C++ object in

    def setVelocitiesToTemperature(self, temperature: float | unit.Quantity, randomSeed: int | None = None) -> None:
        """Give the particles of the Context random velocities of a temperature that satisfy all constraints.

        Those given as expressions too: each velocity is drawn from Maxwell's distribution, and all together are
        projected onto the constraints in the metric of the masses, so that the mean kinetic energy is kT/2 for each
        degree of freedom that the constraints leave. It does what setVelocitiesToTemperature() of the Context does,
        whose solver leaves expressions alone and can fail where constraints are strongly coupled.

        Where the positions do not satisfy the constraints, the velocities satisfy them at the positions that the next
        step starts from. The forces are computed once, for that step.

        Parameters
        ----------
        temperature : float or Quantity
            the temperature (in K); not negative
        randomSeed : int
            the same seed gives the same velocities. Default: another one at each call

        Raises
        ------
        OpenMMException
            if the temperature is negative or not finite, there is no Context, or its positions are no start for a run;
            the velocities are then as before
        """
        seed = () if randomSeed is None else (integer(randomSeed, "randomSeed"),)
        super().setVelocitiesToTemperature(number(temperature, "temperature", unit.kelvin), *seed)

    def getMultipliers(self) -> unit.Quantity:
        """Get the Lagrange multipliers Lambda(q,p) (4.3) of the constraints at the current positions and velocities, in
        the order of the System's constraints, and behind them those of addConstraint().

        The force of constraint k of the System, g = |r|^2 - d^2 with r = q_i - q_j, is -2 Lambda_k r on particle i and
        the opposite on j: a positive multiplier is a bond under tension, whose tension is 2 Lambda_k d. The force of
        any constraint g = 0 on a particle is -Lambda_k dg/dq. Before the first step this computes the forces.

        Returns
        -------
        Quantity
            a list of the multipliers in kJ/mol/nm^2; 0 for a constraint between two massless particles. Those of
            addConstraint() are numbers in kJ/mol over the unit of the expression, whatever the unit of the list says;
            see getExpressionConstraintMultiplier()

        Raises
        ------
        OpenMMException
            if there is no Context
        """
        return unit.Quantity(list(super().getMultipliers()), _MULTIPLIER)

    def getExpressionConstraintMultiplier(self, index: int) -> float:
        """Get the Lagrange multiplier of one constraint of addConstraint(); see getMultipliers().

        Where the expression is a reaction coordinate minus its value, it is the force that holds the coordinate there,
        with the sign of a force against g.

        Parameters
        ----------
        index : int
            the index of the constraint, as addConstraint() has returned it

        Returns
        -------
        float
            the multiplier, in kJ/mol over the unit of the expression

        Raises
        ------
        OpenMMException
            if there is no constraint with this index, or no Context
        """
        return super().getExpressionConstraintMultiplier(integer(index, "index"))

    def getNumExpressionConstraints(self) -> int:
        """Get the number of constraints that addConstraint() has added.

        Returns
        -------
        int
            their number
        """
        return super().getNumExpressionConstraints()

    def setExpressionParameterValue(self, index: int, name: str, value: float | unit.Quantity) -> None:
        """Change the value of one parameter of a constraint.

        The next step moves the particles there: its end satisfies the constraint, with velocities v that belong to
        the motion, dg/dq v = -dg/dparameter (new - old)/(size of the step). It costs no evaluation of the forces, and
        the step density goes on. The work that the motion does on the particles is the multiplier times
        dg/dparameter times the change of the parameter; take the mean of the multipliers before and after the step
        (docs/constraints.md has an example). A change that no step can make fails as a step, and the value stays as
        it was set. Before the first step after the user has set positions or velocities, numbers that are asked for
        are those of particles put on the constraint, without a motion.

        Parameters
        ----------
        index : int
            the index of the constraint
        name : str
            the name of the parameter
        value : float or Quantity
            its new value (in nm, ps, amu, kJ/mol, radian if it is a number)

        Raises
        ------
        OpenMMException
            if there is no constraint with this index, or it has no such parameter, or the value is not finite
        """
        name = string(name, PARAMETER_NAME)
        super().setExpressionParameterValue(integer(index, "index"), name, parameter(value, name))

    def getNumForceEvaluations(self) -> int:
        """Get how often the forces have been computed for this integrator since the Context was created or
        reinitialized.

        This count and the following ones are of the work done in this Context: they are not saved, and loading a
        checkpoint or a State leaves them as they are.

        Returns
        -------
        int
            the number of force evaluations
        """
        return super().getNumForceEvaluations()

    def getNumSolverIterations(self) -> int:
        """Get how many iterations the solver of the constraints has taken since then, those of trial steps among them.

        Returns
        -------
        int
            the number of iterations
        """
        return super().getNumSolverIterations()

    def isOnDevice(self) -> bool:
        """Tell whether the last step was taken by a GPU, on OpenCL, CUDA and HIP, and not on the host with forces from
        there, which is slow for large systems. The first step of a run always is the host's. What else is left to the
        host is in docs/gpu.md.

        Returns
        -------
        bool
            True if by a GPU; False on Reference and CPU, and before the first step
        """
        return super().isOnDevice()

    def setConstraintTolerance(self, tol: float) -> None:
        """Set the relative tolerance of the constraints. Default: 1e-8.

        For a distance it is a fraction of that distance. For a constraint g = 0 of addConstraint() it is a fraction of
        0.1 nm, about the length of a bond, and the error that is compared with it is the distance of the particles from
        where g = 0 holds, to first order: |g| over the Euclidean norm of the gradient of g with respect to the
        particles that have mass. It is therefore the same for g and for 1000 g.

        Parameters
        ----------
        tol : float
            the tolerance; positive and finite

        Raises
        ------
        OpenMMException
            if tol is not a positive finite number
        """
        super().setConstraintTolerance(number(tol, "tol"))

    def addConstraint(
        self,
        expression: str,
        particles: Iterable[int],
        parameters: Mapping[str, float | unit.Quantity] = {},
    ) -> int:
        """Add a constraint g = 0 to those of the System. g is an expression of the coordinates of some particles in nm,
        which are called x1, y1, z1 for the first particle, x2, y2, z2 for the second, and so on; and of parameters
        of this constraint, which have names.

        It has the syntax of OpenMM's custom forces: operators + - * / ^, their functions, and intermediate values
        defined after a semicolon. Derivatives are found symbolically. Constraints that have the same expression, with
        different particles and values of parameters, are evaluated together, which is much faster.

            integrator.addConstraint("r - r0; r = sqrt((x1-x2)^2 + (y1-y2)^2 + (z1-z2)^2)", [3, 7], {"r0": 0.3})

        Functions for the constraints that are asked for most are in openmmvrattle.constraints.

        The gradient of g must not vanish where g = 0: a point is kept on a sphere by r - r0 or by r^2 - r0^2, but
        not by (r - r0)^2. Coordinates are taken as they are, not as their nearest periodic images. A particle of
        mass zero is a fixed point; at least one of the particles must have mass, and none may be a virtual site.

        As with the System's constraints, positions that do not satisfy it are moved to the nearest ones that do, at
        the first step. OpenMM itself knows nothing of it: Context.applyConstraints() and
        applyVelocityConstraints() leave it alone, and a CompoundIntegrator's other integrators do not keep it. It
        works on every platform.

        A constraint that is added after the Context was created takes effect with Context.reinitialize(); until
        then steps raise an exception.

        Parameters
        ----------
        expression : str
            the expression g
        particles : list
            the indices of the particles
        parameters : dict
            the values of the parameters by name: Quantities, or numbers (in nm, ps, amu, kJ/mol, radian)

        Returns
        -------
        int
            the index of the constraint among those that were added

        Raises
        ------
        OpenMMException
            if the expression cannot be understood, contains anything but coordinates of the particles and the
            parameters, or a particle is named twice
        """
        return super().addConstraint(*constraint_arguments(expression, particles, parameters))

    def getExpressionConstraintParameters(self, index: int) -> tuple[str, list[int], dict[str, float]]:
        """Get what a constraint was added with.

        Parameters
        ----------
        index : int
            the index of the constraint

        Returns
        -------
        tuple
            the expression, the list of the particles, and the dict of the parameters, as numbers in OpenMM's units

        Raises
        ------
        OpenMMException
            if there is no constraint with this index
        """
        index = integer(index, "index")
        expression, particles = self._getExpression(index), list(self._getExpressionParticles(index))
        return expression, particles, dict(self._getExpressionParameters(index))

    def setExpressionConstraintParameters(
        self,
        index: int,
        expression: str,
        particles: Iterable[int],
        parameters: Mapping[str, float | unit.Quantity] = {},
    ) -> None:
        """Change a constraint.

        New values of its parameters are met by the next step, which moves the particles there; see
        setExpressionParameterValue(). Another expression, other particles or other names take effect with
        Context.reinitialize(), as for addConstraint().

        Parameters
        ----------
        index : int
            the index of the constraint
        expression : str
            the expression
        particles : list
            the indices of the particles
        parameters : dict
            the values of the parameters by name: Quantities, or numbers (in nm, ps, amu, kJ/mol, radian)

        Raises
        ------
        OpenMMException
            if there is no constraint with this index, or addConstraint() would refuse it
        """
        super().setExpressionConstraintParameters(
            integer(index, "index"), *constraint_arguments(expression, particles, parameters)
        )

    @classmethod
    def isinstance(cls, integrator: openmm.Integrator) -> bool:
        """Get whether an integrator is of this class, though Python may know it as a bare openmm.Integrator.

        Parameters
        ----------
        integrator : Integrator
            any integrator

        Returns
        -------
        bool
            whether cast() would take it
        """
        return isinstance(integrator, openmm.Integrator) and cls._isinstance(integrator)

    @classmethod
    def cast(cls, integrator: openmm.Integrator) -> Self:
        """Make what OpenMM has returned as a bare openmm.Integrator one of this class again.

        Parameters
        ----------
        integrator : Integrator
            for example from openmm.XmlSerializer.deserialize() or CompoundIntegrator.getIntegrator()

        Returns
        -------
        ConstrainedIntegrator
            the same Python object, whose class is now this one

        Raises
        ------
        TypeError
            if it is an integrator of another kind
        """
        if isinstance(integrator, cls):
            return integrator
        typed = cls._cast(integrator) if isinstance(integrator, openmm.Integrator) else None
        if typed is None:
            raise TypeError(f"a {type(integrator).__name__} is not a {cls.__name__}")
        typed.thisown = integrator.thisown
        integrator.thisown = False
        integrator.this = typed.this
        integrator.__class__ = cls
        return integrator

    def _attributes(self) -> dict[str, object]:
        """Return what Python code has attached to this integrator."""
        return {name: value for name, value in self.__dict__.items() if name != "this"}

    def __copy__(self) -> Self:
        duplicate = type(self).cast(openmm.XmlSerializer.clone(self))
        duplicate.__class__ = type(self)
        duplicate.__dict__.update(copy.deepcopy(self._attributes()))
        return duplicate

    def __deepcopy__(self, memo: dict) -> Self:
        return self.__copy__()

    def __getstate__(self) -> tuple[str, dict[str, object]]:
        return openmm.XmlSerializer.serialize(self), self._attributes()

    def __setstate__(self, state: tuple[str, dict[str, object]]) -> None:
        xml, attributes = state
        self.this = type(self).cast(openmm.XmlSerializer.deserialize(xml)).this
        self.__dict__.update(attributes)

    def step(self, steps: int) -> None:
        """Advance the simulation by a number of steps. KeyboardInterrupt ends it within 1000 of them.

        Parameters
        ----------
        steps : int
            the number of steps to take

        Raises
        ------
        OpenMMException
            if there is no Context, or a step cannot be completed; the Context is then in the state before that step
        """
        remaining = integer(steps, "steps")
        while remaining > _STEPS_AT_ONCE:
            super().step(_STEPS_AT_ONCE)
            remaining -= _STEPS_AT_ONCE
        super().step(remaining)


class VariableStepRattleIntegrator(ConstrainedIntegrator, vrattle.VariableStepRattleIntegrator):
    """An integrator for molecular dynamics with constraints: steps of variable size that are time-reversible.

    So the energy error stays bounded over long runs. It is the method VRATTLE of E. Barth, B. Leimkuhler and S. Reich,
    'A time-reversible variable-stepsize integrator for constrained dynamics' (SIAM J. Sci. Comput. 21, 1999); equation
    numbers below are that paper's.

    A monitor U(q,p) measures how hard the motion is to follow at the moment. The step density rho follows it by a
    symmetric recursion, by default (3.14),

        rho[n+1/2] + rho[n-1/2] = u(q[n],p[n+1/2]) + u(q[n],p[n-1/2]),      u = B(U/U_ref),

    and the size of the step is stepSize/rho. stepSize is thus the step that is taken where U has its reference value
    U_ref (see setReferenceMonitorValue()), and B keeps the step between two bounds (see setMaximumStepSize()). The
    default monitor is the Euclidean norm of the Lagrange multipliers of the constraints, the paper's U2 (4.4), and in a
    System without constraints ConstraintAndAppliedForce.

    For most uses let the integrator choose its steps without a monitor of yours: automatic=True in the constructor, or
    useAutomaticStepControl().

    Each step costs one evaluation of the forces, the one at its end. On top of these come: one at the start of a run,
    and after each change of the state by the user or by a Force that moves particles (a barostat), or of the parameters
    of a Force; one more where the first step is taken with a given reference value, since that step is then taken
    twice; one after loading a checkpoint or a State, to compare the forces with the saved ones; and the trial steps of
    calibrate(). A monitor ForceGroupEnergy costs the energy of its group on top of each. getNumForceEvaluations()
    counts all.

    The constraints are solved with a direct factorisation of the constraint matrix, so also bonds that are strongly
    coupled are met to the tolerance or the step fails with an exception; and the multipliers, that is the constraint
    forces, can be read with getMultipliers().

    The velocities in the Context belong to the same time as the positions, and satisfy the velocity constraints:
    kinetic plus potential energy of a State is the energy at that time. Forces that depend on the time or the step
    count see those of the end of the step when they are computed there.

    A step that cannot be completed raises an OpenMMException and leaves the Context in the state before that step: a
    run that goes on from there, with other settings perhaps, is the one that it would be if that step had never been
    tried.

    OpenMM's XmlSerializer stores all settings; copies and pickles have the settings too, and no Context. Checkpoints,
    and States made with integratorParameters=True, store the settings and everything else that the next step depends
    on, and loading one brings all of it back, the settings as well: a run that goes on from a checkpoint is the same to
    the last bit on the Reference platform, and from a State to rounding. At the first step after that the forces are
    computed once more. If they are not those of the saved run, because a Force has been changed in the meantime, or if
    a State's positions, velocities, box vectors or parameters are not the Context's (positions were wrapped into the
    periodic box, say), the run starts afresh with the saved reference values. States and checkpoints that were written
    under another integrator load as well: positions, velocities, time and parameters are taken, the settings stay as
    they are, and the run starts afresh.

    OpenMM's own functions that return an integrator, openmm.XmlSerializer.deserialize() and
    CompoundIntegrator.getIntegrator(), return one of ours as a bare openmm.Integrator; cast() makes it a
    VariableStepRattleIntegrator, and openmmvrattle.XmlSerializer does so by itself.

    Drude particles are refused, for they need an integrator that keeps them at their energy minimum or at a temperature
    of their own, such as OpenMM's DrudeSCFIntegrator and DrudeNoseHooverIntegrator. Ring polymers (RPMD) are the matter
    of OpenMM's RPMDIntegrator, which takes the place of this one.

    Update methods, for setUpdateMethod(). All are symmetric in time.

     - SemiExplicit (3.14): rho + rho' = u(q,p+) + u(q,p-), solved together with the constraints. The default.
     - Explicit (3.15): rho + rho' = 2 u(q,p), known before the constraints are solved.
     - Bounded: f(rho) + f(rho') = 2 f(u(q,p)) with f(rho) = (rho-a) - (1-a)^2/(rho-a) and a = nominal/maximum step:
       every step stays strictly below the maximum step size and no density is ever zero or negative.

    Kinds of monitor, for addMonitor(). F is the applied force, v the velocity, m the mass, K = G M^-1 G^T.

     - ConstraintMultipliers: U2 (4.4), the Euclidean norm of the multipliers Lambda(q,p), in kJ/mol/nm^2.
     - ConstraintForce: the mass-weighted constraint force sqrt(Lambda^T K Lambda) of Gauss's principle, in nm
       amu^(1/2)/ps^2.
     - AppliedForce: the mass-weighted applied force sqrt(sum |F|^2/m), in nm amu^(1/2)/ps^2.
     - ConstraintAndAppliedForce: sqrt(Lambda^T K Lambda + sum |F|^2/m), in nm amu^(1/2)/ps^2.
     - MultiplierPNorm: the p-norm of the multipliers, in kJ/mol/nm^2; see addMonitor().
     - ForcePNorm: the p-norm over the particles of |F|, in kJ/mol/nm; see addMonitor().
     - VectorField: U1 (4.1), sqrt(sum m |v|^2 + sum |F|^2), in OpenMM's units.
     - MaxForce: the largest |F| of any particle, in kJ/mol/nm.
     - ArcLength: the speed along the unconstrained trajectory in phase space, sqrt(sum |v|^2 + sum |F|^2).
     - MaxParticleArcLength: the largest sqrt(|v|^2 + |F|^2) of any particle.
     - ForceGroupEnergy: the potential energy of one force group, in kJ/mol; see setMonitorForceGroup().

    Wrong values raise an openmm.OpenMMException; arguments of a wrong type or unit raise a TypeError.
    """

    SemiExplicit: int = vrattle.VariableStepRattleIntegrator.SemiExplicit
    Explicit: int = vrattle.VariableStepRattleIntegrator.Explicit
    Bounded: int = vrattle.VariableStepRattleIntegrator.Bounded
    ConstraintMultipliers: int = vrattle.VariableStepRattleIntegrator.ConstraintMultipliers
    ConstraintForce: int = vrattle.VariableStepRattleIntegrator.ConstraintForce
    AppliedForce: int = vrattle.VariableStepRattleIntegrator.AppliedForce
    ConstraintAndAppliedForce: int = vrattle.VariableStepRattleIntegrator.ConstraintAndAppliedForce
    MultiplierPNorm: int = vrattle.VariableStepRattleIntegrator.MultiplierPNorm
    ForcePNorm: int = vrattle.VariableStepRattleIntegrator.ForcePNorm
    VectorField: int = vrattle.VariableStepRattleIntegrator.VectorField
    MaxForce: int = vrattle.VariableStepRattleIntegrator.MaxForce
    ArcLength: int = vrattle.VariableStepRattleIntegrator.ArcLength
    MaxParticleArcLength: int = vrattle.VariableStepRattleIntegrator.MaxParticleArcLength
    ForceGroupEnergy: int = vrattle.VariableStepRattleIntegrator.ForceGroupEnergy

    _has_warned = False  # of short steps
    _has_compared = False  # the nominal step size with what is usual

    def __init__(
        self,
        stepSize: float | unit.Quantity,
        updateMethod: int | None = None,
        minimumStepSize: float | unit.Quantity | None = None,
        maximumStepSize: float | unit.Quantity | None = None,
        constraintTolerance: float | None = None,
        monitors: Sequence[int | tuple[int, float, float] | tuple[int, float, float, float]] | None = None,
        referenceMonitorValue: float | None = None,
        normOrder: float | None = None,
        monitorForceGroup: int | None = None,
        automatic: bool | None = None,
    ) -> None:
        """Create a VariableStepRattleIntegrator.

        Apart from stepSize, every argument can be set later by the method of the same name, and None leaves its
        default.

        Parameters
        ----------
        stepSize : float or Quantity
            the nominal step size, taken where the monitor has its reference value (in ps). With 0 no step can be
            taken, which will do for a Context that computes energies
        updateMethod : int
            the recursion of the step density: SemiExplicit (the default), Explicit or Bounded
        minimumStepSize : float or Quantity
            the smallest step size the monitor can ask for (in ps); 0 means no bound. Default: 1/50 of stepSize, and
            1/1000 of it if automatic
        maximumStepSize : float or Quantity
            the largest step size the monitor can ask for (in ps); 0 means no bound. Default: twice stepSize
        constraintTolerance : float
            the relative tolerance of the constraints, see setConstraintTolerance(). Default: 1e-8
        monitors : list
            the monitors in place of the default one, ConstraintMultipliers: each a kind, or a tuple (kind, weight,
            power) or (kind, weight, power, order). The empty list means fixed steps: plain RATTLE
        referenceMonitorValue : float
            the value of the first monitor at which the nominal step is taken; 0 (the default) means that it is taken at
            the first step
        normOrder : float
            the order p of the monitors MultiplierPNorm and ForcePNorm that have none of their own. Default: 8
        monitorForceGroup : int
            the force group whose energy is the monitor ForceGroupEnergy. Default: 31
        automatic : bool
            whether the integrator chooses its steps by itself, see useAutomaticStepControl(); then updateMethod,
            maximumStepSize, monitors and referenceMonitorValue must not be given

        Raises
        ------
        ValueError
            if automatic is True and one of the arguments is given that it takes the place of
        """
        automatic = automatic is not None and boolean(automatic, "automatic")
        excluded = {
            "updateMethod": updateMethod,
            "maximumStepSize": maximumStepSize,
            "monitors": monitors,
            "referenceMonitorValue": referenceMonitorValue,
        }
        for name, value in excluded.items():
            if automatic and value is not None:
                raise ValueError(f"automatic step control takes the place of {name}; give one of the two")
        super().__init__(number(stepSize, "stepSize", _TIME))
        if updateMethod is not None:
            self.setUpdateMethod(updateMethod)
        if minimumStepSize is not None:
            self.setMinimumStepSize(minimumStepSize)
        if maximumStepSize is not None:
            self.setMaximumStepSize(maximumStepSize)
        if constraintTolerance is not None:
            self.setConstraintTolerance(constraintTolerance)
        if normOrder is not None:
            super().setNormOrder(number(normOrder, "normOrder"))
        if monitorForceGroup is not None:
            self.setMonitorForceGroup(monitorForceGroup)
        if monitors is not None:
            each = monitor_arguments(monitors)
            self.clearMonitors()
            for arguments in each:
                self.addMonitor(*arguments)
        if referenceMonitorValue is not None:
            self.setReferenceMonitorValue(referenceMonitorValue)
        if automatic:
            self.useAutomaticStepControl()

    def getNominalStepSize(self) -> unit.Quantity:
        """Get the nominal step size: the step taken where the monitor has its reference value.

        Returns
        -------
        Quantity
            the nominal step size in picoseconds
        """
        return unit.Quantity(super().getNominalStepSize(), _TIME)

    def getUsualStepSize(self) -> unit.Quantity:
        """Get the step size that is usual for the masses of the System: 1 fs for a lightest particle of 1 amu, in
        proportion to the root of its mass.

        A warning says so once if the nominal step size is less than a thousandth of it at a first step, since it may
        have been meant as an error tolerance, which is what VariableVerletIntegrator takes.

        Returns
        -------
        Quantity
            the step size in picoseconds; 0 while there is no Context, or if no particle has a mass
        """
        return unit.Quantity(super().getUsualStepSize(), _TIME)

    def setNominalStepSize(self, size: float | unit.Quantity) -> None:
        """Set the nominal step size: the step taken where the monitor has its reference value.

        Where step bounds have been set it must lie between them when the next step is taken; the three can be set in
        any order. In the course of a run the density is kept, so the steps change in proportion, but for what the
        bounds say that have been set.

        Parameters
        ----------
        size : float or Quantity
            the nominal step size (in ps); 0 where no step is to be taken

        Raises
        ------
        OpenMMException
            if size is negative or not finite
        """
        super().setNominalStepSize(number(size, "size", _TIME))

    def getStepSize(self) -> unit.Quantity:
        """Get the size of the most recent step; before the first step, and when the nominal step size has been set
        since, the nominal one.

        Returns
        -------
        Quantity
            the step size in picoseconds
        """
        return unit.Quantity(super().getStepSize(), _TIME)

    def setStepSize(self, size: float | unit.Quantity) -> None:
        """The same as setNominalStepSize(), so that scripts written for a fixed step keep working.

        Parameters
        ----------
        size : float or Quantity
            the nominal step size (in ps); 0 where no step is to be taken

        Raises
        ------
        OpenMMException
            if size is negative or not finite
        """
        super().setStepSize(number(size, "size", _TIME))

    def getMinimumStepSize(self) -> unit.Quantity:
        """Get the smallest step size the monitor can ask for.

        Returns
        -------
        Quantity
            the bound in picoseconds, 0 if there is none
        """
        return unit.Quantity(super().getMinimumStepSize(), _TIME)

    def setMinimumStepSize(self, size: float | unit.Quantity) -> None:
        """Set the smallest step size the monitor can ask for.

        With the sum updates SemiExplicit and Explicit, rho oscillates slightly about u and steps may leave the bounds
        by as much; where the motion is not resolved they may leave them by more. With automatic step control no step is
        ever smaller. Default: 1/50 of the nominal step size, and 1/1000 with automatic step control.

        Parameters
        ----------
        size : float or Quantity
            the bound (in ps); 0 means no bound. It must be smaller than the nominal step size when the next step is
            taken

        Raises
        ------
        OpenMMException
            if size is negative or not finite
        """
        super().setMinimumStepSize(number(size, "size", _TIME))

    def getMaximumStepSize(self) -> unit.Quantity:
        """Get the largest step size the monitor can ask for.

        Returns
        -------
        Quantity
            the bound in picoseconds, 0 if there is none
        """
        return unit.Quantity(super().getMaximumStepSize(), _TIME)

    def setMaximumStepSize(self, size: float | unit.Quantity) -> None:
        """Set the largest step size the monitor can ask for; see setMinimumStepSize().

        With the update Bounded no step is ever larger, with the others a step of more than twice the bound is rescued
        (see getNumRescues()). Default: twice the nominal step size.

        Parameters
        ----------
        size : float or Quantity
            the bound (in ps); 0 means no bound. It must be larger than the nominal step size when the next step is
            taken

        Raises
        ------
        OpenMMException
            if size is negative or not finite
        """
        super().setMaximumStepSize(number(size, "size", _TIME))

    def getUpdateMethod(self) -> int:
        """Get the recursion of the step density.

        Returns
        -------
        int
            SemiExplicit, Explicit or Bounded
        """
        return super().getUpdateMethod()

    def setUpdateMethod(self, method: int) -> None:
        """Set the recursion of the step density.

        Parameters
        ----------
        method : int
            SemiExplicit (the default), Explicit or Bounded

        Raises
        ------
        OpenMMException
            if there is no such method
        """
        super().setUpdateMethod(integer(method, "method"))

    def addMonitor(self, kind: int, weight: float = 1.0, power: float = 1.0, order: float = 0.0) -> int:
        """Add a monitor.

        Several monitors are combined, each relative to its own reference value, as u = sqrt(sum_k (w_k
        (U_k/U_k,ref)^power_k)^2 / sum_k w_k^2).

        Parameters
        ----------
        kind : int
            what the monitor measures: one of the constants in the description of this class
        weight : float
            its weight w_k > 0 in the combination; of no effect on a single monitor
        power : float
            the positive power to which U_k/U_k,ref is raised
        order : float
            the order p, at least 1, of MultiplierPNorm and ForcePNorm; of no meaning to others. 0 stands for
            getNormOrder(), which is 8

        Returns
        -------
        int
            the index of the monitor

        Raises
        ------
        OpenMMException
            if there is no such kind, or weight or power is not a positive finite number, or order is below 1
        """
        return super().addMonitor(
            integer(kind, "kind"), number(weight, "weight"), number(power, "power"), number(order, "order")
        )

    def getMonitorNormOrder(self, index: int) -> float:
        """Get the order p of a monitor, which is that of a norm if it is MultiplierPNorm or ForcePNorm.

        Parameters
        ----------
        index : int
            the index of the monitor

        Returns
        -------
        float
            the order
        """
        return super().getMonitorNormOrder(integer(index, "index"))

    def clearMonitors(self) -> None:
        """Remove all monitors, and end automatic step control. With none the step is fixed at the nominal size: plain
        RATTLE (3.1-3.5)."""
        super().clearMonitors()

    def getNumMonitors(self) -> int:
        """Get the number of monitors.

        Returns
        -------
        int
            the number of monitors
        """
        return super().getNumMonitors()

    def getMonitor(self, index: int) -> tuple[int, float, float]:
        """Get the settings of a monitor.

        Parameters
        ----------
        index : int
            the index of the monitor

        Returns
        -------
        tuple
            (kind, weight, power): what the monitor measures, its weight in the combination, and the power to which it
            is raised

        Raises
        ------
        OpenMMException
            if there is no monitor with this index
        """
        return tuple(super().getMonitor(integer(index, "index")))

    def getMonitorForceGroup(self) -> int:
        """Get the force group whose energy the monitor ForceGroupEnergy uses.

        Returns
        -------
        int
            the force group
        """
        return super().getMonitorForceGroup()

    def setMonitorForceGroup(self, group: int) -> None:
        """Set the force group whose potential energy is the monitor ForceGroupEnergy: a positive function of the
        positions that is written as an OpenMM Force.

        While such a monitor exists, the group is left out of the dynamics, and getIntegrationForceGroups() does not
        contain it: it is no part of the energy.

        Parameters
        ----------
        group : int
            the force group, between 0 and 31. Default: 31

        Raises
        ------
        OpenMMException
            if group does not lie between 0 and 31
        """
        super().setMonitorForceGroup(integer(group, "group"))

    def useAutomaticStepControl(self, calibrationSteps: int = 30) -> None:
        """Let the integrator choose its steps by itself: the setting for most uses.

        It takes steps of the nominal size while nothing out of the ordinary happens, and shorter ones when something
        does, by two monitors of its own (docs/automatic.md):

         - 0, U_A, on each step: the size of the net force, applied and of constraints, of the hardest clusters of
           particles, and of the applied forces times the squared speeds, in nm amu^(1/2)/ps^2;
         - 1, U_B, of each step between: from the change of the forces along it, the second time derivative of the
           potential energy, in the same unit.

        They take the place of the monitors, which are removed, and of the update and the maximum step size, which have
        no effect then: no step is ever larger than 4/3 of the nominal one, and none smaller than the minimum step size,
        by default 1/1000 of the nominal one. clearMonitors() and addMonitor() end it. getMonitorValue(),
        getReferenceMonitorValue() and setReferenceMonitorValue() have the indices 0 and 1.

        The first steps have the nominal size, and the geometric means of the monitors over them become their reference
        values, unless these have been set; getReferenceMonitorValue() is 0 until then. Steps in which nothing moves and
        nothing pulls do not count. A start in a clash is seen at once. At constant energy the reference values then
        stay what they are, so that the run is reversible; where Forces change the state (a thermostat, a barostat) they
        follow it, and where velocities are set that are more than twice as large (four times the kinetic energy) they
        are found anew, as when this is called again. No step costs more than one evaluation of the forces.

        A run that takes 1000 steps in a row that are shorter than a tenth of the nominal size says so once, with a
        warning: something is hard all the time, or the reference values belong to calmer times, and then calling this
        again finds new ones. See getNumShortSteps().

        Parameters
        ----------
        calibrationSteps : int
            the number of first steps that the reference values are found from, at least 1

        Raises
        ------
        OpenMMException
            if calibrationSteps is not positive
        """
        super().useAutomaticStepControl(integer(calibrationSteps, "calibrationSteps"))

    def isAutomatic(self) -> bool:
        """Get whether the automatic step control is in use.

        Returns
        -------
        bool
            whether useAutomaticStepControl() was called, and neither clearMonitors() nor addMonitor() since
        """
        return super().isAutomatic()

    def getCalibrationSteps(self) -> int:
        """Get from how many first steps the automatic step control finds its reference values, as it was set last.

        Returns
        -------
        int
            the number of steps
        """
        return super().getCalibrationSteps()

    def getNormOrder(self) -> float:
        """Get the order that addMonitor() gives to monitors that are added without one.

        Deprecated: use getMonitorNormOrder().

        Returns
        -------
        float
            the order
        """
        _deprecated("getNormOrder()", "getMonitorNormOrder()")
        return super().getNormOrder()

    def setNormOrder(self, order: float) -> None:
        """Set the order p of all monitors MultiplierPNorm and ForcePNorm, also of those that are added later without
        one.

        Deprecated: give it to addMonitor().

        Parameters
        ----------
        order : float
            the order, at least 1. Default: 8

        Raises
        ------
        OpenMMException
            if order is not a finite number of at least 1
        """
        _deprecated("setNormOrder()", "the argument order of addMonitor()")
        super().setNormOrder(number(order, "order"))

    def getReferenceMonitorValue(self, index: int = 0) -> float:
        """Get the reference value U_ref of a monitor: where U equals it, the nominal step size is taken.

        Parameters
        ----------
        index : int
            the index of the monitor

        Returns
        -------
        float
            the value in force, in the monitor's unit; 0 if none was set and no step has been taken that could tell

        Raises
        ------
        OpenMMException
            if there is no monitor with this index
        """
        return super().getReferenceMonitorValue(integer(index, "index"))

    def setReferenceMonitorValue(self, value: float, index: int = 0) -> None:
        """Set the reference value U_ref of a monitor. 0 (the default) means that it is taken at the first step: the
        first step then has the nominal size, and U_ref is the value of U that makes the sequence of densities start
        without oscillation, which is U at the start up to the change of U over a half step.

        While the monitor is zero but for rounding, as that of the constraint forces where nothing pulls and nothing
        turns, it asks for nothing: steps have the nominal size, and the reference value is taken at the first step
        after that; and while it grows more than fivefold in a step, as that of the applied forces at a minimum of the
        energy, it is no measure either. Where that is no good measure for the rest of the run, set one, or call
        calibrate() later.

        Parameters
        ----------
        value : float
            the reference value in the monitor's unit, or 0
        index : int
            the index of the monitor

        Raises
        ------
        OpenMMException
            if value is negative or not finite, or there is no monitor with this index
        """
        super().setReferenceMonitorValue(number(value, "value"), integer(index, "index"))

    def calibrate(self, steps: int) -> None:
        """Set the reference value of every monitor to its mean over a trial run of fixed steps of the nominal size, or
        of the two of automatic step control to their geometric means.

        The trial run starts at the current state of the Context, and everything but the reference values and the number
        of force evaluations is put back as it was.

        Parameters
        ----------
        steps : int
            the number of trial steps

        Raises
        ------
        OpenMMException
            if steps is not positive, there is no monitor and no automatic step control, there is no Context, or a trial
            step fails
        """
        super().calibrate(integer(steps, "steps"))

    def getStepDensity(self) -> float:
        """Get the step density rho of the last step; 1 before the first step.

        Returns
        -------
        float
            the step density
        """
        return super().getStepDensity()

    def getMonitorValue(self, index: int = 0) -> float:
        """Get the value U_k(q,p) of a monitor at the current positions and velocities.

        Before the first step this computes the forces. With automatic step control monitor 1 is that of the last step,
        and 0 before the first one.

        Parameters
        ----------
        index : int
            the index of the monitor

        Returns
        -------
        float
            the value, in the unit given with the monitor's kind

        Raises
        ------
        OpenMMException
            if there is no monitor with this index, or no Context
        """
        return super().getMonitorValue(integer(index, "index"))

    def setExpressionConstraintParameter(self, index: int, name: str, value: float | unit.Quantity) -> None:
        """The same as setExpressionParameterValue().

        Deprecated: the name is too much like setExpressionConstraintParameters().

        Parameters
        ----------
        index : int
            the index of the constraint
        name : str
            the name of the parameter
        value : float or Quantity
            its new value (in nm, ps, amu, kJ/mol, radian if it is a number)

        Raises
        ------
        OpenMMException
            if there is no constraint with this index, or it has no such parameter, or the value is not finite
        """
        _deprecated("setExpressionConstraintParameter()", "setExpressionParameterValue()")
        self.setExpressionParameterValue(index, name, value)

    def getNumRescues(self) -> int:
        """Get how many steps since the Context was created had to be rescued: the sum update gave no positive density,
        a step of more than twice the maximum, or equations that could not be solved, and the density of the update
        Bounded was taken for that one step.

        The run goes on, but it is not exactly reversible across a rescued step. A number that grows says that the
        nominal step size is too large.

        Returns
        -------
        int
            the number of rescued steps
        """
        return super().getNumRescues()

    def getNumShortSteps(self) -> int:
        """Get the most steps in a row that automatic step control has made shorter than a tenth of the nominal size
        since the Context was created.

        Returns
        -------
        int
            the number of steps
        """
        return super().getNumShortSteps()

    def step(self, steps: int) -> None:
        """Advance the simulation by a number of steps. KeyboardInterrupt ends it within 1000 of them.

        Parameters
        ----------
        steps : int
            the number of steps to take

        Raises
        ------
        OpenMMException
            if there is no Context, or a step cannot be completed; the Context is then in the state before that step
        """
        remaining = integer(steps, "steps")
        self._compare_with_what_is_usual()
        while remaining > _STEPS_AT_ONCE:
            super().step(_STEPS_AT_ONCE)
            remaining -= _STEPS_AT_ONCE
            self._warn_of_short_steps()
        super().step(remaining)
        self._warn_of_short_steps()

    def stepTo(self, time: float | unit.Quantity) -> None:
        """Advance the simulation until a given time, which is met exactly by a shortened last step.

        The step density goes on smoothly after it, but the shortened step is not part of the reversible sequence: to
        retrace a run, use step(). A time earlier than the current one does nothing.

        Parameters
        ----------
        time : float or Quantity
            the time to which the simulation is advanced (in ps)

        Raises
        ------
        OpenMMException
            if time is not finite, there is no Context, or a step cannot be completed; the Context is then in the state
            before that step
        """
        end = number(time, "time", _TIME)
        self._compare_with_what_is_usual()
        super().stepTo(end)
        self._warn_of_short_steps()

    def _compare_with_what_is_usual(self) -> None:
        if self._has_compared:
            return
        size, usual = super().getNominalStepSize(), super().getUsualStepSize()
        self._has_compared = usual > 0
        if 0 < size < usual / 1000:
            warnings.warn(
                f"VariableStepRattleIntegrator: the nominal step size ({size:g} ps) is less than a thousandth of what "
                f"is usual for the masses of this System ({usual:.2g} ps); its argument is a step in ps, and not an "
                "error tolerance as that of VariableVerletIntegrator",
                stacklevel=3,
            )

    def _warn_of_short_steps(self) -> None:
        if self._has_warned or not self.isAutomatic() or super().getNumShortSteps() < _MANY_SHORT_STEPS:
            return
        self._has_warned = True
        warnings.warn(
            f"VariableStepRattleIntegrator: automatic step control has taken {_MANY_SHORT_STEPS} steps in a row that "
            f"are shorter than a tenth of the nominal step size; look whether the total energy has risen, as it does "
            f"with a nominal step that is too large for the System; if not, and nothing is that hard here, find new "
            f"reference values with useAutomaticStepControl(), or bound the steps with setMinimumStepSize()",
            stacklevel=3,
        )

    def reverse(self) -> None:
        """Turn time around: the velocities change sign, and the half-step momentum and the density become those of the
        step that would have come next, so that the following steps retrace the trajectory.

        No force is computed, and the Context's time goes on forward.

        Raises
        ------
        OpenMMException
            if there is no Context, or the step that would have come next cannot be solved for
        """
        super().reverse()


class VariableStepRattleLangevinIntegrator(ConstrainedIntegrator, vrattle.VariableStepRattleLangevinIntegrator):
    """An integrator for Langevin dynamics, so at constant temperature, with constraints.

    It is used as OpenMM's LangevinMiddleIntegrator, samples what that one samples while all is calm, and goes through
    clashes, bad starts and the one bad moment of a step that is otherwise not too large, where others end with
    'Particle coordinate is NaN'.

    All steps have the size H = stepSize and count the same, so that averages and reporters need know nothing. A step is
    g-BAOAB (B. Leimkuhler and C. Matthews, 'Efficient molecular dynamics using geodesic integration and solvent-solute
    splitting', Proc. R. Soc. A 472, 2016) with one evaluation of the forces: half a kick, half a drift on the
    constraints, friction and noise, half a drift, half a kick. When something is hard, and only then, it is made of n =
    2^k + 1 reversible substeps of RATTLE of the size H/n, with friction and noise in the middle of the central one, and
    the same noise whatever n is: n evaluations of the forces.

    What is hard is measured by U = (sum_c A_c^4)^(1/8), A_c = sum_i (|f_i|^2/m_i + |f_i| |v_i|^2/l) over the particles
    of a cluster c that constraints join, f being the net force, applied and of constraints, and l = 0.0125 nm. k is the
    smallest number with 2^k >= (U/U_ref)^(2/3)/2.2, chosen at the beginning of a step and made larger if the end of the
    step asks for it, or if its equations could not be solved. U_ref is a running median of U, which changes by 0.2 % a
    step and is no less than what thermal motion must have: see setReferenceMonitorValue().

    It is no minimiser: the heat of a clash is real, and leaves at the rate of the friction. And a calm system gains
    nothing from it.

    The velocities in the Context belong to the same time as the positions and satisfy the velocity constraints. A
    vibration of frequency w has the variance kT (1 - (w H)^2/4) in them, so a temperature made by hand from
    getVelocities() is lower than the one asked for, by 1.5 % for rigid water at 4 fs. The kinetic energy of a State,
    and the temperature that OpenMM's reporters print, is that of the velocities half a substep before, which has no
    such error.

    The constraints are solved with a direct factorisation of the constraint matrix, so also bonds that are strongly
    coupled are met to the tolerance; and the multipliers, that is the constraint forces, can be read with
    getMultipliers(). Constraints may also be given as expressions with addConstraint().

    A step that cannot be completed with getMaximumSubsteps() substeps raises an OpenMMException and leaves the Context
    in the state before that step.

    OpenMM's XmlSerializer stores all settings; copies and pickles have the settings too, and no Context. Checkpoints
    store the settings and everything else that the next step depends on, the random numbers to come and U_ref among
    them: a run that goes on from one is the same to the last bit on the Reference platform. So do States made with
    integratorParameters=True, but for the random seed: several runs that go on from one State each have the noise of
    their own integrator.

    OpenMM's own functions that return an integrator, openmm.XmlSerializer.deserialize() and
    CompoundIntegrator.getIntegrator(), return one of ours as a bare openmm.Integrator; cast() makes it a
    VariableStepRattleLangevinIntegrator, and openmmvrattle.XmlSerializer does so by itself.

    Wrong values raise an openmm.OpenMMException; arguments of a wrong type or unit raise a TypeError.
    """

    def __init__(
        self,
        temperature: float | unit.Quantity,
        frictionCoeff: float | unit.Quantity,
        stepSize: float | unit.Quantity,
        constraintTolerance: float | None = None,
        randomNumberSeed: int | None = None,
    ) -> None:
        """Create a VariableStepRattleLangevinIntegrator.

        Parameters
        ----------
        temperature : float or Quantity
            the temperature of the heat bath (in K); not negative
        frictionCoeff : float or Quantity
            the friction coefficient that couples the system to it (in 1/ps); not negative. With 0 the dynamics is that
            of constant energy
        stepSize : float or Quantity
            the size of a step (in ps). With 0 no step can be taken, which will do for a Context that computes energies
        constraintTolerance : float
            the relative tolerance of the constraints, see setConstraintTolerance(). Default: 1e-8
        randomNumberSeed : int
            the random number seed, see setRandomNumberSeed(). Default: 0, for another one in each Context
        """
        super().__init__(
            number(temperature, "temperature", unit.kelvin),
            number(frictionCoeff, "frictionCoeff", _FRICTION),
            number(stepSize, "stepSize", _TIME),
        )
        if constraintTolerance is not None:
            self.setConstraintTolerance(constraintTolerance)
        if randomNumberSeed is not None:
            self.setRandomNumberSeed(randomNumberSeed)

    def getTemperature(self) -> unit.Quantity:
        """Get the temperature of the heat bath.

        Returns
        -------
        Quantity
            the temperature in kelvins
        """
        return unit.Quantity(super().getTemperature(), unit.kelvin)

    def setTemperature(self, temp: float | unit.Quantity) -> None:
        """Set the temperature of the heat bath.

        Parameters
        ----------
        temp : float or Quantity
            the temperature of the heat bath (in K); not negative

        Raises
        ------
        OpenMMException
            if temp is negative or not finite
        """
        super().setTemperature(number(temp, "temp", unit.kelvin))

    def getFriction(self) -> unit.Quantity:
        """Get the friction coefficient that couples the system to the heat bath.

        Returns
        -------
        Quantity
            the friction coefficient in 1/picoseconds
        """
        return unit.Quantity(super().getFriction(), _FRICTION)

    def setFriction(self, coeff: float | unit.Quantity) -> None:
        """Set the friction coefficient that couples the system to the heat bath.

        Parameters
        ----------
        coeff : float or Quantity
            the friction coefficient (in 1/ps); not negative

        Raises
        ------
        OpenMMException
            if coeff is negative or not finite
        """
        super().setFriction(number(coeff, "coeff", _FRICTION))

    def getRandomNumberSeed(self) -> int:
        """Get the random number seed, as it was set. See setRandomNumberSeed() for details.

        Returns
        -------
        int
            the seed
        """
        return super().getRandomNumberSeed()

    def setRandomNumberSeed(self, seed: int) -> None:
        """Set the random number seed.

        Two runs with the same seed that start alike have the same noise; with different seeds it is independent. With
        0, the default, each Context has a seed of its own. The noise of a particle is a function of the seed, the
        number of steps that were taken since it came into force, and the index of the particle.

        Parameters
        ----------
        seed : int
            the seed
        """
        super().setRandomNumberSeed(integer(seed, "seed"))

    def setStepSize(self, size: float | unit.Quantity) -> None:
        """Set the size of a step, whatever number of substeps it is made of.

        Parameters
        ----------
        size : float or Quantity
            the step size (in ps); 0 where no step is to be taken

        Raises
        ------
        OpenMMException
            if size is negative or not finite
        """
        super().setStepSize(number(size, "size", _TIME))

    def getMaximumSubsteps(self) -> int:
        """Get the most substeps that a step may be made of.

        Returns
        -------
        int
            the number of substeps
        """
        return super().getMaximumSubsteps()

    def setMaximumSubsteps(self, substeps: int) -> None:
        """Set the most substeps that a step may be made of: 2^k + 1, with k up to 20; or 1, so that no step has any.

        A step that asks for more is tried with that many, and accepted if all numbers are finite. Default: 1025

        Parameters
        ----------
        substeps : int
            the number of substeps: 1, 3, 5, 9, 17, ...

        Raises
        ------
        OpenMMException
            if it is none of these numbers
        """
        super().setMaximumSubsteps(integer(substeps, "substeps"))

    def getNumSubstepped(self) -> int:
        """Get how many steps have been made of substeps since the Context was created.

        Returns
        -------
        int
            the number of steps
        """
        return super().getNumSubstepped()

    def getLargestSubsteps(self) -> int:
        """Get the largest number of substeps that a step has been made of since the Context was created.

        Returns
        -------
        int
            the number of substeps; 1 if no step had any
        """
        return super().getLargestSubsteps()

    def getReferenceMonitorValue(self) -> float:
        """Get the reference value U_ref of the monitor.

        Returns
        -------
        float
            the value in force, in nm amu^(1/2)/ps^2; 0 if none was set and no step has been taken that could tell
        """
        return super().getReferenceMonitorValue()

    def setReferenceMonitorValue(self, value: float) -> None:
        """Set the reference value U_ref of the monitor, which then stays what it is.

        With 0, the default, it follows the run, as a running median: by 0.2 % a step up where U is larger, and down
        where it is smaller, but no lower than max(1/2, S/5) sqrt(kT)/H, S = (sum_c N_c^4)^(1/8) with the numbers N_c of
        particles of the clusters, and with the kT of 10 K below that temperature. It begins as U at the first step, or
        four times that bound if that is less.

        Parameters
        ----------
        value : float
            the reference value (in nm/ps^2 amu^(1/2)), or 0

        Raises
        ------
        OpenMMException
            if value is negative or not finite
        """
        super().setReferenceMonitorValue(number(value, "value"))

    def freezeReference(self, frozen: bool) -> None:
        """Set whether U_ref stays what it is at the moment. Then the number of substeps depends on the state alone.

        Parameters
        ----------
        frozen : bool
            whether it stays; if not, it follows the run, unless a value was set. Default: False
        """
        super().freezeReference(boolean(frozen, "frozen"))

    def isReferenceFrozen(self) -> bool:
        """Get whether freezeReference() has been called to keep U_ref.

        Returns
        -------
        bool
            whether it stays what it is
        """
        return super().isReferenceFrozen()

    def getMonitorValue(self) -> float:
        """Get the value U(q,p) of the monitor at the current positions and velocities.

        Before the first step this computes the forces.

        Returns
        -------
        float
            the value in nm amu^(1/2)/ps^2

        Raises
        ------
        OpenMMException
            if there is no Context
        """
        return super().getMonitorValue()
