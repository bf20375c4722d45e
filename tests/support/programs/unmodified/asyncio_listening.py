"""python-can with asyncio: a Notifier in the event loop, a reader, timeouts, and a thread."""

import asyncio
import time

import can


async def ask(bus, period_s, count):
    request = can.Message(
        arbitration_id=0x601, data=[0x40, 0, 0x10, 0, 0, 0, 0, 0], is_extended_id=False
    )
    for _ in range(count):
        bus.send(request)
        await asyncio.sleep(period_s)


async def hear(reader, heard):
    while True:
        message = await asyncio.wait_for(reader.get_message(), 0.5)
        heard.append((message.arbitration_id, round(time.time() - message.timestamp, 3)))


async def main():
    with can.Bus() as bus:
        reader, heard = can.AsyncBufferedReader(), []
        notifier = can.Notifier(bus, [reader], loop=asyncio.get_running_loop())
        _, ended, _ = await asyncio.gather(
            ask(bus, 0.1, 8),
            hear(reader, heard),
            asyncio.to_thread(time.sleep, 0.5),
            return_exceptions=True,
        )
        notifier.stop()
    counts = {f"{one:X}": [can_id for can_id, _ in heard].count(one) for one in {*dict(heard)}}
    print(dict(sorted(counts.items())), max(late_s for _, late_s in heard), "s late")
    print(f"{type(ended).__name__}; {time.time():.2f} s")


asyncio.run(main())
