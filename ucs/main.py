"""`ucs`: one command, a module each subcommand; only the chosen one is imported.

A subcommand's module offers `add_parser(subparsers)` and `run(args) -> int`. Exit codes: what `run` returns; 1 where
definitions have errors (all are printed), 2 where something outside prevents the work (one line each: `ucs: …`),
130 after Ctrl-C, 141 when the reader of the output went away (as the shell counts SIGPIPE).
"""
from __future__ import annotations

import argparse
import errno
import importlib
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

INTERRUPTED, BROKEN_PIPE = 130, 141


class Command(NamedTuple):
    """Where a subcommand lives and what it does, in one line."""

    module: str
    help: str


GROUPS = {
    "to see what it is": {
        "demo": Command("ucs.demo", "a simulated tractor loses its pilot flame, told as it happens"),
        "simulate": Command("ucs.simulate", "simulate the nodes on the bus, with faults as a scenario says"),
    },
    "to define alarms": {
        "new": Command("ucs.new", "write a DBC file to start your own alarms from"),
        "check": Command("ucs.check", "check alarm definitions in DBC files"),
        "alarms": Command("ucs.check", "list the alarms that DBC files define, or write a handbook of them"),
    },
    "to try them on recordings": {
        "replay": Command("ucs.replay", "run alarm definitions over recordings"),
        "diff": Command("ucs.diff", "compare the alarms of two sets of definitions over recordings"),
    },
    "on the tractor": {
        "run": Command("ucs.run", "supervise a unit live"),
        "monitor": Command("ucs.monitor", "watch alarms, repairs, signals and buses live in the terminal"),
        "status": Command("ucs.status", "how a unit is, once: for people and monitoring systems"),
        "journal": Command("ucs.journal", "list, follow and export what happened"),
        "order": Command("ucs.order", "acknowledge, reset a lock-out, resume: as someone at the machine"),
        "bridge": Command("ucs.bridge", "carry a unit's events to level 2 and commands back"),
    },
    "above the tractor": {
        "level2": Command("ucs.level2", "receive, store and acknowledge what units send"),
        "keys": Command("ucs.keys", "make and list the keys of those who may command"),
    },
}
OTHER_NAMES = {"handbook": "alarms FILE.dbc --handbook handbook.html", "level1": "run unit.toml", "supervise": "run unit.toml",
               "log": "journal unit.toml", "ack": "order unit.toml acknowledge", "reset": "order unit.toml reset ALARM"}
"""What people may call something that has another name here."""
COMMANDS = {name: command for group in GROUPS.values() for name, command in group.items()}


class _Parser(argparse.ArgumentParser):
    """A parser that tells a mistake in one line. mistake: the exit code of one. chosen: the parser of the chosen subcommand."""

    mistake = 2
    chosen: argparse.ArgumentParser | None = None

    def error(self, message: str) -> NoReturn:
        print(f"ucs: {message} (see {self.prog} --help)", file=sys.stderr)
        sys.exit(self.mistake)


class _Version(argparse.Action):
    """`--version`, looked up only when asked for."""

    def __init__(self, option_strings: Sequence[str], dest: str, **_: Any):
        super().__init__(option_strings, dest, nargs=0, default=argparse.SUPPRESS, help="print the version and exit")

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        from ucs.version import version
        print(f"ucs {version() or 'of a source folder that is not installed'}")
        parser.exit()


def build_parser(chosen: str | None) -> _Parser:
    """The command line, with the arguments of the chosen subcommand; the others stand there by name and help only."""
    parser = _Parser(
        prog="ucs", description="Supervision of a tractor and its implements: alarms, repairs, and the way to level 2.",
        epilog=_listing(), formatter_class=argparse.RawDescriptionHelpFormatter, usage="ucs [--help] [--version] COMMAND ...")
    parser.add_argument("--version", action=_Version)
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True, prog="ucs", help=argparse.SUPPRESS)
    loaded = COMMANDS[chosen].module if chosen else None
    for name, command in COMMANDS.items():
        if name == chosen:
            importlib.import_module(command.module).add_parser(commands)
            parser.chosen = commands.choices[name]
        elif command.module != loaded:
            commands.add_parser(name, add_help=False)
    return parser


def _listing() -> str:
    """The commands by what they are for."""
    lines = []
    for purpose, group in GROUPS.items():
        lines += [purpose + ":", *(f"  {name:<10} {command.help}" for name, command in group.items()), ""]
    return "\n".join([*lines, "`ucs COMMAND --help` tells more about a command; `ucs demo` shows it all."])


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and give its exit code. Raises SystemExit for `--help` and wrong arguments (code 2)."""
    words = list(sys.argv[1:] if argv is None else argv)
    try:
        code = _run(words)
        sys.stdout.flush()
        return code
    except KeyboardInterrupt:
        print("ucs: stopped by Ctrl-C", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return BROKEN_PIPE


def _run(words: list[str]) -> int:
    from level1.catalog import DefinitionError
    from level1.io.error import OutsideError, did_you_mean
    chosen = words[0] if words else "--help"
    if chosen not in COMMANDS and not chosen.startswith("-"):
        meant = OTHER_NAMES.get(chosen)
        return _refuse(f'no command is called "{chosen}"' + (f"; it is `ucs {meant}`" if meant else did_you_mean(chosen, COMMANDS)))
    parser = build_parser(chosen if chosen in COMMANDS else None)
    if not words:
        parser.print_help(sys.stderr)
        return 2
    args, unknown = parser.parse_known_args(words)
    if unknown:
        (parser.chosen or parser).error(f"unrecognized arguments: {' '.join(unknown)}")
    try:
        code: int = importlib.import_module(COMMANDS[args.command].module).run(args)
        return code
    except DefinitionError as error:
        sys.stdout.flush()
        print(*error.problems, sep="\n", file=sys.stderr)
        return 1
    except OutsideError as error:
        return _refuse(*error.problems)
    except BrokenPipeError:
        raise
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        return _refuse(f"{where}{_reason(error)}")


def _reason(error: OSError) -> str:
    """What the system said, and what to do where that is plain."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return "the disk is full, and what was being written is not whole; make room, then run it again"
    folder = Path(error.filename).parent if isinstance(error.filename, str | Path) else Path()
    if error.errno == errno.ENOENT and not folder.is_dir():
        return f"there is no folder {folder}"
    return error.strerror or str(error)


def _refuse(*problems: str) -> int:
    """Say why it can't go on, after what was said before."""
    sys.stdout.flush()
    for problem in problems:
        print(f"ucs: {problem}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
