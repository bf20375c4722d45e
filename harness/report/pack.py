"""Packing of arrays into one text: base64 of deflated bytes, sorted by significance."""

import base64
import zlib
from typing import TYPE_CHECKING, Final, final

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy import float64, int64, integer
    from numpy.typing import NDArray

Packed = dict[str, object]
"""A packed array: type ("u8", "u16", "u32", "f32"), offset, count; for times, delta is true."""
TICKS_MAX: Final = (1 << 32) - 1


@final
class Packer:
    """Packer of arrays, with times in ticks; the whole recording has at most 2^32 of them.

    Attributes:
        tick_ns: duration of a tick [ns].
    """

    def __init__(self, span_ns: int) -> None:
        self.tick_ns = max(1, -(-span_ns // TICKS_MAX))
        self._parts: list[bytes] = []
        self._size = 0

    def ticks(self, time_ns: int) -> int:
        """Return a time from the recording's beginning in ticks."""
        return min(max(0, time_ns) // self.tick_ns, TICKS_MAX)

    def times(self, times_ns: "NDArray[int64]") -> Packed:
        """Pack ascending times as differences."""
        import numpy as np

        ticks = np.clip(times_ns // self.tick_ns, 0, TICKS_MAX)
        steps = np.diff(ticks, prepend=0)
        return {**self._add("u32", steps.astype("<u4")), "delta": True}

    def whole(self, values: "Sequence[int] | NDArray[int64]") -> Packed:
        """Pack whole numbers from 0, in as many bytes as the largest needs."""
        import numpy as np

        array = np.asarray(values, dtype=np.int64)
        top = int(array.max()) if len(array) else 0
        kind = "u8" if top < 1 << 8 else "u16" if top < 1 << 16 else "u32"
        return self._add(kind, np.minimum(array, TICKS_MAX).astype(f"<u{int(kind[1:]) // 8}"))

    def numbers(self, values: "NDArray[float64]") -> Packed:
        """Pack numbers as differences from the first finite one."""
        import numpy as np

        finite = values[np.isfinite(values)]
        base = float(finite[0]) if len(finite) else 0.0
        with np.errstate(over="ignore"):
            return {**self._add("f32", (values - base).astype("<f4")), "base": base}

    def text(self) -> str:
        """Return all arrays as one text."""
        return base64.b64encode(zlib.compress(b"".join(self._parts), 7)).decode("ascii")

    def _add(self, kind: str, array: "NDArray[integer[object]] | NDArray[float64]") -> Packed:  # type: ignore[type-var]
        import numpy as np

        size = array.dtype.itemsize
        told: Packed = {"type": kind, "offset": self._size, "count": len(array)}
        # The most significant bytes hardly vary; next to each other they compress well.
        data = array.view(np.uint8).reshape(-1, size).T.tobytes()
        self._parts.append(data)
        self._size += len(data)
        return told
