"""Read members of ZIP archives, and replace some while every other byte stays."""

import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from jaxmark.errors import JaxmarkError
from jaxmark.files import limits
from jaxmark.files.source import Edits, splice

_STORED, _DEFLATED = 0, 8
_ENCRYPTED, _DESCRIBED, _UTF8 = 1 << 0, 1 << 3, 1 << 11  # flags; described: checksum and sizes follow the data
_FULL = 0xFFFFFFFF  # stands for a number that is in the ZIP64 field instead
_ENTRY, _LOCAL = struct.Struct("<4s4x2H4x3I3H8xI"), struct.Struct("<4s2x2H4x3I2H")


@dataclass
class Member:
    """One file in an archive, as the central directory has it."""

    name: str
    entry: int  # offset of its entry in the central directory
    flags: int
    method: int
    checksum: int
    packed: int  # bytes in the archive
    size: int  # bytes of the content
    header: int  # offset of its header before the data
    start: int = 0  # offset of its data
    wide: dict[str, int] = field(default_factory=dict)  # offsets of numbers in the entry's ZIP64 field

    @property
    def shown(self) -> str:
        """The name, escaped and shortened for messages."""
        return ascii(self.name)[:80]


class Archive:
    """A ZIP archive; refused if it is broken, encrypted, in several volumes, too large, or two members have one name.

    Attributes:
        members: its members, in the order of the central directory.
    """

    def __init__(self, data: bytes) -> None:
        self.data = data
        self._end = data.rfind(b"PK\5\6", max(0, len(data) - 22 - 0xFFFF))
        if self._end < 0 or self._end + 22 > len(data):
            raise JaxmarkError("It is no ZIP archive, or its end is missing.")
        disk, first_disk, _, count, _, self._directory = struct.unpack_from("<4H2I", data, self._end + 4)
        self._wide_end = self._find_wide_end()
        if self._wide_end is not None:
            count, _, self._directory = struct.unpack_from("<3Q", data, self._wide_end + 32)
        elif disk or first_disk:
            raise JaxmarkError("The archive has several volumes; join them.")
        self.members: list[Member] = []
        at = self._directory
        for _ in range(count):
            member, at = self._entry(at)
            self.members.append(member)
        if at > self._end or self.data[at : at + 4] == b"PK\1\2":  # more entries than were counted
            raise _broken(at)
        self._check()
        self._by_name = {member.name.casefold(): member for member in self.members}
        if len(self._by_name) < len(self.members):
            twice = next(member for member in self.members if self._by_name[member.name.casefold()] is not member)
            raise JaxmarkError(f"The archive has two members of the name {twice.shown}; remove one.")
        self._locate()

    def _find_wide_end(self) -> int | None:
        """Return the offset of the ZIP64 end record, if there is one."""
        locator = self._end - 20
        if locator < 0 or self.data[locator : locator + 4] != b"PK\6\7":
            return None
        (at,) = struct.unpack_from("<Q", self.data, locator + 8)
        if at + 56 > locator or self.data[at : at + 4] != b"PK\6\6":
            raise _broken(locator)
        return at

    def _entry(self, at: int) -> tuple[Member, int]:
        """Read an entry of the central directory, and return the offset behind it, too."""
        if at + 46 > self._end or self.data[at : at + 4] != b"PK\1\2":
            raise _broken(at)
        _, flags, method, checksum, packed, size, name, extra, comment, header = _ENTRY.unpack_from(self.data, at)
        end = at + 46 + name + extra + comment
        if end > self._end:
            raise _broken(at)
        word = self.data[at + 46 : at + 46 + name].decode("utf-8" if flags & _UTF8 else "cp437", "replace")
        member = Member(word.replace("\\", "/"), at, flags, method, checksum, packed, size, header)
        # Only numbers that do not fit the entry should be in this field, but some programs repeat the sizes there.
        wide, stop = _field(self.data, at + 46 + name, extra)
        for key in ("size", "packed", "header") if stop else ():
            number = int.from_bytes(self.data[wide : wide + 8], "little") if wide + 8 <= stop else None
            if getattr(member, key) in (_FULL, number):
                if number is None:
                    raise _broken(wide)
                member.wide[key] = wide
                setattr(member, key, number)
                wide += 8
        return member, end

    def _check(self) -> None:
        """Refuse members that cannot be unpacked, or ought not to be."""
        for member in self.members:
            if member.flags & _ENCRYPTED:
                raise JaxmarkError(f"The member {member.shown} is encrypted; save it without a password.")
        limits.UNPACKED.check(sum(member.size for member in self.members), len(self.data))

    def _locate(self) -> None:
        """Find each member's data; members that overlap are refused."""
        last = 0
        for member in sorted(self.members, key=lambda member: member.header):
            at = member.header
            if at < last or at + 30 > self._directory or self.data[at : at + 4] != b"PK\3\4":
                raise JaxmarkError(f"The archive is broken: the member {member.shown} is not where it should be.")
            *_, name, extra = _LOCAL.unpack_from(self.data, at)
            member.start = at + 30 + name + extra
            last = member.start + member.packed
            if last > self._directory:
                raise JaxmarkError(f"The archive is broken: the member {member.shown} is not all there.")

    def find(self, name: str) -> Member | None:
        """Return a member by its name, in which case does not matter."""
        return self._by_name.get(name.casefold())

    def read(self, member: Member) -> bytes:
        """Unpack a member; refused if it is damaged, or packed in a way other than deflate."""
        packed = self.data[member.start : member.start + member.packed]
        if member.method == _DEFLATED:
            unpacker = zlib.decompressobj(-zlib.MAX_WBITS)
            try:
                content = unpacker.decompress(packed, member.size + 1)
            except zlib.error as error:
                raise JaxmarkError(f"The member {member.shown} cannot be unpacked: {error}.") from None
            whole = unpacker.eof
        elif member.method == _STORED:
            content, whole = packed, True
        else:
            raise JaxmarkError(
                f"The member {member.shown} is packed by method {member.method}; only deflate (8) is supported."
            )
        if not whole or len(content) != member.size or zlib.crc32(content) != member.checksum:
            raise JaxmarkError(f"The member {member.shown} is damaged: its size or checksum is not what it should be.")
        return content

    def replaced(self, contents: Mapping[str, bytes]) -> bytes:
        """Replace the contents of some members, packed as these were; all other bytes stay.

        Members whose headers are inconsistent are refused, and archives that would become too large.
        """
        out = bytearray(self.data)  # numbers keep their widths, so that places stay until the contents are exchanged
        replaced = [member for member in self.members if member.name in contents]
        packed = [_pack(contents[member.name], member.method) for member in replaced]
        for member, new in zip(replaced, packed, strict=True):
            self._state(out, member, contents[member.name], len(new))
        starts = np.array([member.start for member in replaced], np.int64)
        ends = starts + [member.packed for member in replaced]
        growth = np.array([len(new) for new in packed], np.int64) - (ends - starts)

        def shift(place: int, width: int, at: int) -> None:
            """Write at a place where the byte that was at an offset is now."""
            _renumber(out, place, width, at, at + int(growth[starts < at].sum()))

        for member in self.members:
            if "header" in member.wide:
                shift(member.wide["header"], 8, member.header)
            shift(member.entry + 42, 4, member.header)
        shift(self._end + 16, 4, self._directory)
        if self._wide_end is not None:
            shift(self._wide_end + 48, 8, self._directory)
            shift(self._end - 12, 8, self._wide_end)
        return splice(bytes(out), [Edits(starts, ends, packed)])

    def _state(self, out: bytearray, member: Member, content: bytes, packed: int) -> None:
        """Write the checksum and the sizes of a member's new content wherever the old ones stand."""
        write = partial(_renumber, out)
        checksum = partial(write, width=4, old=member.checksum, new=zlib.crc32(content), most=_FULL)
        checksum(member.entry + 16)
        *_, name, extra = _LOCAL.unpack_from(self.data, member.header)
        wide, stop = _field(self.data, member.header + 30 + name, extra)
        known = checksum(member.header + 14)
        sizes = (("packed", 20, 18, 8, packed), ("size", 24, 22, 0, len(content)))
        for key, in_entry, in_header, in_field, new in sizes:
            old = getattr(member, key)
            write(member.entry + in_entry, 4, old, new)
            if key in member.wide:
                write(member.wide[key], 8, old, new)
            found = write(member.header + in_header, 4, old, new)
            if wide + in_field + 8 <= stop:
                found |= write(wide + in_field, 8, old, new)
            known &= found
        if member.flags & _DESCRIBED:
            end = member.start + member.packed
            end += 4 * (self.data[end : end + 4] == b"PK\7\x08" and not self._described(end, member))
            width = self._described(end, member)
            if width:
                checksum(end)
                write(end + 4, width, member.packed, packed)
                write(end + 4 + width, width, member.size, len(content))
            known = bool(width)
        if not known:
            raise JaxmarkError(
                f"The header of the member {member.shown} is not what the archive's directory says; pack it again."
            )

    def _described(self, at: int, member: Member) -> int:
        """Return the width of the sizes that follow a checksum behind a member's data; 0 if there are none."""
        stated = member.checksum, member.packed, member.size
        for width, form in ((4, "<3I"), (8, "<I2Q")):
            if at + 4 + 2 * width <= self._directory and struct.unpack_from(form, self.data, at) == stated:
                return width
        return 0


def _pack(content: bytes, method: int) -> bytes:
    """Pack the content of a member as it was packed."""
    if method != _DEFLATED:
        return content
    packer = zlib.compressobj(wbits=-zlib.MAX_WBITS)
    return packer.compress(content) + packer.flush()


def _renumber(out: bytearray, at: int, width: int, old: int, new: int, most: int = _FULL - 1) -> bool:
    """Write a number where the old one stands; returns whether it stands there."""
    if int.from_bytes(out[at : at + width], "little") != old or at + width > len(out):
        return False
    if new > most:
        raise JaxmarkError("The file would have 4 GB or more; leave some meshes out of it.")
    out[at : at + width] = new.to_bytes(width, "little")
    return True


def _field(data: bytes, at: int, size: int) -> tuple[int, int]:
    """Find the span of the ZIP64 field among the extra fields of a header; zeros if it is not there."""
    end = at + size
    while at + 4 <= end:
        kind, length = struct.unpack_from("<2H", data, at)
        if kind == 1:
            return at + 4, min(at + 4 + length, end)
        at += 4 + length
    return 0, 0


def _broken(at: int) -> JaxmarkError:
    return JaxmarkError(f"byte {at}: the archive is broken: its directory is not where it should be.")
