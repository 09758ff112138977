"""`ucs demo`: the whole chain, by itself, to the end, and away without a trace."""
from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

DEMO = (sys.executable, "-m", "ucs", "demo")


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """What the demo prints, twenty times faster than in the shop; the folder for its files must be empty afterwards."""
    folder = tmp_path_factory.mktemp("demo")
    result = subprocess.run([*DEMO, "--faster", "20"], capture_output=True, text=True, timeout=100, check=False,
                            env={**os.environ, "TMPDIR": str(folder)})
    assert (result.returncode, result.stderr) == (0, "")
    assert not list(folder.iterdir())
    return result.stdout.splitlines()


def place(told: list[str], *patterns: str) -> list[int]:
    """Where lines that match stand, each after the one before."""
    places: list[int] = []
    for pattern in patterns:
        start = places[-1] + 1 if places else 0
        places.append(next((number for number in range(start, len(told)) if re.search(pattern, told[number])), -1))
        assert places[-1] >= 0, f"no line like {pattern!r} after line {start} of\n" + "\n".join(told)
    return places


def test_the_first_act_goes_from_the_lost_flame_to_repaired_and_cleared_at_level_2(told: list[str]) -> None:
    place(told, "demo .*fault injected: .*pilot", "tractor .*pilot flame out", "level 1 .*PilotFlameOut  raised",
          "level 1 .*repair started", "wait 30 s", "tractor .*gas valve closed", "tractor .*purged", "tractor .*pilot flame burns",
          "level 1 .*repaired", "level 2 .*cleared .*stored")


def test_the_second_act_goes_over_three_attempts_to_locked_out(told: list[str]) -> None:
    place(told, "^2 ", "igniter dead", "attempt 1$", "repair failed *attempt 1", "attempt 2$", "repair failed *attempt 2",
          "attempt 3$", "repair failed *attempt 3", "level 1 .*locked out", "level 2 .*locked out .*stored")


def test_every_event_reaches_level_2_and_is_acknowledged(told: list[str]) -> None:
    stored = [line for line in told if " level 2 " in line and "stored" in line]
    assert len(stored) == 12
    delivered = [int(match[1]) for line in told if (match := re.search(r"bridge .* (\d+) events? delivered", line))]
    assert sum(delivered) == 12


def test_the_purge_is_not_shortened_only_shown_faster(told: list[str]) -> None:
    seconds = {name: float(next(line for line in told if name in line).split()[0]) for name in ("gas valve closed", "purged")}
    assert seconds["purged"] - seconds["gas valve closed"] >= 30
    assert any("6 times faster" in line for line in told)


def test_it_ends_with_one_line_that_sums_up(told: list[str]) -> None:
    summed = re.fullmatch(r"2 alarms: 1 repaired, 1 locked out with the gas valve closed; 12 of 12 events acknowledged by level 2; "
                          r"(\d+) s of the tractor's time in \d+ s", told[-1])
    assert summed and int(summed[1]) >= 1050, "nothing is left out; how long level 2 took to answer is added"


def test_ctrl_c_ends_it_cleanly(tmp_path: Path) -> None:
    with subprocess.Popen(DEMO, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                          env={**os.environ, "TMPDIR": str(tmp_path)}) as process:
        assert process.stdout and process.stderr
        for line in process.stdout:
            if "order: flaming on" in line:
                break
        process.send_signal(signal.SIGINT)
        assert process.wait(30) == 130
        assert process.stderr.read() == "ucs: stopped by Ctrl-C\n"
    assert not list(tmp_path.iterdir())
