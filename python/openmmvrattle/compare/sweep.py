# OpenMM-VRATTLE: time-reversible variable steps for constrained dynamics.
# SPDX-License-Identifier: MIT
"""Many comparisons at once: in this process, in several processes, or on the machines of a Dask cluster.

A sweep is a list of cases, each a system from one start, and each case has several integrators to run. Every single run
is a piece of work of its own, so that a case with one slow integrator does not hold up the rest.
"""

from __future__ import annotations

import importlib.metadata
import multiprocessing
import os
import pickle
import signal
import uuid
from collections import deque
from collections.abc import Callable, Generator, Sequence
from contextlib import closing
from multiprocessing.connection import Connection, wait
from typing import Any, Protocol

from . import MissingPackageError, require
from .comparison import Case, Comparison, run_case
from .measurement import IntegratorRun, failed_run

__all__ = ["DaskRunner", "ProcessRunner", "Runner", "RunnerError", "SerialRunner", "SweepProgress", "run_sweep"]

Work = tuple[int, int]
"""The index of a case and that of one of its methods."""
_TRIES_ALONE = 3
"""How often a run is begun that a Dask cluster cancels though nothing else is run beside it."""
_LOST_AFTER = 30.0
"""After how many seconds without an answer the result of a run that has ended counts as lost."""
SweepProgress = Callable[[Work, str, float], None]
"""Called with a piece of work, what is being done, and the fraction that is done."""


class RunnerError(Exception):
    """The runs cannot be started; the message says why."""


class Runner(Protocol):
    """What carries out the runs of a sweep."""

    def run(
        self, cases: Sequence[Case], works: Sequence[Work], progress: SweepProgress
    ) -> Generator[tuple[Work, IntegratorRun], None, None]:
        """Carry out all works and yield each result as soon as it is there; closing the iterator ends the runs."""
        ...


def run_sweep(
    cases: Sequence[Case],
    runner: Runner,
    progress: SweepProgress | None = None,
    finished: Callable[[int, Comparison], None] | None = None,
) -> tuple[list[Comparison], bool]:
    """Run all integrators of all cases.

    An interrupt from the keyboard ends the sweep with what was done so far: cases of which some runs are missing are
    marked as interrupted, and those without any run are left out.

    Args:
        cases: what to compare.
        runner: what carries out the runs.
        progress: called while the runs go on.
        finished: called with the index of a case and the comparison as soon as its last run has ended, and for an
            interrupted case at the interrupt.

    Returns:
        The comparisons in the order of the cases, and whether the sweep was interrupted.
    """
    numbers = [len(case.methods()) for case in cases]
    works = [(case, method) for case, number in enumerate(numbers) for method in range(number)]
    runs: list[dict[int, IntegratorRun]] = [{} for _ in cases]
    comparisons: dict[int, Comparison] = {}

    def complete(index: int, interrupted: bool) -> None:
        done = [run for _, run in sorted(runs[index].items(), key=lambda item: item[0])]
        comparisons[index] = cases[index].comparison(done, interrupted)
        if finished is not None:
            finished(index, comparisons[index])

    interrupted = False
    report = progress or (lambda work, activity, fraction: None)
    results = runner.run(cases, works, report)
    try:
        for (index, method), run in results:
            runs[index][method] = run
            report((index, method), "done", 1.0)
            if len(runs[index]) == numbers[index]:
                complete(index, interrupted=False)
    except KeyboardInterrupt:
        interrupted = True
        results.close()
        for index, done in enumerate(runs):
            if index not in comparisons and done:
                complete(index, interrupted=True)
    return [comparison for _, comparison in sorted(comparisons.items(), key=lambda item: item[0])], interrupted


class SerialRunner:
    """One run after the other in this process."""

    def run(
        self, cases: Sequence[Case], works: Sequence[Work], progress: SweepProgress
    ) -> Generator[tuple[Work, IntegratorRun], None, None]:
        """See `Runner`."""
        for work in works:
            yield work, run_case(cases[work[0]], work[1], _progress_of(work, progress))


def _progress_of(work: Work, progress: SweepProgress) -> Callable[[str, str, float], None]:
    return lambda name, activity, fraction: progress(work, activity, fraction)


class ProcessRunner:
    """Each run in a process of its own, several at a time; one whose process dies has failed, the others go on."""

    def __init__(self, jobs: int) -> None:
        """
        Args:
            jobs: how many processes work at the same time.
        """
        self._jobs = jobs

    def run(
        self, cases: Sequence[Case], works: Sequence[Work], progress: SweepProgress
    ) -> Generator[tuple[Work, IntegratorRun], None, None]:
        """See `Runner`."""
        # Processes are copies of one that has imported OpenMM and done nothing else: quick to start, and without the
        # threads of this one, which a copy would lack.
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload([__name__])
        share_processors(self._jobs)
        waiting = deque(works)
        running: dict[Connection, tuple[Work, Any]] = {}
        try:
            while waiting or running:
                while waiting and len(running) < self._jobs:
                    work = waiting.popleft()
                    receiver, sender = context.Pipe(duplex=False)
                    process = context.Process(target=_work, args=(cases[work[0]], work[1], sender), daemon=True)
                    process.start()
                    sender.close()
                    running[receiver] = (work, process)
                    progress(work, "starting", 0.0)
                for receiver in wait(list(running)):
                    assert isinstance(receiver, Connection)
                    work, process = running[receiver]
                    try:
                        message = receiver.recv()
                    except EOFError:
                        process.join()
                        message = _died(cases[work[0]], work[1], process.exitcode)
                    if isinstance(message, IntegratorRun):
                        del running[receiver]
                        receiver.close()
                        process.join()
                        yield work, message
                    else:
                        progress(work, *message)
        finally:
            for _, process in running.values():
                process.terminate()
            for receiver, (_, process) in running.items():
                process.join()
                receiver.close()


def share_processors(jobs: int) -> None:
    """Let each of several processes use its part of the processors, unless the user has said how many."""
    os.environ.setdefault("OPENMM_CPU_THREADS", str(max(1, (os.cpu_count() or 1) // jobs)))


def _work(case: Case, index: int, sender: Connection) -> None:
    """What a process does: run, and send progress and the result."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process that started this one is interrupted, and ends it
    last = -1.0

    def report(name: str, activity: str, fraction: float) -> None:
        nonlocal last
        if fraction == 0.0 or fraction >= last + 0.01:
            last = fraction
            sender.send((activity, fraction))

    sender.send(run_case(case, index, report))
    sender.close()


def _died(case: Case, index: int, code: int | None) -> IntegratorRun:
    reason = f"by signal {signal.Signals(-code).name}" if code is not None and code < 0 else f"with status {code}"
    return failed_run(case.methods()[index], f"its process ended {reason}")


def _run_pickled(case: bytes, index: int) -> IntegratorRun:
    return run_case(pickle.loads(case), index)


class DaskRunner:
    """Runs on the workers of a Dask cluster, on which this package must be installed too."""

    def __init__(self, address: str, timeout: float = 20.0) -> None:
        """Connect to a cluster.

        Args:
            address: of the scheduler, such as tcp://host:8786.
            timeout: how long to wait for it, in seconds.
        """
        try:
            require("a Dask cluster", "distributed")
        except MissingPackageError as error:
            raise RunnerError(str(error)) from error
        from distributed import Client

        try:
            self._client = Client(address, timeout=timeout, set_as_default=False)
        except (OSError, TimeoutError, ValueError) as error:
            raise RunnerError(f"there is no Dask scheduler at {address}: {str(error) or 'no answer'}.") from error
        self._check_versions()

    def _check_versions(self) -> None:
        for package in ("openmm-vrattle", "openmm"):
            own = importlib.metadata.version(package)
            answers = self._client.run(importlib.metadata.version, package, on_error="return")
            for worker, version in answers.items():
                if isinstance(version, Exception):
                    raise RunnerError(f"the Dask worker {worker} has no {package}; install {package} {own} there.")
                if version != own:
                    raise RunnerError(f"the Dask worker {worker} has {package} {version}, but this machine has {own}.")

    @property
    def workers(self) -> int:
        """How many workers the cluster has at the moment."""
        return len(self._client.scheduler_info()["workers"])

    def run(
        self, cases: Sequence[Case], works: Sequence[Work], progress: SweepProgress
    ) -> Generator[tuple[Work, IntegratorRun], None, None]:
        """See `Runner`."""
        from distributed import CancelledError, KilledWorker
        from distributed import TimeoutError as NoAnswerError

        # As bytes, which only the process that runs them unpacks: what cannot be unpacked there is a failed run.
        sent = {index: pickle.dumps(cases[index]) for index in {case for case, _ in works}}

        def failed(work: Work, error: BaseException) -> IntegratorRun:
            reason = (
                " ".join(str(error).split()) or "the cluster has no word of its result"
            )  # TimeoutError says nothing
            return failed_run(cases[work[0]].methods()[work[1]], reason)

        try:
            # A run that kills its worker takes others with it: those whose results were there, and those that had begun
            # or waited there, which Dask in the end blames as well. So what was lost is run once more with nothing
            # beside it, and what is lost then has itself to blame.
            lost: list[Work] = []
            with closing(self._outcomes(sent, works)) as outcomes:
                for work, outcome in outcomes:
                    if isinstance(outcome, (KilledWorker, CancelledError, NoAnswerError)):
                        lost.append(work)
                        progress(work, "lost with its worker, waiting", 0.0)
                    else:
                        yield work, failed(work, outcome) if isinstance(outcome, BaseException) else outcome
            for work in lost:
                for _ in range(_TRIES_ALONE):
                    progress(work, "starting alone", 0.0)
                    [(_, outcome)] = self._outcomes(sent, [work])
                    if not isinstance(outcome, (CancelledError, NoAnswerError)):
                        break
                yield work, failed(work, outcome) if isinstance(outcome, BaseException) else outcome
        finally:
            self._client.close()

    def _outcomes(
        self, sent: dict[int, bytes], works: Sequence[Work]
    ) -> Generator[tuple[Work, IntegratorRun | BaseException], None, None]:
        """Carry out works side by side; what ends one of them with an error is yielded in place of its result."""
        from distributed import as_completed

        futures = {}
        for index, method in works:
            key = f"vrattle-{index}-{method}-{uuid.uuid4()}"
            futures[self._client.submit(_run_pickled, sent[index], method, pure=False, key=key)] = (index, method)
        try:
            for future in as_completed(futures, loop=self._client.loop):
                # A result that went with its worker is computed again meanwhile, and may end otherwise. If that happens
                # just while it is asked for, the client can wait for ever for word of it.
                try:
                    outcome = future.result(timeout=_LOST_AFTER)
                except Exception as error:
                    outcome = error
                yield futures[future], outcome
                future.release()
        finally:
            self._client.cancel([future for future in futures if not future.done()])
