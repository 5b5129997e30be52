"""The budget of a file: how much it may unpack to, and how much it may hold, before a mark is looked for.

A small file must not cost minutes or gigabytes. Every file may have the least amount of each limit, and a large file
may have more, in proportion to its bytes. `docs/how-to/files.md` has a table of the limits.
"""

from typing import NamedTuple

from jaxmark.errors import JaxmarkError


class Limit(NamedTuple):
    """The largest amount of something in a file."""

    what: str
    least: int  # largest amount in a small file
    each: float  # largest amount for each byte of a large file

    def most(self, size: int) -> int:
        """Return the largest amount in a file of a size in bytes."""
        return max(self.least, int(self.each * size))

    def check(self, amount: int, size: int) -> None:
        """Refuse an amount that is too large for a file of a size in bytes."""
        most = self.most(size)
        if amount > most:
            raise JaxmarkError(
                f"The file has more than {most} {self.what}, the most for a file of {size} bytes; save it in another"
                " format, such as PLY with triangles only, or split it."
            )


class RunningCount:
    """A running count of something in a file, which is refused when it exceeds its limit."""

    def __init__(self, limit: Limit, size: int) -> None:
        """Begin to count in a file of a size in bytes."""
        self._limit, self._size, self._amount = limit, size, 0

    def add(self, amount: int = 1) -> None:
        """Count some more."""
        self._amount += amount
        self._limit.check(self._amount, self._size)


#: Bytes of a 3MF file's members, a LAZ file's points, compressed numbers of glTF or arrays of USD, after decompression.
UNPACKED = Limit("bytes of unpacked content", 2**26, 50)
#: Seconds of processor time that LAZ points, glTF meshes or USD layers may take to be unpacked.
UNPACKING_SECONDS = Limit("seconds of unpacking", 20, 2**-20)
#: XML elements and comments of a 3MF file, without vertices and triangles that are written as nearly all programs do.
ELEMENTS = Limit("XML elements that are read one by one", 2**19, 0.5)
#: Elements of glTF accessors, which may share bytes, corners of strips and fans, and faces in Draco.
ACCESSED = Limit("elements of accessors", 2**20, 16)
#: Bytes that are read of all files that hold the buffers of a glTF file.
BUFFERS = Limit("bytes of buffers in other files", 2**30, 0)
#: Rows of a PLY element whose lists differ in length from row to row.
ROWS = Limit("rows that are read one by one", 2**19, 0.2)
#: Meshes, or objects, that are read one by one.
MESHES = Limit("meshes", 2**14, 0)
#: Layers of a USDZ file.
LAYERS = Limit("layers", 2**8, 0)
#: Points that a mesh needs to be read for a blind mark. Such marks have no anchors on coarser meshes.
BLIND_POINTS = 100
#: Meshes of a file that are read for a blind mark unless they are named, the largest ones. Each may take half a minute.
BLIND_MESHES = 8
