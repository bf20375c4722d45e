"""Fuzzing of Modbus drives: nothing is raised, and registers remain readable.

Random functions, addresses around the drive's own registers, counts and values. A tenth of the ADUs
are cut, extended or have a flipped bit; most have a valid CRC (Modbus over Serial Line, 6.2).
"""

from random import Random

import pytest

from motorhil.emulators.leadshine_pr.drive import build as build_leadshine
from motorhil.emulators.modbus.rtu import with_crc
from motorhil.emulators.oriental_az.drive import build as build_oriental
from tests.support.modbus.bench import ModbusBench

ADUS = 2_000
FUNCTIONS = (0x03, 0x03, 0x06, 0x06, 0x10, 0x10, 0x17, 0x08, 0x2B, 0x01, 0x04)
VALUES = (0, 1, 2, 5, 0x10, 0x7FFF, 0x8000, 0xFFFF)
KINDS = {
    "leadshine_pr": build_leadshine,
    "oriental_az": build_oriental,
}


def adu(dice, addresses):
    """Return a valid-looking or invalid ADU."""
    function, address = dice.choice(FUNCTIONS), dice.choice(addresses) + dice.choice((0, 0, 0, 1))
    count = dice.choice((1, 1, 2, 4, 125))
    values = b"".join(dice.choice(VALUES).to_bytes(2, "big") for _ in range(count))
    head = bytes((dice.choice((1, 1, 1, 1, 0, 2)), function)) + address.to_bytes(2, "big")
    if function == 0x06:
        body = values[:2]
    elif function in (0x10, 0x17):
        body = count.to_bytes(2, "big") + bytes((2 * count & 0xFF,)) + values
    elif function == 0x2B:
        return with_crc(bytes((1, 0x2B, 0x0E, dice.randrange(6), dice.randrange(8))))
    else:
        body = count.to_bytes(2, "big")
    data = head + body
    chance = dice.random()
    if chance < 0.04:
        data = data[: dice.randrange(1, len(data))]
    elif chance < 0.08:
        data = (data + dice.randbytes(9))[:250]
    elif chance < 0.1:
        return dice.randbytes(dice.randrange(1, 200))
    return with_crc(data[:254])


@pytest.mark.parametrize("kind", KINDS)
def test_modbus_drive_survives_any_adu_and_still_answers(kind):
    build = KINDS[kind]
    dice = Random(f"fuzz {kind}")
    addresses = [row.address for row in build.registers()]
    bench = ModbusBench(build)
    answers = []
    for _ in range(ADUS):
        bench._heard.clear()
        bench._host.send(adu(dice, addresses))
        bench.run_ms(dice.choice((60, 90)))
        answers.extend(bench._heard)
        bench.events.clear()
        assert set(bench.truth()) >= {"position_rad", "velocity_rad_s", "current_a"}
    assert all(with_crc(answer[:-2]) == answer for answer in answers)
    refused = {answer[2] for answer in answers if answer[1] & 0x80}
    assert {1, 2, 3} <= refused  # function, address, value
    assert sum(not answer[1] & 0x80 for answer in answers) > ADUS / 10
    bench.run_ms(100)
    assert len(bench.ask(f"03 {addresses[0]:04X} 0001")) == 4
