"""Deliveries of a bus: receivers of a frame and confirmation.

A delivery is (frame, port that sent it, kind). Without faults the kind is always 0. Otherwise its
low two bits select the action. The bits above are the ports (1 << number) that do not hear this
frame; `hears` reads them.
"""

from typing import Final

Delivery = tuple[bytes, int, int]
DELIVERED: Final = 0  # all others hear it, and the sender is informed that it was sent
LOST: Final = 1  # the sender is informed that it was sent; no node hears it, or not yet
TOLD: Final = 3  # an error message from its CAN controller, for the port named as sender only
HEARD: Final = 2  # all others hear it; the sender is informed before or later
KIND_MASK: Final = 3
NOTED: Final = TOLD | 1 << 2  # an error message that the node does not request: recorded only

_KIND_BITS: Final = 2


def hears(kind: int, port: int) -> bool:
    """Return whether this port, not the sender's, hears a delivery of this kind."""
    return kind & KIND_MASK in (DELIVERED, HEARD) and not kind >> (_KIND_BITS + port) & 1


def confirms(kind: int) -> bool:
    """Return whether a delivery of this kind informs the sender that its frame was sent."""
    return kind & KIND_MASK in (DELIVERED, LOST)


def kind_without(kind: int, deaf_mask: int) -> int:
    """Return this kind (DELIVERED or HEARD) without some ports, a mask of 1 << number."""
    return kind | deaf_mask << _KIND_BITS
