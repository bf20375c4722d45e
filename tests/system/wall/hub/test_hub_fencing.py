"""Fencing by a hub, by the token of each frame."""

import can
import pytest

from motorhil.emulators.simulation.ownership_notice import (
    RECORD_MAX,
    STALE,
    OwnershipNotice,
    pack_owns,
    pack_stale,
    unpack_owns,
    unpack_stale,
)
from motorhil.motorapi.errors import MotorBusyError
from tests.system.wall.hub.test_hub import message, serving

pytestmark = pytest.mark.wall

NODE = 3
TAKEN, RELEASED, WAITING, TAKEN_OVER, LOST = 1, 2, 3, 6, 7


@pytest.fixture
def path(tmp_path):
    return str(tmp_path / "hub")


def opened(path):
    return can.Bus(interface="emulated", channel=path)


def frame(value):
    return (0x203).to_bytes(4, "little") + b"\x01\0\0\0" + bytes((value,)).ljust(8, b"\0")


def heard_until(witness, can_id):
    """Return the first bytes of the frames received before the frame that ends them."""
    values = []
    while True:
        one = witness.recv(30.0)
        assert one is not None, "the last frame was not heard"
        if one.arbitration_id == can_id:
            return values
        values.append(one.data[0])


def settled(bus, witness, can_id=0x700):
    """Wait until all frames of `bus` so far are processed."""
    bus.send(message(can_id))
    return heard_until(witness, can_id)


def refusal(bus):
    """Wait until the hub's reply has come to `bus`."""
    while not bus._hub.stale:
        bus.recv(0.1)


def test_frame_with_an_older_token_is_not_sent_on_the_bus(path):
    with serving(path), opened(path) as old, opened(path) as new, opened(path) as witness:
        old.transmit_fenced(frame(1), NODE, 7)
        assert settled(old, witness) == [1]
        new.transmit_fenced(frame(2), NODE, 8)
        assert settled(new, witness, 0x701) == [2]
        old.transmit_fenced(frame(3), NODE, 7)
        old.transmit_fenced(frame(4), NODE + 1, 1)  # of another motor
        assert settled(old, witness, 0x702) == [4]
        new.transmit_fenced(frame(5), NODE, 8)
        assert settled(new, witness, 0x703) == [5]


def test_takeover_notice_ends_the_other_ones_frames(path):
    with serving(path), opened(path) as old, opened(path) as new, opened(path) as witness:
        old.transmit_fenced(frame(1), NODE, 7)
        assert settled(old, witness) == [1]
        new.announce_ownership(NODE, TAKEN_OVER, 8)
        assert settled(new, witness, 0x701) == []
        old.transmit_fenced(frame(2), NODE, 7)
        assert settled(old, witness, 0x702) == []


def test_waiting_or_releasing_takes_nothing(path):
    with serving(path), opened(path) as owner, opened(path) as other, opened(path) as witness:
        for action in (WAITING, RELEASED, LOST):
            other.announce_ownership(NODE, action, 1_000)
        assert settled(other, witness) == []
        owner.transmit_fenced(frame(1), NODE, 7)
        assert settled(owner, witness, 0x701) == [1]


def test_refused_client_is_told_the_owner_and_raises_next(path):
    with serving(path), opened(path) as old, opened(path) as new, opened(path) as witness:
        new.announce_ownership(NODE, TAKEN_OVER, 8, purpose="rescue")
        assert settled(new, witness) == []
        old.transmit_fenced(frame(1), NODE, 7)
        refusal(old)
        with pytest.raises(MotorBusyError) as caught:
            old.transmit_fenced(frame(2), NODE, 7)
        text = str(caught.value)
        assert text.startswith(f"{path} node 3 is held by ")
        assert text.endswith("for rescue since it took it over (token 8; ours was 7)")
        old.transmit_fenced(frame(3), NODE, 9)  # it has taken the motor again
        assert settled(old, witness, 0x701) == [3]


def test_world_is_notified_of_refusals_once_and_ownership(path):
    events, notices = [], []
    with serving(path) as world, opened(path) as old, opened(path) as new, opened(path) as witness:
        world.tap_events(lambda time_ns, *event: events.append(event))
        world.tap_ownership(lambda bus, time_ns, sender, notice: notices.append((bus, notice)))
        new.announce_ownership(
            *(NODE, TAKEN_OVER, 8),
            **{"owner": "start() of pan", "holder": "pid 12 (old.py)", "purpose": "rescue"},
            **{"program": "new.py", "pid": 34, "waited_ns": 5, "held_ns": 6},
        )
        new.announce_ownership(NODE, RELEASED, 8)
        settled(new, witness)
        for value in range(3):
            old.transmit_fenced(frame(value), NODE, 7)
        assert settled(old, witness, 0x701) == []
    words = ("start() of pan", "pid 12 (old.py)", "rescue", "new.py")
    assert notices == [
        ("can0", OwnershipNotice(NODE, TAKEN_OVER, 8, *words, 34, 5, 6)),
        ("can0", OwnershipNotice(NODE, RELEASED, 8)),
    ]
    (event,) = events
    assert event[:2] == ("warning", "can0")
    assert "refused: token 7, and node 3 is owned under token 8 by " in event[2]


def test_leaving_client_with_motors_is_reported(path):
    events = []
    with serving(path) as world, opened(path) as witness:
        world.tap_events(lambda time_ns, *event: events.append(event))
        with opened(path) as dies:
            for resource in (NODE, NODE + 256, NODE + 512):
                dies.announce_ownership(resource, TAKEN, 7)
            dies.announce_ownership(NODE, WAITING, 0)  # another thread of it
            dies.announce_ownership(NODE + 512, RELEASED, 7)
            assert settled(dies, witness) == []
        with opened(path) as gives_back:
            gives_back.announce_ownership(NODE + 1, TAKEN, 1)
            gives_back.announce_ownership(NODE + 1, LOST, 1)
            assert settled(gives_back, witness) == []
        stays = opened(path)
        stays.announce_ownership(NODE + 2, TAKEN, 1)
        assert settled(stays, witness) == []
    stays.shutdown()  # the hub left before it did
    (event,) = events
    assert event[:2] == ("warning", "can0")
    assert event[2].endswith(
        " has left, and has not given back node 3 (token 7), node 3 channel 1 (token 7)"
    ), event


def test_each_bus_has_motors_of_its_own(path):
    with (
        serving(path),
        opened(path) as other,
        opened(path + "#can1") as bus,
        opened(path + "#can1") as witness,
    ):
        other.announce_ownership(NODE, TAKEN, 1_000)
        other.send(message(0x700))
        bus.transmit_fenced(frame(1), NODE, 7)
        assert settled(bus, witness) == [1]


def test_long_texts_are_cut_to_fit_a_record():
    long = "\N{GREEK SMALL LETTER MU}" * 300
    record = pack_owns(OwnershipNotice(0xFFFF, 255, 2**64 - 1, long, long, "a\0b", long))
    assert len(record) <= RECORD_MAX
    notice = unpack_owns(record)
    assert (notice.resource, notice.action, notice.token) == (0xFFFF, 255, 2**64 - 1)
    assert notice.purpose == "a b"
    assert set(notice.owner + notice.holder + notice.program) == {"\N{GREEK SMALL LETTER MU}"}
    stale = pack_stale(NODE, 2**64 - 1, long)
    assert stale[0] == STALE
    assert len(stale) <= RECORD_MAX
    assert unpack_stale(stale)[:2] == (NODE, 2**64 - 1)


def test_invalid_ownership_message_is_ignored(path):
    with serving(path), opened(path) as bus, opened(path) as witness:
        for rubbish in (b"\x04", b"\x05", b"\x05" * 32, b"\x04" * 26, b"\x0f", b"\x06rest"):
            bus._hub._send(rubbish)
        assert settled(bus, witness) == []
