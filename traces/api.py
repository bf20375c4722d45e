"""The decoder API: all that a third party's decoder of frames may import, and enough.

A frame of a CAN bus is a can_frame (`fields` takes it apart). On a serial line it is what one
sender sent without a pause. A decoder gets all frames of its bus, in order. `Layout` and `layouts`
describe the values in a frame by text.
"""

from motorhil.traces.can_frame import EFF, ERR, RTR, fields
from motorhil.traces.decoding.narrative import BusMessage
from motorhil.traces.layout import Layout, Signal, layouts

__all__ = ["EFF", "ERR", "RTR", "BusMessage", "Layout", "Signal", "fields", "layouts"]
