"""An episode in time, computed again while it is played."""

from motorhil.emulators.can.bitlevel.episode import EventKind, Station
from motorhil.emulators.can.bus.playback import Playback
from tests.support.can.deliveries import BIT
from tests.support.can.faulty_bus import STATUS


def playback() -> Playback:
    stations = [Station(0, (STATUS,)), Station(1), Station(2)]
    return Playback(0, (BIT, BIT), stations, [], [])


def test_absent_node_does_not_leave_twice():
    """STATUS, 63 bits. Its sender is cut off in bit 20, and that cable is cut again in bit 50."""
    played = playback()
    played.leave(0, 20 * BIT)
    first = played.end
    played.leave(0, 50 * BIT)
    assert played.end == first
    assert not [event for event in first.events if event.kind is EventKind.ACCEPTED]
    played.leave(1, 60 * BIT)
    assert [station.leaves_at for station in played.stations] == [20, 60, None]


def test_bit_at_is_first_bit_beginning_then_or_later():
    played = playback()
    assert [played.bit_at(time_ns) for time_ns in (0, 1, BIT, BIT + 1)] == [0, 1, 1, 2]


def test_finished_episode_does_not_continue():
    played = playback()
    assert played.over_ns == 66 * BIT
    assert not played.go_on()
