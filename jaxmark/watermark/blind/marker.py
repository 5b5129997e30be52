"""Mark one original so that it is read without it."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from jaxmark import distortion
from jaxmark.alignment.original import Original, make_original
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh, check_faces
from jaxmark.watermark.blind.reading import TAG_BITS, BlindDetection, code_length, codeword, context, detect
from jaxmark.watermark.blind.scheme import BlindScheme
from jaxmark.watermark.blind.writing import Writer, radius_of
from jaxmark.watermark.coding.keys import Key, commitment
from jaxmark.watermark.marking import DEFAULT_BITS, EmbedInfo, Survival
from jaxmark.watermark.perception.budget import Budget, Limits, Visibility, make_budget, visibility_of
from jaxmark.watermark.record import Record, commit

_TRIED = (1.0, 0.7, 0.5, 0.3)  # shares of a predicted noise that are tried


class Planned(NamedTuple):
    """A mark that is not written yet."""

    rms: float  # of its displacement, in diagonals
    survives: Survival


@dataclass(frozen=True, eq=False)
class BlindMarker:
    """Marks one original with one key and payload size so that it is read without it; see `Marker`."""

    original: Original
    key: Key
    bits: int
    scheme: BlindScheme
    writer: Writer

    def embed(
        self,
        message: bytes,
        budget: float | None = None,
        *,
        limits: Limits | None = None,
        visibility: Visibility | None = None,
        noise: float | None = None,
        read_back: bool = True,
        reference: distortion.Reference | None = None,
    ) -> tuple[Mesh, EmbedInfo]:
        """Embed a message of exactly the payload's size in the original; see `embed`.

        Pass `read_back=False` if you verify the written file yourself, and `reference` if limits are against another
        mesh than the original.
        """
        bounds = make_budget(budget, limits, visibility, named=visibility_of(self.original.mesh))
        choices = self.writer.choices
        word = codeword(message, choices)
        written = self.writer.write(word, bounds, self.bits, reference)
        survives = self.writer.survives(written.plan, self.bits)
        if noise is not None and survives.whole < noise:
            raise JaxmarkError(
                f"This mark would survive noise of {survives.whole:.2g}, not {noise:g}; use a larger budget, a shorter"
                " message or another scheme."
            )
        record = Record(
            scheme=self.scheme.name,
            bits=self.bits,
            beta=float(written.plan.alpha),
            original="",
            key=commitment(self.key),
            parameters={"width": written.plan.width, "step": written.plan.step},
            content="message" if self.bits else "presence",
            told=commit(message, choices) if message else "",
        ).sealed(self.key)
        info = EmbedInfo(written.moved.rms, written.moved.max, record.beta, record, survives)
        if read_back:
            self.with_record(record).check(written.mesh, message)
        return written.mesh, info

    def plan(self, message: bytes, bounds: Budget, reference: distortion.Reference) -> Planned:
        """How large a mark within bounds would be, and what it would survive, without writing it.

        Raises:
            JaxmarkError: see `Writer.plan`.
        """
        plan = self.writer.plan(codeword(message, self.writer.choices), bounds, reference, self.bits)
        return Planned(plan.size, self.writer.survives(plan, self.bits))

    def suited(
        self,
        budget: float | None = None,
        *,
        limits: Limits | None = None,
        visibility: Visibility | None = None,
        noise: float | None = None,
    ) -> "BlindMarker":
        """This: `embed` chooses what suits a budget."""
        return self

    def with_record(self, record: Record) -> "BlindMarker":
        """The marker that reads a mark it has just made, with the width and step that were chosen."""
        return replace(self, scheme=parameters_in(record, self.scheme))

    @property
    def tag_bits(self) -> int:
        """Size of the keyed tag that follows the message."""
        return TAG_BITS

    def align(self, suspect: Mesh) -> Mesh:
        """Leave a suspect as it is: nothing is known that it could be aligned with."""
        return suspect

    def detect(self, suspect: Mesh, message: bytes | None = None) -> BlindDetection:
        """Read a suspect, with a claimed message or without, see `jaxmark.watermark.blind.reading.detect`."""
        return detect(suspect, self.key, self.bits, self.scheme, message)

    def check(self, marked: Mesh, message: bytes) -> None:
        """Check that a message can be read from a marked mesh that was not attacked.

        Raises:
            JaxmarkError: if it cannot be read.
        """
        if not self.reads(marked, message):
            raise JaxmarkError(
                f"This mesh ({int(self.original.used.sum())} points) cannot carry"
                f" {f'{self.bits} bits' if self.bits else 'a presence mark'} with the scheme {self.scheme.name!r}: it"
                " does not read back, even unattacked. Use a larger budget, a shorter message or the scheme 'keyed'."
            )

    def reads(self, marked: Mesh, message: bytes) -> bool:
        """Whether a message is read, or without one a presence proven."""
        found = self.detect(marked)
        return found.message == message if message else found.detected()

    def tried(self, marked: Mesh, message: bytes, predicted: Survival) -> Survival | None:
        """Try what a mark survives: add noise, lose half of the points, and read; see `Marker.tried`."""
        if not self.reads(marked, message):
            return None
        points, rng = np.asarray(marked.vertices, np.float64), np.random.default_rng(0)
        size = radius_of(self.original) * self.original.diagonal
        unit = size * rng.uniform(-1, 1, self.original.positions.shape)[self.original.weld.point]
        faces = np.asarray(marked.faces)
        near = (points[faces, 0] <= np.median(points[faces, 0])).all(axis=1)
        tried = []
        for most, seen in zip(predicted, (faces, faces[near]), strict=True):
            strengths = [share * most for share in _TRIED if most > 0]
            suspects = (Mesh(points + noise * unit, seen) for noise in strengths)
            reads = (noise for noise, one in zip(strengths, suspects, strict=True) if self.reads(one, message))
            tried.append(next(reads, 0.0))
        return Survival(*tried)


def parameters_in(record: Record, scheme: BlindScheme) -> BlindScheme:
    """A scheme with the width and the step that a record names.

    Raises:
        JaxmarkError: if it names none that are on the scheme's ladders.
    """
    width, step = (record.parameters.get(name) for name in ("width", "step"))
    if record.scheme != scheme.name or width not in scheme.widths or step not in scheme.steps:
        raise JaxmarkError(f"The record is not one of the scheme {scheme.name!r} that this jaxmark reads.")
    return scheme.fixed(width, step)


def make_blind_marker(original: Mesh, key: bytes, *, bits: int = DEFAULT_BITS, scheme: BlindScheme) -> BlindMarker:
    """Prepare an original for marks that are read without it.

    Raises:
        JaxmarkError: if the mesh or the key is unusable, or the payload is not a multiple of 8 bits.
    """
    code_length(bits)
    check_faces("A mark that is read without the original", original)
    ready = make_original(original)
    return BlindMarker(ready, Key(key), bits, scheme, Writer(ready, scheme, context(Key(key), bits, scheme.name)))
