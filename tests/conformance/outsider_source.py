"""Where the outsider's package is; its sources, importable where it is not installed."""

import sys

from tests.architecture.checkout import CHECKOUT

OUTSIDER = CHECKOUT / "tests" / "conformance" / "outsider"


def importable(monkeypatch):
    """`motorhil_odrive` can be imported while this test runs."""
    monkeypatch.syspath_prepend(OUTSIDER / "src")
    for name in [name for name in sys.modules if name.split(".")[0] == "motorhil_odrive"]:
        monkeypatch.delitem(sys.modules, name)
