"""Many recordings at once: found in folders, run in a pool of processes or on a cluster, gone on with after Ctrl-C.

Each recording is a job of its own: it goes out with the encoded catalog and comes back as an `Outcome`. Outcomes are kept
beside each other in a cache folder until the whole run is done, so that an interrupted run does not begin anew; a job's key
is what its outcome depends on (the recording's size and time of change, the definitions, what is armed, the program's version).
"""
from __future__ import annotations

import glob
import hashlib
import importlib
import os
import signal
from argparse import ArgumentParser
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from multiprocessing import get_context
from pathlib import Path
from queue import SimpleQueue
from typing import Any, TextIO

import msgspec

from level1.catalog import Catalog
from level1.event import encode
from level1.io.error import OutsideError
from level1.io.replay import Log
from ucs.recording import Outcome, Replay

SUFFIXES = (".log", ".candump", ".txt", ".nmea", ".asc", ".blf", ".trc", ".csv", ".mf4", ".pcap", ".pcapng")
"""What counts as a recording in a folder, each also with `.gz`."""


class Job(msgspec.Struct, frozen=True):
    """A recording and what to run over it. catalog: a `Catalog` as msgpack; armed: alarms whose repairs act, None for all.
    asked: channels that the user named. blocks: as in `recording.Replay`."""

    path: str
    catalog: bytes
    armed: tuple[str, ...] | None = None
    buses: dict[str, int] = {}
    asked: tuple[str, ...] = ()
    blocks: bool | None = None

    def key(self) -> str:
        """Names the outcome: the same key, the same bytes."""
        state = os.stat(self.path)
        parts = (os.path.abspath(self.path), state.st_size, state.st_mtime_ns, self.armed, sorted(self.buses.items()), self.asked,
                 _version(), Outcome.__struct_fields__)
        return hashlib.sha256(repr(parts).encode() + self.catalog).hexdigest()[:32]


def encoded(catalog: Catalog) -> bytes:
    """A catalog as jobs carry it."""
    return msgspec.msgpack.encode(catalog)


def add_arguments(parser: ArgumentParser) -> None:
    """How many recordings are worked on at once, and where."""
    parser.add_argument("--jobs", type=int, metavar="N", help="processes (default: one a core)")
    parser.add_argument("--scheduler", metavar="ADDRESS", help="work on a Dask cluster (tcp://host:8786)")
    parser.add_argument("--fresh", action="store_true", help="do not go on with an interrupted run")


def recordings(names: Sequence[str]) -> list[str]:
    """The recordings that files, folders (with all below them) and patterns name, each once, in order.

    Raises OutsideError for a folder or pattern that holds none.
    """
    found: dict[str, None] = {}
    for name in names:
        if os.path.isdir(name):
            below = sorted(str(path) for path in Path(name).rglob("*") if path.is_file() and _is_recording(path))
            if not below:
                raise OutsideError(f"{name}: no recording in this folder; they end in {' '.join(SUFFIXES)}, also with .gz")
        elif not os.path.exists(name) and glob.has_magic(name):
            below = sorted(path for path in glob.glob(name, recursive=True) if os.path.isfile(path))
            if not below:
                raise OutsideError(f"{name}: no file fits this pattern")
        else:
            below = [name]
        found.update(dict.fromkeys(below))
    return list(found)


def _is_recording(path: Path) -> bool:
    return Path(path.name.lower().removesuffix(".gz")).suffix in SUFFIXES


def work(job: Job) -> Outcome:
    """Run one job, in whatever process."""
    try:
        log = Log(job.path, job.buses, one_bus=not job.buses)
        replay = Replay(log, msgspec.msgpack.decode(job.catalog, type=Catalog), job.armed, blocks=job.blocks)
        events = tuple(encode(event) for batch in replay.batches() for event in batch)
    except (OutsideError, OSError) as error:
        return Outcome(job.path, error=str(error))
    return replay.outcome(job.asked, events)


@contextmanager
def progress(total: int, stream: TextIO) -> Iterator[Callable[[Outcome], None]]:
    """A line that says how many recordings are done, on a terminal; within it the function to tell each outcome to."""
    done = frames = 0
    shown = stream.isatty()

    def told(outcome: Outcome) -> None:
        nonlocal done, frames
        done, frames = done + 1, frames + outcome.frames
        if shown:
            bar = "█" * (20 * done // total)
            stream.write(f"\r{bar:<20} {done} of {total} recordings, {frames:,} frames\033[K")
            stream.flush()
    try:
        yield told
    finally:
        if shown:
            stream.write("\r\033[K")
            stream.flush()


def run(jobs: Sequence[Job], *, workers: int | None = None, scheduler: str | None = None, cache: Path | None = None,
        fresh: bool = False, told: Callable[[Outcome], None] = lambda outcome: None) -> list[Outcome]:
    """The outcomes of all jobs, in their order; told(outcome) is called as each comes.

    workers: processes, None for one a core, 1 for none but this. scheduler: address of a Dask scheduler instead. cache:
    folder for outcomes of an unfinished run, emptied of them when the run is done; fresh: those of an earlier run don't
    count. Raises OutsideError when the cluster can't be reached.
    """
    keep = _Kept(cache, jobs)
    outcomes = {} if fresh else dict(keep.load())
    for outcome in outcomes.values():
        told(outcome)
    todo = [number for number in range(len(jobs)) if number not in outcomes]
    for number, outcome in _computed(jobs, todo, workers, scheduler):
        outcomes[number] = outcome
        keep.store(number, outcome)
        told(outcome)
    keep.clear()
    return [outcomes[number] for number in range(len(jobs))]


def _computed(jobs: Sequence[Job], todo: Sequence[int], workers: int | None,
              scheduler: str | None) -> Iterator[tuple[int, Outcome]]:
    count = min(workers or os.cpu_count() or 1, len(todo))
    if scheduler is None and count <= 1:
        for number in todo:
            yield number, work(jobs[number])
        return
    with _executor(count, scheduler) as executor:
        done: SimpleQueue[Future[Outcome]] = SimpleQueue()
        with _uninterrupted():
            futures: dict[Future[Outcome], int] = {executor.submit(work, jobs[number]): number for number in todo}
            if scheduler is None:
                for future in futures:
                    future.add_done_callback(done.put)
        for future in futures:
            # Dask's futures come in their order; the others as they are done. (The standard library's `as_completed` holds the
            # locks of all of them for a moment: Ctrl-C in it would leave them locked, and the pool could never be shut down.)
            completed = done.get() if scheduler is None else future
            try:
                outcome = completed.result()
            except BrokenProcessPool:
                raise OutsideError("a process ended within its recording (out of memory?); --jobs 1 shows which") from None
            yield futures[completed], outcome


@contextmanager
def _executor(count: int, scheduler: str | None) -> Iterator[Executor]:
    if scheduler is not None:
        with _cluster(scheduler) as executor:
            yield executor
        return
    executor = ProcessPoolExecutor(count, mp_context=get_context("spawn"))
    try:
        yield executor
    except BaseException:
        processes = list((executor._processes or {}).values())  # `shutdown` forgets them
        executor.shutdown(wait=False, cancel_futures=True)
        for process in processes:
            process.terminate()
        raise
    executor.shutdown()


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """Within it Ctrl-C waits; processes started in it never see one. A terminal sends it to all of them, and only the first
    is to answer: it ends the others."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT,))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _cluster(address: str) -> Iterator[Executor]:
    try:
        distributed: Any = importlib.import_module("distributed")
    except ImportError:
        raise OutsideError("--scheduler needs Dask: pip install 'tractor-ucs[cluster]'") from None
    try:
        client = distributed.Client(address, timeout=10)
    except (OSError, ValueError, TimeoutError) as error:
        raise OutsideError(f"{address}: no Dask scheduler answers there: {error}; start one with `dask scheduler`") from None
    with client, client.get_executor() as executor:
        yield executor


class _Kept:
    """Outcomes of an unfinished run, a file each."""

    def __init__(self, folder: Path | None, jobs: Sequence[Job]):
        self._paths: dict[int, Path] = {}
        if folder is None:
            return
        for number, job in enumerate(jobs):
            try:
                self._paths[number] = folder / f"{job.key()}.outcome"
            except OSError:
                continue

    def load(self) -> Iterator[tuple[int, Outcome]]:
        """What an earlier run has left; an unreadable one counts as none."""
        for number, path in self._paths.items():
            try:
                yield number, msgspec.msgpack.decode(path.read_bytes(), type=Outcome)
            except (OSError, msgspec.DecodeError):
                continue

    def store(self, number: int, outcome: Outcome) -> None:
        """Keep one; a disk that can't take it only costs the time of doing it again."""
        path = self._paths.get(number)
        if path is None or outcome.error:
            return
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            part = path.with_suffix(".part")
            part.write_bytes(msgspec.msgpack.encode(outcome))
            part.replace(path)
        except OSError:
            return

    def clear(self) -> None:
        """The run is done."""
        for path in self._paths.values():
            path.unlink(missing_ok=True)


def cache_folder() -> Path:
    """Where unfinished runs are kept."""
    base = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    return Path(base) / "tractor-ucs" / "season"


def _version() -> str:
    try:
        return version("tractor-ucs")
    except PackageNotFoundError:
        return "source"
