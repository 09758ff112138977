"""Days of a season, one after the other or in a pool of processes."""
from __future__ import annotations

import gc
import itertools
import os
import signal
import time
import traceback
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context

from benchmarks.season.day import Day, DayResult
from benchmarks.season.plan import Plan, S, plan

Job = tuple[int, int, int, str | None]
"""Seed, number, length of the day in ns, machine if not drawn."""
GARBAGE = 20_000
"""Objects between two looks for garbage: 700, as usual, cost an eighth of the time."""
_turns = itertools.count()
_process = f"{os.getpid()}-{time.time_ns()}"


def planned(job: Job) -> Plan:
    """What a day will be like."""
    seed, number, length_ns, machine = job
    return plan(seed, number, length_ns, machine)


def work(job: Job) -> DayResult:
    """One day, in whatever process."""
    gc.set_threshold(GARBAGE)
    gc.collect()  # the day before: else the memory of a process would tell how much garbage ever lay about, not whether it grows
    day = planned(job)
    try:
        result = Day(day).run()
    except Exception:
        lines = traceback.format_exc().strip().splitlines()
        result = DayResult(day.number, day.machine, day.length_ns / 3600 / S, "", wrong=[f"CRASH {' | '.join(lines[-4:])}"])
    result.process, result.turn = _process, next(_turns)
    return result


def run(jobs: Sequence[Job], processes: int) -> Iterator[DayResult]:
    """The outcomes, as they come."""
    if processes == 1:
        yield from map(work, jobs)
        return
    executor = ProcessPoolExecutor(processes, get_context("spawn"), _deaf)
    try:
        for future in as_completed([executor.submit(work, job) for job in jobs]):
            yield future.result()
    except BaseException:
        workers = list((executor._processes or {}).values())  # shutdown forgets them
        executor.shutdown(wait=False, cancel_futures=True)
        for worker in workers:
            worker.terminate()
        raise
    executor.shutdown()


def _deaf() -> None:
    """Ctrl-C is for the process that ends the others."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
