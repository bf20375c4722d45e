"""Longest and shortest CAN frames, against the tables of kernel and can-utils."""

from dataclasses import replace

import pytest

from motorhil.motorapi.synchronization.bus_load import (
    FD_LENGTHS,
    PeriodicMessage,
)
from motorhil.motorapi.synchronization.can_frame_length import longest, shortest
from motorhil.motorapi.synchronization.can_response_time import (
    BusLoad,
    Message,
)

# Frame bits with intermission, minimum and maximum: can-utils canframelen.c and Linux
# include/linux/can/length.h, which follow Davis et al. 2007, by data bytes 0 to 8.
LENGTHS = {
    False: (
        (47, 55, 63, 71, 79, 87, 95, 103, 111),
        (55, 65, 75, 85, 95, 105, 115, 125, 135),
    ),
    True: (
        (67, 75, 83, 91, 99, 107, 115, 123, 131),
        (80, 90, 100, 110, 120, 130, 140, 150, 160),
    ),
}


# Bits with intermission, shortest and longest, 11-bit and 29-bit identifiers, by FD_LENGTHS.
# Source: Linux include/linux/can/length.h (can-physics, 6.3).
FD_BITS = {
    0: (62, 67, 81, 91),
    8: (126, 147, 145, 171),
    12: (158, 187, 177, 211),
    16: (190, 227, 209, 251),
    20: (227, 272, 246, 296),
    24: (259, 312, 278, 336),
    32: (323, 392, 342, 416),
    48: (451, 552, 470, 576),
    64: (579, 712, 598, 736),
}


@pytest.mark.parametrize("extended", [False, True])
def test_frame_lengths_equal_those_of_kernel_and_can_utils(extended: bool):
    least, worst = LENGTHS[extended]
    for length in range(9):
        assert longest(length, extended=extended).nominal == worst[length]
        assert shortest(length, extended=extended).nominal == least[length]


@pytest.mark.parametrize("length", FD_LENGTHS)
def test_fd_frame_lengths_equal_the_kernels(length: int):
    for extended in (False, True):
        bounds = [make(length, extended=extended, fd=True).nominal for make in (shortest, longest)]
        if length in FD_BITS:
            assert bounds == list(FD_BITS[length][2 * extended : 2 * extended + 2])
        for make, bound in zip((shortest, longest), bounds, strict=True):
            split = make(length, extended=extended, fd=True, switched=True)
            assert split.nominal + split.data == bound
            assert split.time_ns(1_000_000, 1_000_000) == bound * 1000
            assert split.nominal in ((49, 57) if extended else (30, 33))


@pytest.mark.parametrize(
    ("length", "bits"),
    [(0, (67, 91)), (8, (147, 171)), (16, (227, 251)), (20, (272, 296)), (64, (712, 736))],
)
def test_can_fd_frame_lengths_equal_those_of_the_kernel(length: int, bits: tuple[int, int]):
    """Check the longest frames. Source: Linux include/linux/can/length.h (can-physics, 6.3)."""
    slow, fast = (BusLoad("", 1_000_000, (), rate) for rate in (1_000_000, 5_000_000))
    for extended, worst, nominal in zip((False, True), bits, (33, 57), strict=True):
        plain = PeriodicMessage(1, length, 1.0, extended=extended, fd=True)
        switched = replace(plain, bit_rate_switch=True)
        for one in (plain, switched):
            assert slow.takes_ns(Message.of(one)) == worst * 1000
        assert fast.takes_ns(Message.of(plain)) == worst * 1000
        assert fast.takes_ns(Message.of(switched)) == nominal * 1000 + (worst - nominal) * 200
