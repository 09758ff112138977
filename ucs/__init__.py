"""The `ucs` command: it puts the parts together; what they do stands in `level1`, `bridge`, `level2`, `firmware_py`."""
