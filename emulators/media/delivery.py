"""What a bus says of a frame that is complete: to whom it went, and whether its sender knows.

A delivery is (frame, port that sent it, kind). A kind of 0 is all there is without faults.
Otherwise its low two bits say what to do, and the bits above are the ports (1 << number) that do
not hear this frame: ask `hears`.
"""

from typing import Final

Delivery = tuple[bytes, int, int]
DELIVERED: Final = 0  # all others hear it, and the sender is told that it was sent
LOST: Final = 1  # the sender is told that it was sent; nobody hears it, or not yet
TOLD: Final = 3  # an error message, for the port named as sender alone: its CAN controller tells it
HEARD: Final = 2  # all others hear it; the sender is told nothing: it was told, or will be
KIND_MASK: Final = 3
NOTED: Final = TOLD | 1 << 2  # an error message that the node does not ask for: for the record

_KIND_BITS: Final = 2


def hears(kind: int, port: int) -> bool:
    """Whether this port, not the sender's, hears a delivery of this kind."""
    return kind & KIND_MASK in (DELIVERED, HEARD) and not kind >> (_KIND_BITS + port) & 1


def confirms(kind: int) -> bool:
    """Whether a delivery of this kind tells the sender that its frame was sent."""
    return kind & KIND_MASK in (DELIVERED, LOST)


def kind_without(kind: int, deaf_mask: int) -> int:
    """This kind (DELIVERED or HEARD) for all but some ports, given as a mask of 1 << number."""
    return kind | deaf_mask << _KIND_BITS
