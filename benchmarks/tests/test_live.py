"""The benchmark of the live loop runs where the kernel has no CAN."""
from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path


def test_the_command_prints_the_ratio_and_a_line_for_each_contender() -> None:
    done = subprocess.run([sys.executable, "-m", "benchmarks.live", "--frames", "2000", "--seconds", "0.2", "--rounds", "1"],
                          capture_output=True, text=True, cwd=Path(__file__).parents[2])
    assert done.returncode == 0, done.stderr
    ratio = re.search(r"^ratio: ([\d.]+)$", done.stdout, re.MULTILINE)
    assert ratio and float(ratio[1]) > 0
    rows = re.findall(r"^  (.{34})((?: +[\d.]+){8})$", done.stdout, re.MULTILINE)
    assert [name.split()[0] for name, _ in rows] == ["the", "python-can", "the"]
    assert all(figures.split()[5] == "0" for _, figures in rows), "frames lost"
