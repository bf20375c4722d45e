"""Services by NMT state (CiA 301, table 38; CiA 305)."""

import pytest

from motorhil.emulators.canopen.object_dictionary import DataType, ObjectDictionary
from tests.support.canopen.node_bench import (
    MS,
    NODE_ID,
    UNSIGNED8,
    UNSIGNED32,
    Bench,
    dictionary,
    put,
    put_pdo,
)

# state: commands that lead to it
STATES = {"initialising": 129, "pre-operational": 128, "operational": 1, "stopped": 2}
TABLE = """
service            initialising  pre-operational  operational  stopped
PDO                -             -                x            -
SDO                -             x                x            -
SYNC               -             x                x            -
TIME               -             x                x            -
EMCY               -             x                x            -
heartbeat          -             x                x            x
guarding           -             x                x            x
heartbeat_consumer -             x                x            x
NMT                -             x                x            x
LSS                -             x                x            x
"""
ROWS = [line.split() for line in TABLE.strip().splitlines()[1:]]
CASES = [
    (row[0], state, mark == "x")
    for row in ROWS
    for state, mark in zip(STATES, row[1:], strict=True)
]


def whole() -> ObjectDictionary:
    od = dictionary()
    put_pdo(od, 0x1400, (0x607A_0020,), 255)
    put(od, 0x1012, 0, UNSIGNED32, 0x8000_0100)
    put(od, 0x2012, 0, DataType.TIME_OF_DAY, 0, "ro")
    put(od, 0x1029, 1, UNSIGNED8, 1)
    od.supports_lss = True
    return od


def pdo(bench: Bench) -> bool:
    bench.tell(0x202, "05 00 00 00")
    return bench.od.integer(0x607A, 0, 0) == 5


def sdo(bench: Bench) -> bool:
    return bench.ask("40 18 10 01 00 00 00 00") != ""


def sync(bench: Bench) -> bool:
    bench.tell(0x080, "01")  # SYNC without a counter: its consumer reports the length
    return "082 40 82 11 01 00 00 00 00" in bench.frames()


def time(bench: Bench) -> bool:
    bench.tell(0x100, "01 00 00 00 01 00")
    return bench.od.integer(0x2012, 0, 0) != 0


def emcy(bench: Bench) -> bool:
    bench.node.emergency(0x8611, 0x20, b"", bench.now_ns)
    bench.drain()
    return "082 11 86 21 00 00 00 00 00" in bench.frames()


def heartbeat(bench: Bench) -> bool:
    bench.wait(15 * MS)
    return any(text.startswith("702 ") for text in bench.frames())


def guarding(bench: Bench) -> bool:
    bench.od.get(0x1017).value = 0
    bench.tell(0x4000_0702)
    return any(text.startswith("702 ") for text in bench.frames())


def heartbeat_consumer(bench: Bench) -> bool:
    bench.tell(0x709, "05")
    bench.wait(12 * MS)
    return any(level == "warning" for level, _ in bench.node.take_events())


def nmt(bench: Bench) -> bool:
    before = bench.node.state
    bench.tell(0x000, bytes((2 if before == 5 else 1, NODE_ID)))
    return bench.node.state != before


def lss(bench: Bench) -> bool:
    bench.tell(0x7E5, "04 01 00 00 00 00 00 00")
    bench.tell(0x7E5, "5E 00 00 00 00 00 00 00")
    bench.wait(1 * MS)
    return "7E4 5E 02 00 00 00 00 00 00" in bench.frames()


ASK = {
    **{"PDO": pdo, "SDO": sdo, "SYNC": sync, "TIME": time, "EMCY": emcy, "NMT": nmt, "LSS": lss},
    **{"heartbeat": heartbeat, "guarding": guarding, "heartbeat_consumer": heartbeat_consumer},
}


@pytest.mark.parametrize(("service", "state", "works"), CASES)
def test_service_works_in_its_table_states_only(service, state, works):
    bench = Bench(whole()).boot()
    bench.od.get(0x1017).default = 10
    bench.od.get(0x1016, 1).default = 9 << 16 | 10
    bench.tell(0x000, bytes((129, NODE_ID)))
    if state != "initialising":
        bench.wait(300 * MS)
        bench.tell(0x000, bytes((STATES[state], NODE_ID)))
    bench.frames()
    bench.node.take_events()
    assert ASK[service](bench) == works
