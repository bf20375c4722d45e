"""Declared traffic on a CAN bus."""

import pytest

from motorhil.motorapi.errors import UsageError
from motorhil.motorapi.synchronization.bus_load import (
    CanTraffic,
    NodeTraffic,
    PeriodicMessage,
    worst_of,
)


def test_can_fd_frame_without_switch_is_the_worst():
    classical = PeriodicMessage(1, 8, 0.01)
    switched = PeriodicMessage(1, 8, 0.02, fd=True, bit_rate_switch=True)
    assert worst_of([classical, switched]) == (PeriodicMessage(1, 8, 0.01, fd=True),)


def test_equal_base_identifiers_let_the_11_bit_one_win():
    short = PeriodicMessage(0x123, 0, 1.0)
    long = PeriodicMessage(0x123 << 18, 0, 1.0, extended=True)
    before = PeriodicMessage(0x122 << 18 | 0x3FFFF, 0, 1.0, extended=True)
    assert before.rank < short.rank < long.rank < PeriodicMessage(0x124, 0, 1.0).rank


@pytest.mark.parametrize(
    ("message", "said"),
    [
        (lambda: PeriodicMessage(0x800, 8, 1.0), "can_id = 2048: must be 0 to 7FFh"),
        (lambda: PeriodicMessage(True, 8, 1.0), "can_id = True"),
        (lambda: PeriodicMessage(1, 9, 1.0), "length = 9: a frame has 0 to 8 data bytes"),
        (
            lambda: PeriodicMessage(1, 9, 1.0, fd=True),
            "length = 9: a CAN FD frame has 0 to 8, 12, 16, 20, 24, 32, 48, 64",
        ),
        (
            lambda: PeriodicMessage(1, 8, 1.0, bit_rate_switch=True),
            "bit_rate_switch = True: requires a CAN FD frame",
        ),
        (
            lambda: CanTraffic(500_000, data_bitrate_bit_s=250_000),
            "data_bitrate_bit_s = 250000: must be 500000 to 20000000 bit/s",
        ),
        (lambda: PeriodicMessage(1, 8, 0.0), "period_s = 0.0: must be 1e-6 to 1e6 s"),
        (lambda: PeriodicMessage(1, 8, float("nan")), "period_s = nan"),
        (lambda: PeriodicMessage(1, 8, 1.0, -1.0), "jitter_s = -1.0: must be 0 to 1e6 s"),
        (lambda: CanTraffic(0), "bitrate_bit_s = 0"),
        (
            lambda: CanTraffic(1000, (PeriodicMessage(1, 8, 1.0), PeriodicMessage(1, 0, 2.0))),
            "001h is declared twice",
        ),
    ],
)
def test_invalid_messages_raise(message, said: str):
    with pytest.raises(UsageError, match=said):
        message()


def test_message_declared_twice_counts_as_the_worse_one():
    own = NodeTraffic(sent=(PeriodicMessage(0x181, 6, 0.002),))
    declared = CanTraffic(1_000_000, (PeriodicMessage(0x181, 8, 0.01, 0.001),))
    assert declared.with_own([own], None).messages == (PeriodicMessage(0x181, 8, 0.002, 0.001),)
