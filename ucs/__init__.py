"""The `ucs` command: it only puts the parts together; what they do stands in `level1`, `bridge`, `level2`, `firmware_py`."""
