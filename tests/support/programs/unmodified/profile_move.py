"""A user's program: python-can, canopen and the standard library, without motorhil."""

import queue
import sys
import threading
import time

import canopen
from canopen.profiles.p402 import BaseNode402


def configure(node):
    node.sdo[0x1017].raw = 100
    node.tpdo.read()
    node.rpdo.read()
    for number, indices in ((1, (0x6041, 0x6061)), (2, (0x6064,))):
        node.tpdo[number].clear()
        for index in indices:
            node.tpdo[number].add_variable(index)
        node.tpdo[number].trans_type = 1
        node.tpdo[number].enabled = True
    node.rpdo[1].clear()
    node.rpdo[1].add_variable(0x6040)
    node.rpdo[1].trans_type = 255
    node.rpdo[1].enabled = True
    node.tpdo.save()
    node.rpdo.save()
    node.setup_402_state_machine()


def move(node, place):
    node.sdo[0x6081].raw = 100_000
    node.sdo[0x607A].raw = place
    node.controlword = 0x1F
    deadline = time.monotonic() + 5.0
    time.sleep(0.05)
    while not node.statusword & 0x0400:
        if time.monotonic() > deadline:
            raise TimeoutError("not there")
        node.check_statusword()
    node.controlword = 0x0F


def watch(node, places, done):
    while not done.is_set():
        places.put((time.monotonic(), node.tpdo_values[0x6064]))
        time.sleep(0.05)


def find_by_lss(network, identity):
    network.lss.send_switch_state_selective(*(identity[part].raw for part in (1, 2, 3, 4)))
    number = network.lss.inquire_node_id()
    network.lss.send_switch_state_global(network.lss.WAITING_STATE)
    return number


def main(eds):
    network = canopen.Network()
    network.connect()
    node = BaseNode402(1, eds)
    network.add_node(node)
    node.nmt.wait_for_bootup(2.0)
    print(f"booted at {time.time():.1f} s; LSS finds node {find_by_lss(network, node.sdo[0x1018])}")
    configure(node)
    network.sync.start(0.01)
    node.nmt.state = "OPERATIONAL"
    print(f"{node.nmt.wait_for_heartbeat()}, EMCY: {node.emcy.wait(timeout=0.2)}")
    node.op_mode = "PROFILED POSITION"
    node.state = "OPERATION ENABLED"
    places, done = queue.Queue(), threading.Event()
    watcher = threading.Thread(target=watch, args=(node, places, done), name="watcher")
    watcher.start()
    for place in (50_000, 0):
        move(node, place)
        print(f"{node.sdo[0x6064].raw} at {time.time():.3f} s")
    done.set()
    watcher.join()
    seen = [places.get_nowait()[1] for _ in range(places.qsize())]
    print(f"{len(seen)} places seen, the farthest {max(seen)}")
    network.sync.stop()
    network.disconnect()


main(sys.argv[1])
