"""The outsider's package, importable from its sources without installation."""

import sys

from tests.support.checkout import CHECKOUT

OUTSIDER = CHECKOUT / "tests" / "conformance" / "outsider"


def importable(monkeypatch):
    """Make `motorhil_odrive` importable while this test runs."""
    monkeypatch.syspath_prepend(OUTSIDER / "src")
    for name in [name for name in sys.modules if name.split(".")[0] == "motorhil_odrive"]:
        monkeypatch.delitem(sys.modules, name)
