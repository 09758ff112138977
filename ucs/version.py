"""Which version of the program this is."""
from __future__ import annotations


def version() -> str:
    """Of the installed package; empty for a source folder that is not installed."""
    from importlib.metadata import PackageNotFoundError
    from importlib.metadata import version as installed
    try:
        return installed("tractor-ucs")
    except PackageNotFoundError:
        return ""
