"""Finished days of a season, a file each; one counts as long as nothing that it ran has changed.

What a day ran: level 1, the judge, and of the nodes, definitions and the judge's tables those of its machine. So a mend of the
sprayer's node does not make the days of the tractor run again.
"""
from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path

import grimp
import msgspec

from benchmarks.season import oracle
from benchmarks.season.day import DayResult
from benchmarks.season.plan import MACHINES, S
from benchmarks.season.runner import Job, planned
from firmware_py.scenario import PROGRAMS

ROOT = Path(__file__).parents[2]
PACKAGES = ("benchmarks", "dbc", "firmware_py", "level1", "ucs")
DAY = "benchmarks.season.runner"
"""The module that runs a day: what it does not import, directly or by others, has no part in it."""
DATA = ("dbc/*.dbc", "dbc/*.eds", "level1/*.lark")


class Kept:
    """Finished days of all seasons, in one folder."""

    def __init__(self, folder: Path):
        self.folder = folder

    def load(self, jobs: Sequence[Job]) -> list[DayResult]:
        """Those of these days; a damaged file counts as none."""
        found = []
        for job in jobs:
            try:
                found.append(msgspec.json.decode(self._path(job).read_bytes(), type=DayResult))
            except (OSError, msgspec.DecodeError):
                continue
        return found

    def store(self, job: Job, result: DayResult) -> None:
        """Keep one."""
        path = self._path(job)
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_suffix(".part")
        part.write_bytes(msgspec.json.encode(result))
        part.replace(path)

    def _path(self, job: Job) -> Path:
        seed, number, length_ns, machine = job
        drawn = planned(job).machine
        day = f"{seed}-{number:05d}-{length_ns // S}s{'' if machine is None else '-' + machine.replace(' ', '_')}"
        return self.folder / f"{day}-{code_hash(drawn)}.json"


@cache
def code_hash(machine: str) -> str:
    """Names the state of all that a day of this machine depends on."""
    programs = MACHINES[machine].programs.values()
    own = {file for program in programs for file in _files_of(program)}
    others = {file for program in PROGRAMS for file in _files_of(program)} - own
    digest = hashlib.sha256()
    for file in _all_files():
        if file not in others:
            digest.update(file.relative_to(ROOT).as_posix().encode() + file.read_bytes())
    return digest.hexdigest()[:12]


@cache
def _all_files() -> tuple[Path, ...]:
    data = {file for kind in DATA for file in ROOT.glob(kind)}
    return tuple(sorted(data.union(_files(_graph().find_upstream_modules(DAY) | {DAY}))))


@cache
def _files_of(program: str) -> frozenset[Path]:
    """What a program's node is made of, its definitions, and what the judge knows of it."""
    kind = PROGRAMS[program]
    modules = {kind.__module__} | {module for module in _graph().find_upstream_modules(kind.__module__)
                                   if module.startswith("firmware_py.")}
    definitions = {ROOT / "dbc" / name for name in (kind.DBC, *kind.MORE_DBC) if name != "ucs.dbc"}  # that is everybody's
    judge = {Path(module.__file__ or "") for module in oracle.PARTS if program in module.ROWS}
    return frozenset({*_files(modules), *definitions, *judge})


@cache
def _graph() -> grimp.ImportGraph:
    return grimp.build_graph(*PACKAGES, cache_dir=None)


def _files(modules: Iterable[str]) -> Iterable[Path]:
    for module in modules:
        path = ROOT / module.replace(".", "/")
        yield path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def cache_folder() -> Path:
    """Where finished days are kept."""
    base = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    return Path(base) / "tractor-ucs" / "season-days"
