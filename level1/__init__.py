"""Level 1: the core that turns frames into verdicts, alarms, repairs and events. It performs no I/O; `level1.io` does."""
