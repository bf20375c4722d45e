"""The decoder API: all that a third party's decoder of frames may import, and enough."""

from motorhil.traces.can_frame import EFF, ERR, RTR, fields
from motorhil.traces.decoding.narrative import BusMessage, Signal

__all__ = ["EFF", "ERR", "RTR", "BusMessage", "Signal", "fields"]
