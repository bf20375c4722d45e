"""Compression of chunks: zstd, and on reading also lz4 or none."""

from typing import Final, final

import zstandard

_PIECE: Final = 4096


@final
class CompressionError(Exception):
    """Compressed data is damaged, or its compression is unknown."""


def decompress(compression: str, data: bytes, size: int) -> bytes:
    """Return the `size` uncompressed bytes of `data`.

    Raises:
        CompressionError: the data is damaged, or the compression unknown.
    """
    try:
        if compression == "zstd":
            content = zstandard.ZstdDecompressor().decompress(data, max_output_size=size)
        elif compression == "lz4":
            import lz4.frame  # type: ignore[import-untyped]  # it has no types

            content = bytes(lz4.frame.decompress(data))
        elif compression:
            raise CompressionError(f"{compression!r} is not a known compression")
        else:
            content = data
    except (zstandard.ZstdError, RuntimeError, EOFError, OverflowError, MemoryError) as error:
        raise CompressionError(str(error) or "its size exceeds the memory") from error
    if len(content) != size:
        raise CompressionError(f"{len(content)} bytes; expected {size}")
    return content


def salvage(compression: str, data: bytes) -> bytes:
    """Return as much as possible of data whose end is missing; zstd yields whole blocks."""
    if not compression:
        return data
    if compression != "zstd":
        return b""
    stream = zstandard.ZstdDecompressor().decompressobj()
    out: list[bytes] = []
    try:
        for start in range(0, len(data), _PIECE):
            out.append(stream.decompress(data[start : start + _PIECE]))
    except zstandard.ZstdError:  # the end is not only missing but overwritten
        pass
    return b"".join(out)
