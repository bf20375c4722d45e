"""Settings of motors behind polled drives on Modbus lines."""

from typing import Final, final

from motorhil.frozen import frozen
from motorhil.settings import REQUIRED, number, text, whole

BUS_KINDS: Final = ("modbus_rtu", "modbus_tcp")


@final
@frozen(kw_only=True, slots=False)
class PolledTable:
    """A motor behind a drive on a Modbus line."""

    unit: int = whole(REQUIRED, 1, 247, "", "Server address of the drive.", example="1")
    name: str | None = text(None, "Name of the motor; absent: the model's.")
    timeout_s: float = number(0.2, 0.001, 60.0, "s", "Response timeout.", plausible=(0.005, 30.0))
