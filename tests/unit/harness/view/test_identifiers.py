"""The table of messages: counts, periods, jitter, and bytes that have changed."""

import struct

from motorhil.harness.report.buses import Traffic
from motorhil.harness.view.identifiers import IdentifierTable

MS = 1_000_000


def frame(*data):
    return struct.pack("<IB3x8s", 0x181, len(data), bytes(data))


class Bus:
    """One bus with two labels, of which the second has priority."""

    def __init__(self):
        self.traffic = Traffic("can0", "CAN", "bit", 1e6)
        self.traffic.label("181h", 2, "TPDO 1")
        self.traffic.label("080h", 1, "SYNC")
        self.table = IdentifierTable()

    def take(self, times_ms, contents=None, key=0):
        for time_ms in times_ms:
            self.traffic.add(round(time_ms * MS), key, 100)
        fresh = self.traffic.latest(len(times_ms))
        self.table.count(self.traffic, fresh, contents)
        return self

    def rows(self, every=False):
        return self.table.take([self.traffic], every)


def test_first_message_has_no_period():
    (row,) = Bus().take([5], {0: frame(1, 2)}).rows()
    assert (row["label"], row["count"], row["last_s"]) == ("181h", 1, 0.005)
    assert (row["period_s"], row["jitter_s"], row["data"]) == (None, 0.0, "01 02")
    assert row["changed"] == 0


def test_period_is_that_of_the_latest_messages_jitter_of_all():
    bus = Bus().take([0, 10, 20, 30, 41])
    (row,) = bus.rows()
    assert (row["period_s"], row["jitter_s"]) == (0.01025, 0.001)
    (row,) = bus.take([61]).rows()
    assert (row["count"], row["period_s"], row["jitter_s"]) == (6, 0.020, 0.010)
    (row,) = bus.take([71]).rows()
    assert (row["period_s"], row["jitter_s"]) == (0.010, 0.010)


def test_bytes_that_differ_from_the_row_before_are_marked():
    bus = Bus().take([0], {0: frame(1, 2, 3)})
    bus.rows()
    (row,) = bus.take([10], {0: frame(1, 9, 3)}).rows()
    assert row["changed"] == 0b010
    (row,) = bus.take([20], {0: frame(1, 9, 3)}).rows()
    assert row["changed"] == 0
    (row,) = bus.take([30], {0: frame(1, 9, 3, 0)}).rows()
    assert row["changed"] == 0b1000
    (row,) = bus.take([40], {0: frame()}).rows()
    assert (row["changed"], row["data"]) == (0, "")


def test_only_rows_with_news_are_returned_unless_all_are_asked_for():
    bus = Bus().take([0, 10]).take([10], key=1)
    assert [row["label"] for row in bus.rows()] == ["080h", "181h"]
    assert bus.rows() == []
    bus.take([20])
    assert [row["label"] for row in bus.rows()] == ["181h"]
    assert [row["label"] for row in bus.rows(every=True)] == ["080h", "181h"]
