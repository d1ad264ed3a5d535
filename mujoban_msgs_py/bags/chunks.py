"""Chunks of MCAP files, opened within bounds: a few bytes of a damaged or malicious file must not fill the memory."""

from __future__ import annotations

import dataclasses
from typing import Final

import lz4.frame
import zstandard
from mcap.exceptions import McapError
from mcap.records import Chunk
from mcap.stream_reader import McapRecord, breakup_chunk

CHUNK_LIMIT: Final = 64 << 20
"""Bytes of an uncompressed chunk above which its size is taken for damage; writers use 1 to 4 MiB."""


def open_chunk(chunk: Chunk) -> list[McapRecord]:
    """Return the records of a chunk whose checksum is right.

    Raises:
        McapError: If the chunk is longer than it says or than `CHUNK_LIMIT`, or damaged.
        ValueError, RuntimeError, zstandard.ZstdError: If what is compressed is damaged.
    """
    if chunk.uncompressed_size > CHUNK_LIMIT:
        raise McapError(f"a chunk says that it has {chunk.uncompressed_size} bytes, expected at most {CHUNK_LIMIT}")
    data = chunk.data
    if chunk.compression == "zstd":
        data = zstandard.ZstdDecompressor().stream_reader(chunk.data).read(chunk.uncompressed_size + 1)
    elif chunk.compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=chunk.uncompressed_size + 1)
    elif chunk.compression:
        raise McapError(f"a chunk is compressed by {chunk.compression!r}, expected zstd, lz4 or nothing")
    if len(data) != chunk.uncompressed_size:
        raise McapError(f"a chunk has {len(data)} bytes, not {chunk.uncompressed_size} as it says")
    return breakup_chunk(dataclasses.replace(chunk, compression="", data=data), validate_crc=True)
