"""Marks: commands and answers of a run, told apart from polls."""

from motorhil.harness.swarm.worlds.marks import Marks, Traffic, traffic_from

MS = 1_000_000


class World:
    """Taps of an emulation, whose frames a test sends."""

    def __init__(self):
        self.frames, self.adus = [], []
        self.tap_frames, self.tap_lines = self.frames.append, self.adus.append

    def frame(self, at_ms, sender, identifier, data):
        frame = identifier.to_bytes(4, "little") + bytes((len(data), 0, 0, 0)) + data
        for tap in self.frames:
            tap("can0", at_ms * MS, sender, frame)

    def adu(self, at_ms, sender, data):
        for tap in self.adus:
            tap("line", (at_ms + 1) * MS, at_ms * MS, (at_ms + 1) * MS, sender, data, 0)


def marks(traffic, sender):
    return next(one.marks for one in traffic if one.sender == sender)


def test_command_is_a_frame_whose_bytes_are_not_repeated_soon():
    world, commands = World(), []
    found = Marks(world, ("left",), lambda identifier, at_ns: commands.append((identifier, at_ns)))
    world.frame(0, "host", 0x201, b"\x0f")
    world.frame(299, "host", 0x201, b"\x0f")  # a repetition
    world.frame(598, "host", 0x201, b"\x0f")  # of the last one
    world.frame(898, "host", 0x201, b"\x0f")
    world.frame(900, "host", 0x201, b"\x1f")
    assert marks(found.traffic(), "host") == ((0, 0.0), (3, 0.898), (4, 0.9))
    assert commands == [(0x201, 0), (0x201, 898 * MS), (0x201, 900 * MS)]


def test_answer_is_the_first_frame_after_a_command():
    world = World()
    found = Marks(world, ("left",))
    world.frame(0, "left", 0x181, b"\x00")  # before any command
    world.frame(1, "host", 0x201, b"\x0f")
    world.frame(2, "left", 0x181, b"\x01")
    world.frame(3, "left", 0x181, b"\x02")
    assert found.traffic()[0] == Traffic("can0", "left", 0x181, 3, ((1, 0.002),), True)


def test_polls_of_a_line_are_no_commands():
    world = World()
    found = Marks(world, ("left",))
    for at_ms in range(0, 1000, 20):
        world.adu(at_ms, "host", b"\x01\x03")
        world.adu(at_ms + 5, "left", b"\x01\x03\x02")
    world.adu(1000, "host", b"\x01\x06")
    world.adu(1400, "host", b"\x01\x03")  # after a pause
    assert marks(found.traffic(), "host") == ((50, 1.0),)
    assert found.traffic()[0].identifier is None


def test_marks_of_a_time_keep_their_numbers():
    world = World()
    found = Marks(world, ())
    for at_ms in (0, 400, 800):
        world.frame(at_ms, "host", 0x80, b"")
    (stream,) = found.traffic(400 * MS, 799 * MS)
    assert (stream.frames, stream.marks) == (3, ((1, 0.4),))
    assert traffic_from(stream.as_row()) == stream
