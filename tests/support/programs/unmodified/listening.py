"""python-can alone: a Notifier with listeners, a receiving thread, a cyclic message."""

import threading
import time

import can


class Counter(can.Listener):
    def __init__(self):
        self.counts = {}

    def on_message_received(self, message):
        self.counts[message.arbitration_id] = self.counts.get(message.arbitration_id, 0) + 1


def receive(bus, heard):
    while (message := bus.recv(1.0)) is not None:
        heard.append(round(time.time() - message.timestamp, 3))


with can.Bus() as bus, can.Bus() as second:
    counter, mailbox, heard = Counter(), can.BufferedReader(), []
    notifier = can.Notifier(bus, [counter, mailbox])
    receiver = threading.Thread(target=receive, args=(second, heard))
    receiver.start()
    request = can.Message(
        arbitration_id=0x601, data=[0x40, 0, 0x10, 0, 0, 0, 0, 0], is_extended_id=False
    )
    task = bus.send_periodic(request, 0.1)
    time.sleep(1.05)
    task.stop()
    receiver.join()
    notifier.stop()
    mails = 0
    while mailbox.get_message(timeout=0.1) is not None:
        mails += 1
    print({f"{number:X}": count for number, count in sorted(counter.counts.items())}, mails)
    print(f"{len(heard)} heard, {max(heard)} s late; {time.time():.2f} s")
