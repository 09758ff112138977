"""DBC files from disk to a `Catalog`, in a child process with bounded memory and time.

A DBC file comes from outside and its parser trusts it, so the child does the work and this process only takes the result:
whatever a file holds, the supervisor neither hangs nor grows, and it never loads the parsers. The child is this module run
as a program: request on its standard input, answer on its standard output (both msgpack), on standard error the file at hand.
"""
from __future__ import annotations

import gc
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import msgspec

import dbc
from level1 import buses, similar
from level1.catalog import Catalog, DefinitionError, Problem

MEMORY_LIMIT = 900_000_000
"""Bytes of address space of the child: an honest file of 100,000 lines takes half of it."""
CPU_BASE_S, CPU_BYTES_PER_S = 20, 100_000
"""Seconds of computing time of the child: a base, and one more for so many bytes. An honest file takes a tenth of that; a starved
virtual machine counts what its host does meanwhile."""
WALL_FACTOR = 6
"""The child may take so many times longer on a busy machine before it is given up."""
MAX_FILE_BYTES = 10_000_000
"""Size of a file above which it isn't even read; 100,000 lines take 8 MB."""

_OUT_OF_MEMORY = 3
_AT = "at "


class _Request(msgspec.Struct, frozen=True):
    """Paths of the files, the buses of those that are bound, and the bounds of the child."""

    files: tuple[str, ...]
    bindings: dict[str, tuple[int, ...]]
    memory: int
    cpu_s: int


class Examination(msgspec.Struct, frozen=True):
    """What files hold. catalog: None when there is any error. messages, alarms: how many, those with errors included."""

    catalog: Catalog | None
    problems: tuple[Problem, ...]
    messages: int = 0
    alarms: int = 0


def load(files: Sequence[str | Path], bus_files: Mapping[int, Sequence[str | Path]] | None = None,
         bus_names: Sequence[str] = ()) -> Catalog:
    """The catalog of some DBC files. Raises DefinitionError with all errors and warnings when there is any error.

    files: paths; a bare name that is no file in the current folder means a shipped one. bus_files: bus index -> the files
    bound to it, loaded as well when `files` doesn't name them; messages of the other files are bound to no bus in particular.
    bus_names: by index; a file bound to several buses gives a copy of its messages and alarms for each (`level1.buses`).
    """
    found = examine(files, bus_files)
    if found.catalog is None:
        raise DefinitionError(found.problems)
    catalog, problems = buses.split(found.catalog, bus_names or tuple(map(str, bus_files or ())))
    if problems:
        raise DefinitionError((*found.problems, *problems))
    return catalog


def examine(files: Sequence[str | Path], bus_files: Mapping[int, Sequence[str | Path]] | None = None) -> Examination:
    """The catalog and every error and warning. Arguments as of `load`."""
    found: dict[str, str] = {}
    problems: list[Problem] = []
    for file in [*files, *(file for bound in (bus_files or {}).values() for file in bound)]:
        try:
            path = _find(file)
        except OSError as error:
            problems.append(Problem(str(file), 0, "", "", 0, "error", _reason(error), _shipped_hint(file)))
        else:
            found.setdefault(os.path.realpath(path), path)
    if not found:
        missing = Problem("ucs", 0, "", "", 0, "error", "no DBC file is given", "name at least one")
        return Examination(None, tuple(problems) or (missing,))
    paths = tuple(found.values())
    request = _Request(paths, _bindings(found, bus_files or {}), MEMORY_LIMIT, _cpu_limit_s(paths))
    return _with(_ask(request), problems)


def _with(found: Examination, problems: Sequence[Problem]) -> Examination:
    """The same, with errors of files that couldn't be read."""
    catalog = None if problems else found.catalog
    return Examination(catalog, (*problems, *found.problems), found.messages, found.alarms)


def _find(file: str | Path) -> str:
    """The path of a file, or of the shipped one of that name. Raises OSError."""
    path = Path(file)
    if not path.exists() and path.name == str(file):
        try:
            return str(dbc.path(path.name))
        except FileNotFoundError:
            pass
    with path.open("rb"):
        return str(path)


def _reason(error: OSError) -> str:
    return {FileNotFoundError: "no such file", IsADirectoryError: "is a folder, not a DBC file",
            PermissionError: "may not be read"}.get(type(error), f"can't be read: {error.strerror}")


def _shipped_hint(file: str | Path) -> str:
    path = Path(file)
    beside = sorted(near.name for near in path.parent.glob("*.dbc")) if path.parent.is_dir() else []
    if path.name != str(file):
        return similar.hint(path.name, beside) or "check the path"
    return f"{similar.hint(path.name, [*beside, *dbc.shipped()])} shipped are {', '.join(dbc.shipped())}".strip()


def _bindings(found: Mapping[str, str], bus_files: Mapping[int, Sequence[str | Path]]) -> dict[str, tuple[int, ...]]:
    buses: dict[str, set[int]] = {}
    for bus, files in bus_files.items():
        for file in files:
            try:
                label = found.get(os.path.realpath(_find(file)))
            except OSError:
                continue
            if label:
                buses.setdefault(label, set()).add(bus)
    return {label: tuple(sorted(indexes)) for label, indexes in buses.items()}


# -- the child ----------------------------------------------------------------------------------------------------------


def _ask(request: _Request) -> Examination:
    """Lets a child do the work."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path or os.getcwd() for path in sys.path)}
    try:
        child = subprocess.run([sys.executable, "-m", "level1.io.definitions"], input=msgspec.msgpack.encode(request),
                               capture_output=True, env=environment, timeout=WALL_FACTOR * request.cpu_s, check=False)
    except subprocess.TimeoutExpired as error:
        return _failed(error.stderr or b"", f"takes more than {error.timeout:.0f} s to read")
    if child.returncode == 0:
        return msgspec.msgpack.decode(child.stdout, type=Examination)
    too_long = f"takes more than {request.cpu_s} s of computing time to read"
    reasons = {_OUT_OF_MEMORY: f"takes more than {request.memory // 1_000_000} MB of memory to read",
               -signal.SIGXCPU: too_long, -signal.SIGKILL: too_long}
    return _failed(child.stderr, reasons.get(child.returncode, f"broke the DBC reader (exit code {child.returncode})"))


def _failed(progress: bytes, reason: str) -> Examination:
    """The answer for a child that didn't come back; `progress`: what it wrote, the file at hand in the last such line."""
    lines = progress.decode("utf-8", "replace").splitlines()
    files = [line.removeprefix(_AT) for line in lines if line.startswith(_AT)]
    last = f": {lines[-1]}" if lines and not lines[-1].startswith(_AT) else ""
    return Examination(None, (Problem(files[-1] if files else "ucs", 0, "", "", 0, "error", f"{reason}{last}",
                                      "it is hostile or broken: don't use it"),))


def _cpu_limit_s(paths: Iterable[str]) -> int:
    return CPU_BASE_S + sum(min(os.path.getsize(path), MAX_FILE_BYTES) for path in paths) // CPU_BYTES_PER_S


def _work(request: _Request) -> Examination:
    from level1 import definitions
    files = []
    problems: list[Problem] = []
    for path in request.files:
        print(f"{_AT}{path}", file=sys.stderr, flush=True)
        size = os.path.getsize(path)
        if size > MAX_FILE_BYTES:
            problems.append(Problem(path, 0, "", "", 0, "error", f"has {size} bytes: too large for a DBC file",
                                    f"at most {MAX_FILE_BYTES} are read"))
            continue
        files.append(definitions.read(definitions.Source(path, definitions.decode(Path(path).read_bytes()))))
    return _with(Examination(*definitions.assemble(files, request.bindings)), problems)


def _main() -> int:
    """The child: limits itself, then works."""
    request = msgspec.msgpack.decode(sys.stdin.buffer.read(), type=_Request)
    resource.setrlimit(resource.RLIMIT_AS, (request.memory, request.memory))
    resource.setrlimit(resource.RLIMIT_CPU, (request.cpu_s, request.cpu_s + 1))
    gc.disable()  # the child is short-lived; looking for cycles among millions of tokens costs a third of its time
    try:
        sys.stdout.buffer.write(msgspec.msgpack.encode(_work(request)))
    except MemoryError:
        return _OUT_OF_MEMORY
    return 0


if __name__ == "__main__":
    sys.exit(_main())
