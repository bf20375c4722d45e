"""Compressed data never becomes more than it says, nor more than a chunk may be."""

import tracemalloc

import lz4.frame
import pytest
import zstandard

from motorhil.traces.files import MEMORY_MAX
from motorhil.traces.mcap.records import CompressionError, decompress

ZEROS = bytes(1 << 25)
SAID = 1000
LIMIT = 8 << 20


def zstd(data, told=True):
    return zstandard.ZstdCompressor(write_content_size=told).compress(data)


BOMBS = {
    "zstd": zstd(ZEROS),
    "zstd that hides its size": zstd(ZEROS, told=False),
    "lz4": lz4.frame.compress(ZEROS),
}


@pytest.mark.parametrize("name", BOMBS)
def test_bomb_is_refused_without_its_memory(name):
    tracemalloc.start()
    try:
        with pytest.raises(CompressionError):
            decompress(name.split()[0], BOMBS[name], SAID)
        assert tracemalloc.get_traced_memory()[1] < LIMIT
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("compression", ["zstd", "lz4", ""])
def test_declared_size_beyond_the_limit_is_refused_at_once(compression):
    with pytest.raises(CompressionError, match="at most 268435456 bytes are read at once"):
        decompress(compression, b"", MEMORY_MAX + 1)


@pytest.mark.parametrize("size", [0, 1, SAID, 1 << 20])
@pytest.mark.parametrize("told", [True, False])
def test_honest_chunks_are_read(size, told):
    data = bytes(size)
    assert decompress("zstd", zstd(data, told), size) == data
    assert decompress("lz4", lz4.frame.compress(data, store_size=told), size) == data
