import canopen
import pytest

from motorhil.emulators.cia402.settings import OWN_EDS
from tests.support.canopen.drive_wire import Wire
from tests.support.canopen.pumped_client import PumpedNode402
from tests.support.canopen.wire_client import WireNetwork, connect

Connected = tuple[Wire, WireNetwork, PumpedNode402]


@pytest.fixture
def wire() -> Wire:
    """Return a wire with one drive of ours, node 5, just booted."""
    return Wire().boot()


@pytest.fixture
def connected(monkeypatch: pytest.MonkeyPatch) -> Connected:
    """Return the same wire with canopen's client, its SDO clients pumped."""
    wire = Wire()
    network, node = connect(wire, OWN_EDS, monkeypatch)
    return wire, network, node


def aborted(call) -> int:
    """Return the abort code of the server for this call."""
    with pytest.raises(canopen.SdoAbortedError) as caught:
        call()
    return caught.value.code
