# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""The Python wrapper of VariableStepRattleIntegrator: signatures, documentation, units, constants and errors.

What the integrator computes is tested elsewhere; here it matters that Python passes it on unchanged.
"""

import gc
import inspect
import math
import signal
import threading

import numpy as np
import openmm
import pytest
from openmm import app, unit
from openmmvrattle import VariableStepRattleIntegrator, VariableStepRattleLangevinIntegrator
from openmmvrattle.integrators import ConstrainedIntegrator

pytestmark = pytest.mark.filterwarnings("ignore:.etNormOrder:DeprecationWarning")

MULTIPLIER_UNIT = unit.kilojoule_per_mole / unit.nanometer**2
PLATFORMS = ["Reference", "CPU"]

# Named in C++ in VariableStepRattleIntegrator.h, with the same numbers.
UPDATE_METHODS = {"SemiExplicit": 0, "Explicit": 1, "Bounded": 2}
MONITOR_KINDS = {
    "ConstraintMultipliers": 0,
    "ConstraintForce": 1,
    "AppliedForce": 2,
    "ConstraintAndAppliedForce": 3,
    "MultiplierPNorm": 4,
    "ForcePNorm": 5,
    "VectorField": 6,
    "MaxForce": 7,
    "ArcLength": 8,
    "MaxParticleArcLength": 9,
    "ForceGroupEnergy": 10,
}
PUBLIC_METHODS = [
    name
    for each in (ConstrainedIntegrator, VariableStepRattleIntegrator)
    for name, member in vars(each).items()
    if inspect.isfunction(member) and not name.startswith("_")
]

BOND_LENGTH = 0.1
ANGULAR_VELOCITY = 5.0


def rotating_dumbbell():
    """Two particles of 1 amu on a rigid bond that turns about its middle: a system whose multiplier is known.

    The centripetal force m w^2 d/2 on each is the bond's tension 2 Lambda d, so Lambda = m w^2/4.
    """
    system = openmm.System()
    system.addParticle(1.0)
    system.addParticle(1.0)
    system.addConstraint(0, 1, BOND_LENGTH)
    speed = ANGULAR_VELOCITY * BOND_LENGTH / 2
    positions = [[-BOND_LENGTH / 2, 0, 0], [BOND_LENGTH / 2, 0, 0]]
    velocities = [[0, -speed, 0], [0, speed, 0]]
    return system, positions, velocities


def make_context(integrator, platform="Reference"):
    system, positions, velocities = rotating_dumbbell()
    context = openmm.Context(system, integrator, openmm.Platform.getPlatform(platform))
    context.setPositions(positions)
    context.setVelocities(velocities)
    return context


def picoseconds(quantity):
    assert unit.is_quantity(quantity)
    return quantity.value_in_unit(unit.picosecond)


# Signatures and documentation


def test_class_is_an_integrator():
    assert issubclass(VariableStepRattleIntegrator, openmm.Integrator)
    assert len(inspect.getdoc(VariableStepRattleIntegrator)) > 1000


def test_constructor_signature():
    parameters = inspect.signature(VariableStepRattleIntegrator).parameters
    assert list(parameters) == [
        "stepSize",
        "updateMethod",
        "minimumStepSize",
        "maximumStepSize",
        "constraintTolerance",
        "monitors",
        "referenceMonitorValue",
        "normOrder",
        "monitorForceGroup",
        "automatic",
    ]
    assert parameters["stepSize"].default is inspect.Parameter.empty
    assert all(parameter.default is None for name, parameter in parameters.items() if name != "stepSize")


def test_the_public_methods_are_those_of_the_interface():
    assert set(PUBLIC_METHODS) >= {
        "addMonitor",
        "calibrate",
        "clearMonitors",
        "getCalibrationSteps",
        "getMaximumStepSize",
        "getMinimumStepSize",
        "getMonitor",
        "getMonitorForceGroup",
        "getMonitorNormOrder",
        "getMonitorValue",
        "getMultipliers",
        "getNominalStepSize",
        "getNormOrder",
        "getNumForceEvaluations",
        "getNumMonitors",
        "getNumRescues",
        "getNumSolverIterations",
        "getReferenceMonitorValue",
        "getStepDensity",
        "getStepSize",
        "getUpdateMethod",
        "isAutomatic",
        "reverse",
        "setConstraintTolerance",
        "setMaximumStepSize",
        "setMinimumStepSize",
        "setMonitorForceGroup",
        "setNominalStepSize",
        "setNormOrder",
        "setReferenceMonitorValue",
        "setStepSize",
        "setUpdateMethod",
        "step",
        "stepTo",
        "useAutomaticStepControl",
    }


def test_defaults_in_signatures():
    def defaults(method):
        return {p.name: p.default for p in inspect.signature(method).parameters.values() if p.default is not p.empty}

    assert defaults(VariableStepRattleIntegrator.addMonitor) == {"weight": 1.0, "power": 1.0, "order": 0.0}
    assert defaults(VariableStepRattleIntegrator.getReferenceMonitorValue) == {"index": 0}
    assert defaults(VariableStepRattleIntegrator.setReferenceMonitorValue) == {"index": 0}
    assert defaults(VariableStepRattleIntegrator.getMonitorValue) == {"index": 0}
    assert defaults(VariableStepRattleIntegrator.useAutomaticStepControl) == {"calibrationSteps": 30}


def test_constants():
    for name, value in {**UPDATE_METHODS, **MONITOR_KINDS}.items():
        assert getattr(VariableStepRattleIntegrator, name) == value, name
        assert name in inspect.getdoc(VariableStepRattleIntegrator)


# Settings and their units


def test_defaults():
    integrator = VariableStepRattleIntegrator(0.002)
    assert picoseconds(integrator.getNominalStepSize()) == 0.002
    assert picoseconds(integrator.getStepSize()) == 0.002
    assert picoseconds(integrator.getMinimumStepSize()) == pytest.approx(0.002 / 50, rel=1e-14)
    assert picoseconds(integrator.getMaximumStepSize()) == pytest.approx(0.004, rel=1e-14)
    assert integrator.getUpdateMethod() == VariableStepRattleIntegrator.SemiExplicit
    assert integrator.getNumMonitors() == 1
    assert integrator.getMonitor(0) == (VariableStepRattleIntegrator.ConstraintMultipliers, 1.0, 1.0)
    assert integrator.getMonitorForceGroup() == 31
    assert integrator.getNormOrder() == 8.0
    assert integrator.getReferenceMonitorValue() == 0.0
    assert integrator.getConstraintTolerance() == 1e-8
    assert integrator.getStepDensity() == 1.0
    assert integrator.getNumForceEvaluations() == 0
    assert integrator.getNumSolverIterations() == 0
    assert integrator.getNumRescues() == 0


TIMES = [0.0015, np.float64(0.0015), np.float32(0.0015), 1.5 * unit.femtosecond, 1.5e-15 * unit.second]


@pytest.mark.parametrize(
    "name, size",
    [(name, TIMES[-1]) for name in ("StepSize", "MinimumStepSize", "MaximumStepSize")]
    + [("NominalStepSize", size) for size in TIMES],
    ids=repr,
)
def test_step_sizes_are_picoseconds_or_quantities(name, size):
    nominal = {"MinimumStepSize": 0.002, "MaximumStepSize": 0.001}.get(name, 0.001)
    integrator = VariableStepRattleIntegrator(nominal)
    getattr(integrator, "set" + name)(size)
    # A float32 carries 24 bits.
    assert picoseconds(getattr(integrator, "get" + name)()) == pytest.approx(0.0015, rel=2**-24)


@pytest.mark.parametrize("size", TIMES, ids=repr)
def test_constructor_takes_picoseconds_or_a_quantity(size):
    assert picoseconds(VariableStepRattleIntegrator(size).getStepSize()) == pytest.approx(0.0015, rel=2**-24)


def test_integers_are_numbers():
    assert picoseconds(VariableStepRattleIntegrator(1).getStepSize()) == 1.0


def test_settings_come_back():
    integrator = VariableStepRattleIntegrator(0.002)
    integrator.setUpdateMethod(VariableStepRattleIntegrator.Bounded)
    integrator.setNormOrder(4)
    integrator.setMonitorForceGroup(7)
    integrator.setReferenceMonitorValue(12.5)
    integrator.setConstraintTolerance(1e-10)
    assert integrator.getUpdateMethod() == VariableStepRattleIntegrator.Bounded
    assert integrator.getNormOrder() == 4.0
    assert integrator.getMonitorForceGroup() == 7
    assert integrator.getReferenceMonitorValue() == 12.5
    assert integrator.getConstraintTolerance() == 1e-10


def test_monitors():
    integrator = VariableStepRattleIntegrator(0.002)
    assert integrator.addMonitor(VariableStepRattleIntegrator.MaxForce) == 1
    assert integrator.addMonitor(np.int64(VariableStepRattleIntegrator.ArcLength), weight=2, power=0.5) == 2
    integrator.setReferenceMonitorValue(3.0, index=2)
    assert integrator.getNumMonitors() == 3
    assert integrator.getMonitor(1) == (VariableStepRattleIntegrator.MaxForce, 1.0, 1.0)
    assert integrator.getMonitor(2) == (VariableStepRattleIntegrator.ArcLength, 2.0, 0.5)
    assert integrator.getReferenceMonitorValue(0) == 0.0
    assert integrator.getReferenceMonitorValue(2) == 3.0
    integrator.clearMonitors()
    assert integrator.getNumMonitors() == 0


def test_constructor_keywords():
    integrator = VariableStepRattleIntegrator(
        0.002,
        updateMethod=VariableStepRattleIntegrator.Explicit,
        minimumStepSize=0.5 * unit.femtosecond,
        maximumStepSize=0.003,
        constraintTolerance=1e-9,
        monitors=[VariableStepRattleIntegrator.ForcePNorm, (VariableStepRattleIntegrator.MaxForce, 0.5, 2.0)],
        referenceMonitorValue=100.0,
        normOrder=6,
        monitorForceGroup=3,
    )
    assert integrator.getUpdateMethod() == VariableStepRattleIntegrator.Explicit
    assert picoseconds(integrator.getMinimumStepSize()) == pytest.approx(0.0005, rel=1e-14)
    assert picoseconds(integrator.getMaximumStepSize()) == 0.003
    assert integrator.getConstraintTolerance() == 1e-9
    assert integrator.getNumMonitors() == 2
    assert integrator.getMonitor(0) == (VariableStepRattleIntegrator.ForcePNorm, 1.0, 1.0)
    assert integrator.getMonitor(1) == (VariableStepRattleIntegrator.MaxForce, 0.5, 2.0)
    assert integrator.getReferenceMonitorValue() == 100.0
    assert integrator.getNormOrder() == 6.0
    assert integrator.getMonitorForceGroup() == 3


def test_no_monitors_by_keyword():
    assert VariableStepRattleIntegrator(0.002, monitors=[]).getNumMonitors() == 0


# Errors


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda i: VariableStepRattleIntegrator(-0.001), "the step size must be"),
        (lambda i: i.setMinimumStepSize(math.nan), "minimum step size must be"),
        (lambda i: i.setUpdateMethod(3), "must be SemiExplicit, Explicit or Bounded"),
        (lambda i: i.setUpdateMethod(-1), "must be SemiExplicit, Explicit or Bounded"),
        (lambda i: i.addMonitor(11), "no .*kind"),
        (lambda i: i.addMonitor(-1), "no .*kind"),
        (lambda i: i.getMonitor(1), "no monitor with index 1"),
        (lambda i: i.getMonitor(-1), "no monitor with index -1"),
        (lambda i: i.setReferenceMonitorValue(1.0, 1), "no monitor with index 1"),
    ],
)
def test_wrong_values_raise_openmm_exceptions(call, message):
    """What C++ throws, and numbers that are none of an enumeration's; which values are wrong is tested in C++."""
    with pytest.raises(openmm.OpenMMException, match=message):
        call(VariableStepRattleIntegrator(0.002))


@pytest.mark.parametrize(
    "call",
    [
        lambda i: i.step(1),
        lambda i: i.stepTo(1.0),
        lambda i: i.calibrate(10),
        lambda i: i.reverse(),
        lambda i: i.getMultipliers(),
        lambda i: i.getMonitorValue(),
    ],
)
def test_methods_that_need_a_context_say_so(call):
    with pytest.raises(openmm.OpenMMException, match="context"):
        call(VariableStepRattleIntegrator(0.002))


# One function reads all times.
@pytest.mark.parametrize(
    "name, size",
    [(name, "0.002") for name in ("setStepSize", "setMinimumStepSize", "setMaximumStepSize", "stepTo")]
    + [("setNominalStepSize", size) for size in (b"0.002", None, [0.002], 1j, 300 * unit.kelvin, 0.1 * unit.nanometer)],
)
def test_times_of_a_wrong_type_or_unit(name, size):
    with pytest.raises(TypeError, match="must be a number or a Quantity in picoseconds, not "):
        getattr(VariableStepRattleIntegrator(0.002), name)(size)


@pytest.mark.parametrize("size", ["0.002", None, 300 * unit.kelvin])
def test_constructor_arguments_of_a_wrong_type_or_unit(size):
    with pytest.raises(TypeError, match="stepSize must be a number or a Quantity in picoseconds"):
        VariableStepRattleIntegrator(size)


def test_constructor_names_wrong_arguments():
    with pytest.raises(TypeError, match="stepSize"):
        VariableStepRattleIntegrator()
    with pytest.raises(TypeError, match="maximumStep"):
        VariableStepRattleIntegrator(0.002, maximumStep=0.004)
    with pytest.raises(TypeError, match="monitors must be a list"):
        VariableStepRattleIntegrator(0.002, monitors=VariableStepRattleIntegrator.MaxForce)


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda i: i.step(1.5), "steps must be an integer, not 1.5"),
        (lambda i: i.step("1"), "steps must be an integer, not '1'"),
        (lambda i: i.calibrate(None), "steps must be an integer, not None"),
        (lambda i: i.addMonitor("MaxForce"), "kind must be an integer, not 'MaxForce'"),
        (lambda i: i.addMonitor(0, "1"), "weight must be a plain number, not '1'"),
        (lambda i: i.setUpdateMethod(0.5), "method must be an integer, not 0.5"),
        (lambda i: i.setNormOrder("8"), "order must be a plain number, not '8'"),
        (lambda i: i.setReferenceMonitorValue(1 * unit.nanometer), "value must be a plain number, not a Quantity"),
        (lambda i: i.setConstraintTolerance(None), "tol must be a plain number, not None"),
        (lambda i: i.getMonitor(0.0), "index must be an integer, not 0.0"),
        (lambda i: i.setMonitorForceGroup("a"), "group must be an integer, not 'a'"),
    ],
)
def test_arguments_of_a_wrong_type_are_named(call, message):
    with pytest.raises(TypeError, match=message):
        call(VariableStepRattleIntegrator(0.002))


@pytest.mark.parametrize(
    "call, name",
    [
        (lambda i: i.step(2**31), "steps"),
        (lambda i: i.addMonitor(-(2**40)), "kind"),
        (lambda i: i.setUpdateMethod(2**33), "method"),
        (lambda i: i.addConstraint("x1", [2**40]), "the index of a particle"),
        (lambda i: i.setStepSize(10**400), "size"),
    ],
)
def test_integers_that_are_too_large_are_named(call, name):
    with pytest.raises(openmm.OpenMMException, match=f"^{name} (must be|is) an integer"):
        call(VariableStepRattleIntegrator(0.002))


# Contexts


@pytest.mark.parametrize("platform", PLATFORMS)
def test_context_takes_the_integrator(platform):
    integrator = VariableStepRattleIntegrator(0.002)
    context = make_context(integrator, platform)
    integrator.step(5)
    assert context.getStepCount() == 5
    assert picoseconds(context.getTime()) > 0
    assert integrator.getNumForceEvaluations() == 6
    assert isinstance(integrator.getNumSolverIterations(), int)
    assert integrator.getNumRescues() == 0


@pytest.mark.parametrize("platform", PLATFORMS)
def test_step_to_lands_on_the_time(platform):
    integrator = VariableStepRattleIntegrator(0.002)
    context = make_context(integrator, platform)
    integrator.stepTo(0.0111)
    assert picoseconds(context.getTime()) == 0.0111
    integrator.stepTo(20 * unit.femtosecond)
    assert picoseconds(context.getTime()) == (20 * unit.femtosecond).value_in_unit(unit.picosecond)


@pytest.mark.parametrize("platform", PLATFORMS)
def test_multipliers_are_a_quantity(platform):
    integrator = VariableStepRattleIntegrator(0.002)
    context = make_context(integrator, platform)
    multipliers = integrator.getMultipliers()
    assert multipliers.unit == MULTIPLIER_UNIT
    values = multipliers.value_in_unit(MULTIPLIER_UNIT)
    assert isinstance(values, list)
    # Positions and velocities are exact doubles here, so only the solve rounds. CPU keeps positions in double as well.
    assert values == pytest.approx([ANGULAR_VELOCITY**2 / 4], rel=1e-12)
    assert integrator.getMonitorValue() == pytest.approx(values[0], rel=1e-14)
    del context


def test_calibrate_sets_the_reference_value():
    integrator = VariableStepRattleIntegrator(0.002)
    context = make_context(integrator)
    integrator.calibrate(10)
    # The dumbbell turns at a constant rate, so the mean over the run is the value itself. RATTLE keeps it to second
    # order in the step: (w dt)^2 = 1e-4.
    assert integrator.getReferenceMonitorValue() == pytest.approx(ANGULAR_VELOCITY**2 / 4, rel=1e-4)
    assert picoseconds(context.getTime()) == 0


def test_reverse_turns_the_velocities():
    integrator = VariableStepRattleIntegrator(0.002)
    context = make_context(integrator)
    integrator.step(3)
    before = context.getState(velocities=True).getVelocities(asNumpy=True)._value
    integrator.reverse()
    after = context.getState(velocities=True).getVelocities(asNumpy=True)._value
    assert np.abs(after + before).max() < 1e-6 * np.abs(before).max()


def test_context_keeps_the_integrator_alive():
    context = make_context(VariableStepRattleIntegrator(0.002))
    gc.collect()
    integrator = context.getIntegrator()
    assert type(integrator) is VariableStepRattleIntegrator
    integrator.step(1)
    assert context.getStepCount() == 1


def test_integrator_outlives_its_context():
    integrator = VariableStepRattleIntegrator(0.002)
    context = make_context(integrator)
    integrator.step(1)
    del context
    gc.collect()
    assert integrator.getNumMonitors() == 1
    with pytest.raises(openmm.OpenMMException, match="context"):
        integrator.step(1)


def test_integrator_serves_one_context():
    integrator = VariableStepRattleIntegrator(0.002)
    context = make_context(integrator)
    with pytest.raises(openmm.OpenMMException, match="already bound"):
        make_context(integrator)
    integrator.step(1)
    assert context.getStepCount() == 1


@pytest.mark.parametrize("platform", PLATFORMS)
def test_simulation_takes_the_integrator(platform):
    system, positions, velocities = rotating_dumbbell()
    topology = app.Topology()
    residue = topology.addResidue("DUM", topology.addChain())
    for name in "AB":
        topology.addAtom(name, None, residue)
    integrator = VariableStepRattleIntegrator(0.002)
    simulation = app.Simulation(topology, system, integrator, openmm.Platform.getPlatform(platform))
    simulation.context.setPositions(positions)
    simulation.context.setVelocities(velocities)
    simulation.step(7)
    assert simulation.currentStep == 7
    assert simulation.integrator is integrator


def test_steps_let_other_threads_run():
    """While a long call runs in one thread, the main thread goes on."""
    integrator = VariableStepRattleIntegrator(0.002)
    context = make_context(integrator)
    integrator.step(1)
    # If the steps kept Python's global lock, they would be one stretch in which the main thread does not count at all.
    thread = threading.Thread(target=integrator.step, args=(50000,))
    thread.start()
    counts = 0
    while thread.is_alive():
        counts += 1
        thread.join(timeout=0.001)
    assert counts > 3
    assert context.getStepCount() == 50001


@pytest.mark.parametrize(
    "make",
    [
        lambda: VariableStepRattleIntegrator(0.001),
        lambda: VariableStepRattleIntegrator(0.001, automatic=True),
        lambda: VariableStepRattleLangevinIntegrator(300, 1, 0.001),
    ],
)
def test_a_long_run_can_be_interrupted(make):
    integrator = make()
    context = make_context(integrator)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    over = threading.Event()

    def interrupt():
        while not over.wait(0.001):
            if context.getStepCount() > 0:
                signal.raise_signal(signal.SIGINT)
                return

    thread = threading.Thread(target=interrupt)
    try:
        thread.start()
        with pytest.raises(KeyboardInterrupt):
            integrator.step(2**31 - 1)
    finally:
        over.set()
        thread.join()
        signal.signal(signal.SIGINT, before)
    steps = context.getStepCount()
    integrator.step(1)
    assert context.getStepCount() == steps + 1


def test_forces_written_in_python():
    """PythonForce calls back into Python while a step runs."""

    def no_force(state):
        return 0.0, np.zeros((2, 3))

    system, positions, velocities = rotating_dumbbell()
    system.addForce(openmm.PythonForce(no_force))
    for platform in PLATFORMS:
        integrator = VariableStepRattleIntegrator(0.002)
        context = openmm.Context(system, integrator, openmm.Platform.getPlatform(platform))
        context.setPositions(positions)
        context.setVelocities(velocities)
        assert integrator.getMonitorValue() > 0
        integrator.step(3)
        assert context.getStepCount() == 3
        del context


# A step that was meant as a tolerance


@pytest.mark.parametrize(("size", "heavy"), [(0.9e-6, 1.0), (2.9e-6, 9.0)])
def test_a_step_far_below_what_is_usual_says_so_once(size, heavy):
    """Usual is 1 fs for a lightest particle of 1 amu, and 3 fs for one of 9; a fixed particle does not count."""
    system, positions, velocities = rotating_dumbbell()
    for particle in range(2):
        system.setParticleMass(particle, heavy * (1 + particle))
    system.addParticle(0.0)
    integrator = VariableStepRattleIntegrator(size, monitors=[])
    assert picoseconds(integrator.getUsualStepSize()) == 0.0  # no Context
    context = openmm.Context(system, integrator, openmm.Platform.getPlatform("Reference"))
    context.setPositions([*positions, [1, 1, 1]])
    context.setVelocities([*velocities, [0, 0, 0]])
    assert picoseconds(integrator.getUsualStepSize()) == pytest.approx(0.001 * math.sqrt(heavy), rel=1e-14)
    with pytest.warns(UserWarning, match="less than a thousandth .* and not an error tolerance") as seen:
        integrator.step(1)
        integrator.stepTo(3 * size)
    assert len(seen) == 1
    assert seen[0].filename == __file__


@pytest.mark.parametrize(("size", "steps"), [(1.1e-6, 1), (0.0, 0)])
def test_a_small_step_is_no_matter(size, steps, recwarn):
    integrator = VariableStepRattleIntegrator(size, monitors=[])
    _ = make_context(integrator)
    integrator.step(steps)
    assert not recwarn
