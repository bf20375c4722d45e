"""Options of the pytest plugin, and what its parts store in pytest's stashes."""

import os
from pathlib import Path
from typing import Any, Final

import pytest

OPENED: Final[pytest.StashKey[Any]] = pytest.StashKey()
"""Stash key of a test: the rig that was opened for it."""


CURRENT: Final = pytest.StashKey[pytest.Item]()
"""Stash key of the configuration: the test that runs."""


OWN_NAMES: Final = pytest.StashKey[dict[str, str]]()
"""Stash key of the configuration: the name of each option."""


RECORDS: Final = "out"


def option(config: pytest.Config, name: str) -> Any:
    """Return our option's value or default, or None if our options were registered too late."""
    return config.getoption(f"motorhil_{name.replace('-', '_')}", None)


def record_folder(config: pytest.Config) -> Path:
    """Return the folder for records of failed tests."""
    here = config.invocation_params.dir
    named = option(config, "record-dir")
    if named is None and config.inipath is not None:
        return config.inipath.parent / RECORDS
    return here / (named or RECORDS)


def shortened(text: str, config: pytest.Config) -> str:
    """Return the text with paths relative to the folder in which pytest was called."""
    return text.replace(f"{config.invocation_params.dir}{os.sep}", "")
