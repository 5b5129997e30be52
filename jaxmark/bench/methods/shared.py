"""Results that all methods, keys and messages share, because they depend on no key: each is computed once."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from jaxmark.alignment.attempts import align
from jaxmark.alignment.original import Original, make_original
from jaxmark.alignment.result import Alignment
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import Mesh


@dataclass(frozen=True, eq=False)
class _Identified:
    """A mesh as the key of a cache: it is identified by its arrays, and keeps them alive."""

    mesh: Mesh

    def __hash__(self) -> int:
        return hash((id(self.mesh.vertices), id(self.mesh.faces)))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Identified) and all(a is b for a, b in zip(self.mesh, other.mesh, strict=True))


def once(make: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
    """Call a function with a cache; meshes are equal if their arrays are identical."""
    return _cached(make, *(_Identified(value) if isinstance(value, Mesh) else value for value in arguments), **options)


@lru_cache(maxsize=24)
def _cached(make: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
    return make(*(value.mesh if isinstance(value, _Identified) else value for value in arguments), **options)


def prepared(original: Mesh) -> Original:
    """Prepare an original for readings, once."""
    return once(make_original, original)


def aligned(original: Mesh, suspect: Mesh) -> Alignment:
    """Align a suspect with an original, once; raises as `align` does, which takes longest where it refuses."""
    alignment, refusal = once(_align, original, suspect)
    if alignment is None:
        raise JaxmarkError(refusal)
    return alignment


def _align(original: Mesh, suspect: Mesh) -> tuple[Alignment | None, str]:
    try:
        return align(prepared(original), suspect), ""
    except JaxmarkError as error:
        return None, str(error)
