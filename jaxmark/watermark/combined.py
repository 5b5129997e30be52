"""Several marks in one mesh: one to be read beside the original, and others without it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from jaxmark import distortion
from jaxmark.alignment.original import Original
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.blind.marker import BlindMarker, make_blind_marker
from jaxmark.watermark.blind.reading import BlindDetection
from jaxmark.watermark.blind.scheme import BlindScheme
from jaxmark.watermark.evidence import bounds as evidence
from jaxmark.watermark.marking import Detection, EmbedInfo, Marker, Survival
from jaxmark.watermark.perception.budget import Limits, Visibility, make_budget, visibility_of
from jaxmark.watermark.record import Record

_LEAST_SHARE, _MOST_SHARE = 0.3, 0.9  # of what is allowed, for a mark that is not the last


@dataclass(frozen=True, eq=False)
class CombinedMarker:
    """Marks one original with an informed scheme and blind ones, within one set of bounds; see `Marker`.

    What each mark alone survives within the bounds says how to share these: so that all survive as much noise. Marks
    are written one after another, the informed one first, and the last has what the others left.
    """

    informed: Marker
    blind: tuple[BlindScheme, ...]

    @property
    def original(self) -> Original:
        """The mesh that is marked."""
        return self.informed.original

    def embed(
        self,
        message: bytes,
        budget: float | None = None,
        *,
        limits: Limits | None = None,
        visibility: Visibility | None = None,
        noise: float | None = None,
        read_back: bool = True,
    ) -> tuple[Mesh, EmbedInfo]:
        """Embed a message in each way; the record is that of the informed mark. See `Marker.embed`."""
        mesh = self.original.mesh
        bounds = make_budget(budget, limits, visibility, named=visibility_of(mesh))
        reference = distortion.Reference(mesh)
        _, alone = self.informed.embed(message, bounds.rms, limits=bounds.limits, read_back=False)
        sizes, survived = [alone.rms], [alone.survives.whole]
        for marker in self._blinds:
            plan = marker.plan(message, bounds, reference)
            sizes.append(plan.rms)
            survived.append(plan.survives.whole)
        shares = _share(survived)
        marked, info = self.informed.embed(message, shares[0] * sizes[0], noise=noise, read_back=False)
        survives, total = [info.survives], dict(bounds.limits)
        if bounds.rms is not None:
            total["rms"] = bounds.rms
        for place, scheme in enumerate(self.blind, 1):
            own = None if place == len(self.blind) else shares[place] * sizes[place]
            marked, other = self._blind(marked, scheme).embed(
                message, own, limits=total, read_back=False, reference=reference
            )
            survives.append(other.survives)
        if read_back:
            self.check(marked, message)
        change = distortion.displacement_size(mesh, marked)
        least = Survival(min(one.whole for one in survives), max(one.half for one in survives))
        return marked, info._replace(rms=change.rms, max=change.max, survives=least)

    def suited(
        self,
        budget: float | None = None,
        *,
        limits: Limits | None = None,
        visibility: Visibility | None = None,
        noise: float | None = None,
    ) -> "CombinedMarker":
        """See `Marker.suited`."""
        return replace(self, informed=self.informed.suited(budget, limits=limits, visibility=visibility, noise=noise))

    def with_record(self, record: Record) -> "CombinedMarker":
        """See `Marker.with_record`."""
        return replace(self, informed=self.informed.with_record(record))

    def check(self, marked: Mesh, message: bytes) -> None:
        """Check that each mark reads.

        Raises:
            JaxmarkError: if one does not.
        """
        self.informed.check(marked, message)
        for one in self._blinds:
            one.check(marked, message)

    def tried(self, marked: Mesh, message: bytes, predicted: Survival) -> Survival | None:
        """Try what all marks survive, or with half of the points lost, one of them; see `Marker.tried`."""
        tried: list[Survival] = []
        for one in (self.informed, *self._blinds):
            if (found := one.tried(marked, message, predicted)) is None:
                return None
            tried.append(found)
        return Survival(min(one.whole for one in tried), max(one.half for one in tried))

    @cached_property
    def _blinds(self) -> list[BlindMarker]:
        return [self._blind(self.original.mesh, scheme) for scheme in self.blind]

    def _blind(self, mesh: Mesh, scheme: BlindScheme) -> BlindMarker:
        return make_blind_marker(mesh, self.informed.key, bits=self.informed.bits, scheme=scheme)


def _share(survived: Sequence[float]) -> list[float]:
    """Share the bounds so that all marks survive as much, which grows with a mark's size; squares add up to 1."""
    if not all(0 < one < math.inf for one in survived):
        return [math.sqrt(1 / len(survived))] * len(survived)
    norm = math.sqrt(sum(one**-2 for one in survived))
    return [min(max(1 / one / norm, _LEAST_SHARE), _MOST_SHARE) for one in survived]


def unite(informed: Detection, blind: Sequence[BlindDetection]) -> Detection:
    """What all marks of a mesh prove together, as a detection beside the original.

    Their signs are independent of each other, and so are the probabilities that they state. The probability that a
    product of n such is at most q is q Σ (-ln q)^i/i! over i < n (Fisher 1932). Of the undated ones the least counts,
    times their number.
    """
    alone = (informed, *blind)
    message = next((one.message for one in alone if one.message is not None), None)
    told = tuple(f"The mark of {one.scheme!r} alone proves 10^{one.log10_p:.1f}." for one in blind)
    return informed._replace(
        message=message,
        log10_p=_product([one.log10_p for one in alone], evidence.MIN_LOG10_P),
        log10_p_undated=evidence.any_of(informed.log10_p_undated, *(one.log10_p_undated for one in blind)),
        log10_p_unfloored=_product([one.log10_p_unfloored for one in alone], evidence.UNFLOORED),
        remarks=(*informed.remarks, *told),
    )


def _product(log10_p: Sequence[float], floor: float) -> float:
    """log10 of the probability that a product of independent probabilities is as small as it is."""
    log10_q = sum(log10_p)
    nats = -log10_q * math.log(10)
    total = sum(nats**power / math.factorial(power) for power in range(len(log10_p)))
    return evidence.share_of(log10_q, 1 / total, floor)
