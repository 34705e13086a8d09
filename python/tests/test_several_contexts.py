# OpenMM-VRATTLE: several contexts at once, and many one after the other.
# SPDX-License-Identifier: MIT

from __future__ import annotations

import gc
import os
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import openmm
import pytest
from dense_reference import UPDATES, Model, chain, open_context, positions_of, velocities_of, waters
from run_support import FORCE_MONITOR, make_integrator, with_update


def prepare(model: Model, platform: str, update: str) -> tuple[Any, Any]:
    integrator = with_update(make_integrator(0.0005, FORCE_MONITOR), update)
    return integrator, open_context(model.system(), integrator, platform, model)


@pytest.mark.parametrize("update", UPDATES)
def test_two_contexts_in_two_threads(update: str, platform: str) -> None:
    """Stepping at once gives what stepping one after the other gives, to the last bit."""
    models = [chain(), waters()]
    steps = 2000 if platform == "Reference" else 300
    expected = []
    for model in models:
        integrator, context = prepare(model, platform, update)
        integrator.step(steps)
        expected.append((positions_of(context), velocities_of(context)))
        del context, integrator
    pairs = [prepare(model, platform, update) for model in models]
    barrier = threading.Barrier(2)
    failures: list[BaseException] = []

    def run(integrator: Any) -> None:
        try:
            barrier.wait(10)
            for _ in range(10):
                integrator.step(steps // 10)
        except BaseException as failure:
            failures.append(failure)

    threads = [threading.Thread(target=run, args=(integrator,)) for integrator, _ in pairs]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(120)
    assert not failures
    assert not any(thread.is_alive() for thread in threads)
    for (integrator, context), (q, v) in zip(pairs, expected, strict=True):
        assert integrator.getNumForceEvaluations() == steps + 1
        # One thread a Context and forces summed in a fixed order on CPU, see open_context().
        assert np.array_equal(positions_of(context), q)
        assert np.array_equal(velocities_of(context), v)


def test_other_threads_run_while_one_steps() -> None:
    """step() lets go of Python's lock: the main thread sees the steps go on while another is inside one long call."""
    integrator, _context = prepare(waters(), "Reference", "SemiExplicit")
    integrator.step(1)
    begin, steps = integrator.getNumForceEvaluations(), 10000  # which take some tenths of a second
    thread = threading.Thread(target=integrator.step, args=(steps,))
    thread.start()
    seen = set()
    while thread.is_alive():
        time.sleep(0.001)
        seen.add(integrator.getNumForceEvaluations() - begin)
    thread.join()
    assert any(0 < count < steps for count in seen)


def test_errors_in_threads_stay_where_they_belong() -> None:
    """A step that fails in one thread is an exception there, and the other Context goes on."""
    good, good_context = prepare(chain(), "Reference", "SemiExplicit")
    bad, _bad_context = prepare(chain(), "Reference", "SemiExplicit")
    bad.step(3)
    bad.setStepSize(1000.0)
    alone, alone_context = prepare(chain(), "Reference", "SemiExplicit")
    alone.step(1000)
    caught: list[Exception] = []

    def fail() -> None:
        for _ in range(20):
            try:
                bad.step(5)
            except openmm.OpenMMException as error:
                caught.append(error)

    threads = [threading.Thread(target=fail), threading.Thread(target=good.step, args=(1000,))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert len(caught) == 20
    assert np.array_equal(positions_of(good_context), positions_of(alone_context))


def resident_bytes() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc/self/statm")
def test_contexts_do_not_pile_up(platform: str) -> None:
    """100 contexts made, stepped and thrown away: memory does not grow."""
    count = 1500
    system = openmm.System()
    positions = np.zeros((count, 3))
    for i in range(count):
        system.addParticle(12.0)
        positions[i] = [0.1 * i, 0.05 * (i % 2), 0.02 * (i // 2 % 2)]
        if i > 0:
            system.addConstraint(i - 1, i, float(np.linalg.norm(positions[i] - positions[i - 1])))
    velocities = np.random.default_rng(1).normal(size=(count, 3))
    properties = {"Threads": "1"} if platform == "CPU" else {}

    def once(fail: bool) -> None:
        integrator = make_integrator(0.0005, "ConstraintMultipliers")
        context = openmm.Context(system, integrator, openmm.Platform.getPlatformByName(platform), properties)
        context.setPositions(positions)
        context.setVelocities(velocities)
        integrator.step(2)
        integrator.getMultipliers()
        if fail:
            integrator.setStepSize(1e4)
            with pytest.raises(openmm.OpenMMException):
                integrator.step(1)

    for i in range(20):
        once(i % 2 == 1)
    gc.collect()
    before = resident_bytes()
    for i in range(100):
        once(i % 10 == 9)
    gc.collect()
    growth = resident_bytes() - before
    print(f"{platform}: memory grew by {growth / 1024:.0f} KiB in 100 contexts")
    # 1500 particles in some 40 arrays of 36 kB, with the matrices: a Context holds over 1 MB, so 100 forgotten ones are
    # over 100 MB, and one forgotten array of each 3.6 MB. What the allocator keeps back is below that.
    assert growth < 3 * 2**20
