"""pymodbus's own TCP server with changing registers, as a peer process.

python -m tests.benchmarks.pymodbus_peer COUNT      registers and bits 0 to COUNT - 1 of one device

Prints its port and serves until it is killed.
"""

import asyncio
import sys

from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice


async def serve(count: int) -> None:
    """Serve without end."""
    passed = 0

    async def live(
        function: int, start: int, address: int, number: int, registers: list[int], values: object
    ) -> None:
        """Count reads in the first register, which changes as a drive's position does."""
        nonlocal passed
        if function == 3:
            passed += 1
            registers[0] = passed & 0xFFFF

    bits = [SimData(0, count=count, values=False, datatype=DataType.BITS)]
    words = [SimData(0, count=count, values=17, datatype=DataType.REGISTERS)]
    device = SimDevice(1, simdata=(bits, bits, words, words), action=live)
    server = ModbusTcpServer(device, address=("127.0.0.1", 0))
    await server.serve_forever(background=True)
    assert server.transport is not None
    print(server.transport.sockets[0].getsockname()[1], flush=True)
    await asyncio.Event().wait()


if __name__ == "__main__":
    asyncio.run(serve(int(sys.argv[1])))
