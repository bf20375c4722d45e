"""Controllers on one wire, compared bit by bit with independent ones."""

from random import Random

import pytest

from motorhil.emulators.can.bitlevel.controller import (
    NOTE_ACCEPTED,
    NOTE_ERROR,
    NOTE_FAILED,
    NOTE_LOST,
    NOTE_SENT,
    CanStation,
)
from motorhil.emulators.can.controller_config import FrameSupport
from motorhil.emulators.can.error_confinement import Confinement
from tests.support.can import fd_frame_bits as wire_fd
from tests.support.can import frame_bits as wire
from tests.support.can.reference_node import ReferenceNode, Sent

SUPPORT = {
    "classical": FrameSupport.CLASSICAL,
    "tolerant": FrameSupport.FD_TOLERANT,
    "fd": FrameSupport.FD,
}
COUNTERS = (0, 0, 0, 0, 1, 95, 96, 119, 120, 127, 128, 136, 200, 247, 248, 255)
IDENTIFIERS = (0x000, 0x07C, 0x0F0, 0x0F1, 0x2AA, 0x3FF, 0x7C1, 0x7FF)
WORDS = {
    NOTE_ACCEPTED: "accepted ",
    NOTE_SENT: "sent ",
    NOTE_FAILED: "failed",
    NOTE_LOST: "lost",
    NOTE_ERROR: "error",
}


def random_frame(random: Random, fd: bool) -> Sent:
    extended = random.random() < 0.3
    identifier = random.choice(IDENTIFIERS)
    if extended:
        identifier = identifier << 18 | random.choice((0, 0x3FFFF, 0x0F0F0, random.getrandbits(18)))
    if fd and random.random() < 0.6:
        data = bytes(random.choices((0x00, 0xFF, 0x0F, 0x55), k=random.choice((0, 1, 2, 20))))
        return Sent(wire_fd.FdFields(identifier, extended, False, random.random() < 0.1, data))
    remote = random.random() < 0.2
    size = random.randrange(3)
    data = b"" if remote else bytes(random.choices((0x00, 0xFF, 0x0F, 0x55), k=size))
    return Sent(wire.Fields(identifier, extended, remote, size, data))


def random_node(random: Random, support: str, sends: bool) -> tuple[CanStation, ReferenceNode]:
    count = random.choice((1, 1, 2)) if sends else random.choice((0, 0, 0, 1))
    queue = [random_frame(random, support == "fd") for _ in range(count)]
    tec, rec = random.choice(COUNTERS), random.choice(COUNTERS)
    once = random.random() < 0.2
    station = CanStation(
        [frame.can_frame() for frame in queue], Confinement(tec, rec), once, SUPPORT[support]
    )
    return station, ReferenceNode(queue, tec, rec, support, once)


def strikes_for(random: Random, ports: int, bits: int) -> dict[tuple[int, int], str]:
    """Return (bit, port) -> change of the level sampled there."""
    found: dict[tuple[int, int], str] = {}
    for _ in range(random.choice((0, 1, 1, 2, 3, 6))):
        first = random.randrange(bits)
        length = random.choice((1, 1, 1, 1, 2, 3, 6, 7, 8, 14, 30))
        mask = random.choice((-1, *range(1, 1 << ports)))
        effect = random.choice(("flip", "flip", "0", "1"))
        for bit in range(first, first + length):
            for port in range(ports):
                if mask >> port & 1:
                    found[bit, port] = effect
    return found


def compare(seed: int) -> dict[str, int]:
    """Run one case and return the names of the situations reached."""
    random = Random(seed)
    ports = random.randrange(1, 5)
    kinds = random.choice((("classical",), ("fd",), ("fd", "tolerant"), ("fd", "classical")))
    bits = random.choice((120, 200, 320))
    nodes = [random_node(random, random.choice(kinds), not port) for port in range(ports)]
    strikes = strikes_for(random, ports, random.choice((60, 110, 160)))
    lives = []
    for station, reference in nodes:
        integrating = 11 if random.random() < 0.1 else 0
        suspended = random.choice((0, 0, 0, 0, 8)) if not integrating else 0
        if integrating:
            station.begin_integrating(integrating)
        else:
            station.begin_idle(suspended)
        life = reference.live(integrating, suspended)
        lives.append((station, reference, life, [next(life)]))
    for bit in range(bits):
        drives = [station.drives for station, _, _, _ in lives]
        where = f"seed {seed}, bit {bit}"
        assert drives == [sends[0] for _, _, _, sends in lives], where
        for port, (station, reference, life, sends) in enumerate(lives):
            effect = strikes.get((bit, port), "")
            level = min(drives)
            level = 1 - level if effect == "flip" else int(effect or level)
            reference.bit = bit
            station.hear(level, bit)
            sends[0] = life.send(level)
            counted = (station.confinement.tec, station.confinement.rec)
            assert counted == (reference.tec, reference.rec), f"{where}, port {port}"
    reached: dict[str, int] = {}
    for port, (station, reference, _, _) in enumerate(lives):
        noted = [
            (bit, WORDS[kind] + (frame.hex() if kind in (NOTE_ACCEPTED, NOTE_SENT) else ""))
            for bit, kind, frame in station.journal.notes
            if kind in WORDS
        ]
        assert sorted(noted) == sorted(reference.told), f"seed {seed}, port {port}"
        assert station.off_at == reference.off_at, f"seed {seed}, port {port}"
        for _, what in reference.told:
            word = what.split()[0]
            reached[word] = reached.get(word, 0) + 1
        if reference.off_at >= 0:
            reached["off"] = reached.get("off", 0) + 1
    return reached


@pytest.mark.parametrize("block", range(4))
def test_bits_and_counters_equal_reference(block):
    """Random frames, counters, kinds of controllers and disturbances; a failure names its seed."""
    reached: dict[str, int] = {}
    for seed in range(block * 250, block * 250 + 250):
        for word, count in compare(seed).items():
            reached[word] = reached.get(word, 0) + count
    for word in ("accepted", "sent", "failed", "lost", "error", "off"):
        assert reached[word] > 10, f"{word}: {reached.get(word, 0)} times only"
