"""Ways in which files are damaged: each takes the bytes of a sound file, and may take those of another."""

import io
import re
import zipfile
from collections.abc import Callable

import numpy as np

Mutation = Callable[[bytes, bytes, np.random.Generator], bytes]

# Numbers that lengths, counts and times are not expected to be.
_ODD = (0, 1, -1, 127, 128, 255, 256, 32767, 65535, 65536, 2**24, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**62, 2**63 - 1, -(2**31), -(2**63))
_ODD_TEXT = (
    *("nan", "inf", "-inf", "-0", "1e400", "-1e308", "1e-320", "9" * 400, "0x10", "0o17", "1_000", "2024-13-45", "2001-99-99 10:61:00", "12:30:45"),
    *("null", "true", "~", "[]", "{}", "''", "\\u0000", "\ud7ff", "é", "&a", "*a", "!!python/object:os.system", "!!int x", "!!binary x", "<<", "?"),
    *("[" * 300, "{a: " * 80, "- " * 200, " " * 3000, "\t", '"', "%", "@", "|", ">", "1.7976931348623157e308", str(2**63), str(-(2**63)), "1" * 20),
)
_NUMBER = re.compile(rb"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")
_WORD = re.compile(rb"[A-Za-z_][\w.-]*")
# An end of a file, where headers and tables are, is chosen as often as all the rest.
_END = 600


def mutated(content: bytes, other: bytes, random: np.random.Generator) -> bytes:
    """A damaged copy of ``content``; ``other`` is another file, of which a part may be put in."""
    ways = _ZIPPED if content[:2] == b"PK" and random.random() < 0.5 else _TEXT if _is_text(content) else _BINARY
    for _ in range(int(random.choice([1, 1, 1, 2, 4]))):
        content = ways[int(random.integers(len(ways)))](content, other, random)
    return content


def _is_text(content: bytes) -> bool:
    return b"\0" not in content[:4096] and sum(byte > 126 for byte in content[:4096]) < 8


def _place(content: bytes, random: np.random.Generator) -> int:
    size = max(len(content), 1)
    return int((random.integers(min(_END, size)), size - 1 - random.integers(min(_END, size)), random.integers(size))[int(random.integers(3))])


def _bit(content: bytes, other: bytes, random: np.random.Generator) -> bytes:
    changed = bytearray(content or b"\0")
    for _ in range(int(random.integers(1, 5))):
        changed[_place(content, random)] ^= 1 << int(random.integers(8))
    return bytes(changed)


def _overwritten(content: bytes, other: bytes, random: np.random.Generator) -> bytes:
    at, length = _place(content, random), int(random.integers(1, 64))
    fill = random.integers(0, 256, length).astype(np.uint8).tobytes() if random.random() < 0.7 else bytes([int(random.integers(256))]) * length
    return content[:at] + fill + content[at + length :]


def _number_field(content: bytes, other: bytes, random: np.random.Generator) -> bytes:
    """A number of 1 to 8 bytes is replaced by an odd one, or changed by little."""
    size = int(random.choice([1, 2, 4, 8]))
    at = _place(content, random) // size * size if random.random() < 0.5 else _place(content, random)
    order = "little" if random.random() < 0.8 else "big"
    value = (
        int.from_bytes(content[at : at + size], order) + int(random.integers(-2, 3))
        if random.random() < 0.3
        else _ODD[int(random.integers(len(_ODD)))]
    )
    return content[:at] + (value % (1 << 8 * size)).to_bytes(size, order) + content[at + size :]


def _truncated(content: bytes, other: bytes, random: np.random.Generator) -> bytes:
    return content[: _place(content, random)]


def _without(content: bytes, other: bytes, random: np.random.Generator) -> bytes:
    at, length = _place(content, random), int(random.choice([1, 4, 16, 64, 500]))
    return content[:at] + content[at + length :]


def _doubled(content: bytes, other: bytes, random: np.random.Generator) -> bytes:
    at, length = _place(content, random), int(random.choice([1, 4, 16, 64, 500]))
    return content[: at + length] + content[at:]


def _spliced(content: bytes, other: bytes, random: np.random.Generator) -> bytes:
    if random.random() < 0.5:
        return content[: _place(content, random)] + other[_place(other, random) :]
    at, start, length = _place(content, random), _place(other, random), int(random.choice([4, 16, 64, 500]))
    return content[:at] + other[start : start + length] + content[at + length :]


def _text_number(content: bytes, other: bytes, random: np.random.Generator) -> bytes:
    matches = list(_NUMBER.finditer(content))
    if not matches:
        return _text_put(content, other, random)
    match = matches[int(random.integers(len(matches)))]
    odd = [str(number) for number in _ODD] + list(_ODD_TEXT)
    return content[: match.start()] + _encoded(odd[int(random.integers(len(odd)))]) + content[match.end() :]


def _text_word(content: bytes, other: bytes, random: np.random.Generator) -> bytes:
    """A word becomes another word of these files, or an odd one."""
    matches = list(_WORD.finditer(content))
    if not matches:
        return _text_put(content, other, random)
    match = matches[int(random.integers(len(matches)))]
    words = [word.group() for word in (*matches, *_WORD.finditer(other[:20_000]))]
    new = words[int(random.integers(len(words)))] if random.random() < 0.5 else _encoded(_ODD_TEXT[int(random.integers(len(_ODD_TEXT)))])
    return content[: match.start()] + new + content[match.end() :]


def _text_put(content: bytes, other: bytes, random: np.random.Generator) -> bytes:
    at = _place(content, random)
    return content[:at] + _encoded(_ODD_TEXT[int(random.integers(len(_ODD_TEXT)))]) + content[at:]


def _text_line(content: bytes, other: bytes, random: np.random.Generator) -> bytes:
    """A line is left out, doubled, moved, or indented otherwise."""
    lines = content.split(b"\n")
    first, second = (int(random.integers(len(lines))) for _ in range(2))
    way = int(random.integers(4))
    if way == 0:
        del lines[first]
    elif way == 1:
        lines.insert(second, lines[first])
    elif way == 2:
        lines[first], lines[second] = lines[second], lines[first]
    else:
        lines[first] = b" " * int(random.integers(1, 9)) + lines[first].lstrip()
    return b"\n".join(lines)


def _encoded(text: str) -> bytes:
    return text.encode("utf-8", errors="surrogatepass")


def _zip_member(content: bytes, other: bytes, random: np.random.Generator) -> bytes:
    """A member of an archive is damaged, and packed again with a right checksum; names may change."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = [(name, archive.read(name)) for name in archive.namelist()]
    except (zipfile.BadZipFile, ValueError, EOFError, OSError, NotImplementedError, RuntimeError, KeyError, zipfile.zlib.error):
        return _bit(content, other, random)
    if not members:
        return content
    chosen = int(random.integers(len(members)))
    name, inner = members[chosen]
    if random.random() < 0.15:
        members[chosen] = (members[int(random.integers(len(members)))][0] if random.random() < 0.5 else name[:-1], inner)
    else:
        ways = (*_BINARY, _text_number, _text_word)
        members[chosen] = (name, ways[int(random.integers(len(ways)))](inner, members[0][1], random))
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for member, data in dict(members).items():
            archive.writestr(zipfile.ZipInfo(member or "x"), data, zipfile.ZIP_DEFLATED)
    return packed.getvalue()


_BINARY: tuple[Mutation, ...] = (_bit, _overwritten, _number_field, _number_field, _truncated, _without, _doubled, _spliced)
_TEXT: tuple[Mutation, ...] = (_text_number, _text_number, _text_word, _text_put, _text_line, *_BINARY)
_ZIPPED: tuple[Mutation, ...] = (_zip_member,)
