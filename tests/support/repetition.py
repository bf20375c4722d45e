"""Numbers of random examples: few in `make test`, many in `make nightly`."""

import os

IS_NIGHTLY = os.environ.get("MOTORHIL_HYPOTHESIS") == "nightly"
MANY = 50


def examples(by_day: int) -> int:
    """Return how many random examples a test tries."""
    return by_day * MANY if IS_NIGHTLY else by_day
