"""A season with random faults: every one that shows is reported, nothing else is. `python -m benchmarks.season`: hours of CPU.

Virtual time, many short days: different machines at work, what breaks drawn from every fault that their nodes know, at random
times, for random lengths, some at once, level 1 with all repairs armed. The judge knows what was broken and what the plants do
(`oracle`), not what level 1 thinks. Finished days are kept: stopped by Ctrl-C it goes on where it was, and `--report` shows the
counts so far. `--write` puts them into docs/reliability.md. Exit status 1 when a fault was missed, an alarm was false, an episode
made no sense, a plant came into danger by itself, or memory grew.
"""
from __future__ import annotations

import hashlib
import signal
import sys
import time
from argparse import ArgumentParser
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from benchmarks.season.day import DayResult, Tally
from benchmarks.season.kept import ROOT, Kept, cache_folder
from benchmarks.season.plan import MACHINES, S
from benchmarks.season.runner import run

PAGE = ROOT / "docs" / "reliability.md"
BEGIN, END = "<!-- counts: python -m benchmarks.season --write -->", "<!-- end of the season's counts -->"
DAY_S, SHORTEST_DAY_S = 3600, 300
GROWTH_KB = 8 * 1024
"""More memory than this, once a process has met every machine, is a leak."""

# --- what came out ----------------------------------------------------------------------------------------------------------


class Report:
    """All days together, in their order. growth_kb: of memory, the worst of all processes."""

    def __init__(self, results: Iterable[DayResult]):
        self.days = sorted(results, key=lambda result: result.number)
        self.tallies: dict[str, Tally] = {}
        for name, tally in ((name, tally) for day in self.days for name, tally in day.tallies.items()):
            total = self.tallies.setdefault(name, Tally())
            total.injected += tally.injected
            total.reported += tally.reported
            total.unobservable += tally.unobservable
            total.missed += tally.missed
        self.growth_kb = max((_growth_kb(days) for days in _by_process(self.days)), default=0)

    @property
    def wrong(self) -> list[str]:
        """Everything that must not be."""
        lines = [f"day {day.number}, {day.machine}: {line}" for day in self.days for line in day.wrong]
        return lines + ([f"memory grew by {self.growth_kb} kB"] if self.growth_kb > GROWTH_KB else [])

    @property
    def digest(self) -> str:
        """The same seed, the same digest."""
        return hashlib.sha256("".join(day.digest for day in self.days).encode()).hexdigest()[:16]

    def total(self, machine: str | None = None) -> Tally:
        """All faults, of one machine or of all."""
        total = Tally()
        for day in self.days:
            if machine in (None, day.machine):
                for tally in day.tallies.values():
                    total = Tally(total.injected + tally.injected, total.reported + tally.reported,
                                  total.unobservable + tally.unobservable, total.missed + tally.missed)
        return total

    def summary(self) -> str:
        """One line."""
        total, hours = self.total(), sum(day.hours for day in self.days)
        kinds = Counter(line.split()[2 if line[0].isdigit() else 0] for day in self.days for line in day.wrong)
        found = ", ".join(f"{count} {kind.lower()}" for kind, count in sorted(kinds.items())) or "nothing wrong"
        return (f"{len(self.days)} days, {hours:g} h: {total.injected} faults, {total.reported} reported, "
                f"{total.unobservable} without a visible symptom, {total.missed} missed; {found}; digest {self.digest}")

    def tables(self) -> str:
        """For the page: by machine, then by fault."""
        lines = ["| machine | hours | faults | reported | no visible symptom | missed | alarms raised | false alarms "
                 "| repairs begun | repaired | locked out |", "|---|---|---|---|---|---|---|---|---|---|---|"]
        for machine in MACHINES:
            days = [day for day in self.days if day.machine == machine]
            events = Counter[str]()
            for day in days:
                events.update(day.events)
            total, false = self.total(machine), sum("FALSE" in line for day in days for line in day.wrong)
            lines.append(f"| {machine} | {sum(day.hours for day in days):g} | {total.injected} | {total.reported} "
                         f"| {total.unobservable} | {total.missed} | {events['raised']} | {false} | {events['repair_started']} "
                         f"| {events['repaired']} | {events['locked_out']} |")
        growth, digest = max(0, self.growth_kb) / 1024, self.digest
        lines += ["", f"Memory of a process: +{growth:.1f} MB from when it had met every machine to the end. Digest of all events: "
                  f"`{digest}`.", "",
                  "| program and fault | injected | reported | no visible symptom | missed |", "|---|---|---|---|---|"]
        lines += [f"| {name} | {tally.injected} | {tally.reported} | {tally.unobservable} | {tally.missed} |"
                  for name, tally in sorted(self.tallies.items())]
        return "\n".join(lines) + "\n"


def _by_process(days: Sequence[DayResult]) -> Iterator[list[DayResult]]:
    for process in dict.fromkeys(day.process for day in days):
        yield sorted((day for day in days if day.process == process), key=lambda day: day.turn)


def _growth_kb(days: Sequence[DayResult]) -> int:
    """From the first day by which a process had met every machine of its days to its last."""
    kinds = {day.machine for day in days}
    met: set[str] = set()
    for day in days:
        met.add(day.machine)
        if met == kinds:
            return days[-1].rss_kb - day.rss_kb
    return 0


def put_into_page(report: Report, seed: int) -> None:
    """Replace the season's counts in docs/reliability.md."""
    before, mark, rest = PAGE.read_text(encoding="utf-8").partition(BEGIN)
    after = rest.partition(END)[2]
    head = f"\nSeed {seed}. {report.summary()}.\n\n"
    PAGE.write_text(f"{before}{mark}{head}{report.tables()}{END}{after}", encoding="utf-8")


class Progress:
    """Tells how far it is: on a terminal a line that changes, else a line now and then."""

    def __init__(self, total: int, done: int):
        self._total, self._done = total, done
        self._began_s = time.monotonic()
        self._here = 0
        self._shown = sys.stdout.isatty()

    def told(self, result: DayResult) -> None:
        """One more day."""
        self._done += 1
        self._here += 1
        for line in result.wrong:
            print(f"{chr(13) if self._shown else ''}day {result.number}, {result.machine}: {line}\x1b[K" if self._shown
                  else f"day {result.number}, {result.machine}: {line}", flush=True)
        left_s = (time.monotonic() - self._began_s) / self._here * (self._total - self._done)
        text = f"{self._done} of {self._total} days, {left_s / 60:.0f} min left"
        if self._shown:
            print(f"\r  {text}\x1b[K", end="", flush=True)
        elif self._here % 10 == 0:
            print(text, flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what is not done yet, and tell."""
    parser = ArgumentParser(prog="python -m benchmarks.season", description=__doc__)
    parser.add_argument("--hours", type=float, default=1000, help="of virtual time (default %(default)s)")
    parser.add_argument("--day", type=float, default=DAY_S, metavar="SECONDS", help="length of a day (default %(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="of everything that is random (default %(default)s)")
    parser.add_argument("--jobs", type=int, default=2, help="processes (default %(default)s)")
    parser.add_argument("--machine", choices=[*MACHINES], help="this one only")
    parser.add_argument("--fresh", action="store_true", help="finished days of an earlier run don't count")
    parser.add_argument("--report", action="store_true", help="run nothing: the counts of the finished days")
    parser.add_argument("--write", action="store_true", help=f"write {PAGE.name}")
    parser.add_argument("--cache", type=Path, default=cache_folder(), help="folder for finished days (default %(default)s)")
    args = parser.parse_args(arguments)
    length_ns = round(args.day * S)
    if length_ns < SHORTEST_DAY_S * S or args.hours <= 0 or args.jobs < 1:
        parser.error(f"a day needs {SHORTEST_DAY_S} s at least, the season more than 0 h, and one process")
    count = max(1, round(args.hours * 3600 / args.day))
    kept = Kept(args.cache)
    days = {number: (args.seed, number, length_ns, args.machine) for number in range(count)}
    results = {result.number: result for result in ([] if args.fresh else kept.load([*days.values()]))}
    jobs = [] if args.report else [job for number, job in days.items() if number not in results]
    if results:
        print(f"{len(results)} day{'s were' if len(results) > 1 else ' was'} finished before", flush=True)
    progress = Progress(count, len(results))
    try:
        for result in run(jobs, min(args.jobs, max(1, len(jobs)))):
            results[result.number] = result
            kept.store(days[result.number], result)
            progress.told(result)
    except KeyboardInterrupt:
        print(f"\nstopped; the same command goes on from here: {len(results)} of {count} days are kept in {args.cache}")
    report = Report(results.values())
    for line in report.wrong if args.report else report.wrong[-1:] * (report.growth_kb > GROWTH_KB):
        print(line)
    print(f"{chr(13)}{report.summary()}\x1b[K" if sys.stdout.isatty() else report.summary())
    if args.write:
        put_into_page(report, args.seed)
    return 1 if report.wrong or len(results) < count else 0


if __name__ == "__main__":
    for ending in (signal.SIGINT, signal.SIGTERM):  # also where a shell has it started in the background, deaf to Ctrl-C
        signal.signal(ending, signal.default_int_handler)
    sys.exit(main())
