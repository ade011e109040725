"""TFRecord files and the protocol buffers in them, as far as arrays need it; no TensorFlow.

A record is its length (8 bytes), a checksum of that, the content, and a checksum of that. The content is a
tf.train.Example: named lists of byte strings. Formats: https://www.tensorflow.org/tutorials/load_data/tfrecord,
https://protobuf.dev/programming-guides/encoding
"""

import os
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

from m3gn_bench.datasets.errors import DatasetError
from m3gn_bench.datasets.imports.source import reading

CHECKSUM_BYTES = 4
VARINT, FIXED64, DELIMITED, FIXED32 = 0, 1, 2, 5  # wire types


def read_records(path: Path) -> Iterator[bytes]:
    """The content of every record, in order.

    Raises:
        DatasetError: the file cannot be read or ends within a record, a checksum does not match, or google-crc32c
            is missing.
    """
    checksum = _checksum()
    with reading(path), path.open("rb") as file:
        number = 0
        while (length := _length(file, path, number, checksum)) is not None:
            content = file.read(length)
            _verify(content, file.read(CHECKSUM_BYTES), path, number, checksum)
            yield content
            number += 1


def count_records(path: Path) -> int:
    """Number of records; only their lengths are read. Raises DatasetError as `read_records` does."""
    checksum = _checksum()
    with reading(path), path.open("rb") as file:
        number = 0
        while (length := _length(file, path, number, checksum)) is not None:
            file.seek(length + CHECKSUM_BYTES, 1)
            number += 1
    return number


def _checksum() -> Callable[[bytes], int]:
    """CRC-32C as TFRecord stores it: rotated and shifted, so that checksums of checksums are no special case."""
    try:
        from google_crc32c import value
    except ImportError as error:
        raise DatasetError(
            f"reading TFRecord takes google-crc32c ({error}); pip install 'm3gn-bench[import]'"
        ) from error

    def masked(content: bytes) -> int:
        crc = value(content)
        return ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF

    return masked


def _length(file: BinaryIO, path: Path, number: int, checksum: Callable[[bytes], int]) -> int | None:
    """Length of the next record, all of which is there, or None at the end of the file."""
    head = file.read(8)
    if not head:
        return None
    _verify(head, file.read(CHECKSUM_BYTES), path, number, checksum)
    length = struct.unpack("<Q", head)[0]
    if length + CHECKSUM_BYTES > os.fstat(file.fileno()).st_size - file.tell():
        raise _truncated(path, number)
    return length


def _verify(content: bytes, stored: bytes, path: Path, number: int, checksum: Callable[[bytes], int]) -> None:
    if len(stored) < CHECKSUM_BYTES:
        raise _truncated(path, number)
    if struct.unpack("<I", stored)[0] != checksum(content):
        raise DatasetError(
            f"{path} is damaged or no TFRecord: the checksum of record {number} does not match; download it again"
        )


def _truncated(path: Path, number: int) -> DatasetError:
    return DatasetError(f"{path} is truncated: it ends within record {number}; download it again")


def parse_example(content: bytes) -> dict[str, bytes]:
    """The byte strings of a tf.train.Example by name; lists are joined, lists of numbers left out.

    Raises:
        ValueError: the content is none.
    """
    found: dict[str, bytes] = {}
    for features in _parts(memoryview(content), 1):
        for entry in _parts(features, 1):
            name = b"".join(_parts(entry, 1)).decode()
            found[name] = b"".join(
                value
                for feature in _parts(entry, 2)
                for words in _parts(feature, 1)
                for value in _parts(words, 1)
            )
    return found


def _parts(message: memoryview, wanted: int) -> Iterator[memoryview]:
    """The delimited values of a field of a message. Raises ValueError where the message is malformed."""
    position = 0
    while position < len(message):
        key, position = _varint(message, position)
        field, wire_type = key >> 3, key & 7
        if wire_type == VARINT:
            _, end = _varint(message, position)
        elif wire_type == DELIMITED:
            length, position = _varint(message, position)
            end = position + length
        elif wire_type in (FIXED64, FIXED32):
            end = position + (8 if wire_type == FIXED64 else 4)
        else:
            raise ValueError(f"wire type {wire_type} at byte {position}")
        if end > len(message):
            raise ValueError(f"a field of {end - position} bytes at byte {position} of {len(message)}")
        if field == wanted and wire_type == DELIMITED:
            yield message[position:end]
        position = end


def _varint(message: memoryview, position: int) -> tuple[int, int]:
    """A number of seven bits per byte, lowest first, and the position after it."""
    number = shift = 0
    while position < len(message):
        byte = message[position]
        position += 1
        number |= (byte & 0x7F) << shift
        if byte < 0x80:
            return number, position
        shift += 7
    raise ValueError("the message ends within a number")
