"""A season of virtual time with random faults, judged against what was broken: `python -m benchmarks.season`."""
