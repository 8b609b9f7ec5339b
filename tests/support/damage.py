"""Damage to files, as disks, networks and people with bad intentions do it; a seed names each case."""

import re
import struct
import zlib
from collections.abc import Callable

import numpy as np

Damage = Callable[[bytes, np.random.Generator], bytes]

#: What lengths, counts and sizes are overwritten by.
_EXTREME = (0, 1, 2, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x10000, 2**24, 2**31 - 1, 2**31, 2**32 - 1, 2**62, 2**64 - 1)
#: What a value of JSON or TOML is replaced by.
_VALUES = (
    "0 -0.0 -1 1.5 1e-320 1e300 -1e300 1e308 1e400 -1e400 nan inf NaN Infinity -Infinity 2147483648 1e9 1e18 "
    '9223372036854775808 true false null "" "x" "\\u0000" "\\u001b[31m" [] {} [[]] [1,2,3] [1e300,1e300,1e300] '
    '[0,0,0] [[1,0,0],[0,1,0],[0,0,1]] {"a":1} 1979-05-27 0x10 1_0 vertical'
).split()
_TOKEN = re.compile(rb"-?\d[\d.eE+-]*|true|false|null|\"[^\"\n]*\"")


def _at(data: bytes, rng: np.random.Generator) -> int:
    """Return a place in the data: every second time in its head, where the sizes are."""
    return int(rng.integers(0, max(1, min(len(data), 128) if rng.random() < 0.5 else len(data))))


def flip_a_bit(data: bytes, rng: np.random.Generator) -> bytes:
    """Turn one bit around."""
    place = _at(data, rng)
    return data[:place] + bytes([data[place] ^ 1 << int(rng.integers(8))]) + data[place + 1 :]


def cut_off(data: bytes, rng: np.random.Generator) -> bytes:
    """Lose the end."""
    return data[: int(rng.integers(0, len(data)))]


def zero(data: bytes, rng: np.random.Generator) -> bytes:
    """Overwrite a run by zeros, as a file system does after a crash."""
    place, length = _at(data, rng), int(2 ** rng.uniform(0, 10))
    return data[:place] + bytes(len(data[place : place + length])) + data[place + length :]


def scramble(data: bytes, rng: np.random.Generator) -> bytes:
    """Overwrite a run by noise."""
    place, length = _at(data, rng), int(2 ** rng.uniform(0, 8))
    return data[:place] + rng.bytes(len(data[place : place + length])) + data[place + length :]


def move(data: bytes, rng: np.random.Generator) -> bytes:
    """Cut a piece out, and put it in somewhere else, once, not at all or several times."""
    begin, length, times = _at(data, rng), int(2 ** rng.uniform(0, 10)), int(rng.integers(0, 4))
    piece, rest = data[begin : begin + length], data[:begin] + data[begin + length :]
    place = _at(rest, rng)
    return rest[:place] + times * piece + rest[place:]


def lie(data: bytes, rng: np.random.Generator) -> bytes:
    """Write an extreme number over one, two, four or eight bytes."""
    place, size = _at(data, rng), int(rng.choice([1, 2, 4, 8]))
    number = _EXTREME[rng.integers(len(_EXTREME))] & (1 << 8 * size) - 1
    written = number.to_bytes(size, "big" if rng.random() < 0.5 else "little")
    return data[:place] + written + data[place + size :]


def change_a_value(data: bytes, rng: np.random.Generator) -> bytes:
    """Write another value over a number, a word or a text of JSON or TOML."""
    tokens = list(_TOKEN.finditer(data))
    if not tokens:
        return data
    token = tokens[rng.integers(len(tokens))]
    kind = rng.random()
    if kind < 0.8:
        value = _VALUES[rng.integers(len(_VALUES))].encode()
    elif kind < 0.9:
        value = b"9" * int(10 ** rng.uniform(1, 5))
    else:
        depth = int(10 ** rng.uniform(0, 5))
        value = b"[" * depth + b"]" * depth
    return data[: token.start()] + value + data[token.end() :]


def scale_a_number(data: bytes, rng: np.random.Generator) -> bytes:
    """Make a number of JSON or TOML larger or smaller, or negative."""
    tokens = [token for token in _TOKEN.finditer(data) if re.fullmatch(rb"-?\d+(\.\d*)?([eE][+-]?\d+)?", token[0])]
    if not tokens:
        return data
    token = tokens[rng.integers(len(tokens))]
    value = float(token[0]) * 10.0 ** rng.uniform(-12, 12) * rng.choice([1, -1])
    whole = b"." not in token[0] and rng.random() < 0.7
    return data[: token.start()] + (f"{value:.0f}" if whole else repr(float(value))).encode() + data[token.end() :]


def change_lines(data: bytes, rng: np.random.Generator) -> bytes:
    """Lose a line, repeat it, or put another one in."""
    lines = data.split(b"\n")
    place, kind = int(rng.integers(len(lines))), rng.integers(4)
    if kind == 0:
        del lines[place]
    elif kind == 1:
        lines.insert(place, lines[rng.integers(len(lines))])
    elif kind == 2:
        lines.insert(place, b"a." * int(10 ** rng.uniform(0, 5)) + b"a = 1")
    else:
        lines.insert(place, b"# " + rng.bytes(20) + b"\x1b[2J" + "‮".encode())
    return b"\n".join(lines)


#: What happens to any file, and what to texts, most of the time.
ANY: tuple[Damage, ...] = (flip_a_bit, cut_off, zero, scramble, move, lie)
TEXT: tuple[Damage, ...] = (change_a_value, change_a_value, scale_a_number, scale_a_number, change_lines)


def damaged(data: bytes, rng: np.random.Generator, *, text: bool = False) -> bytes:
    """Return data with one to four damages; a text with one or two."""
    for _ in range(rng.integers(1, 3 if text else 5)):
        kinds = TEXT if text and rng.random() < 0.85 else ANY
        if data:
            data = kinds[rng.integers(len(kinds))](data, rng)
    return data


def with_png_checksums(data: bytes) -> bytes:
    """Return a damaged PNG whose checksums are right, as somebody with intent would write it."""
    repaired, begin = bytearray(data), 8
    while begin + 12 <= len(repaired):
        size = struct.unpack_from(">I", repaired, begin)[0]
        if begin + 12 + size > len(repaired):
            break
        checksum = zlib.crc32(repaired[begin + 4 : begin + 8 + size])
        struct.pack_into(">I", repaired, begin + 8 + size, checksum)
        begin += 12 + size
    return bytes(repaired)
