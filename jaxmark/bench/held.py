"""Meshes as keys of caches."""

from dataclasses import dataclass

from jaxmark.geometry.mesh import Mesh


@dataclass(frozen=True, eq=False)
class Held:
    """A mesh that is known by its arrays themselves, which a cache that has it as a key keeps alive."""

    mesh: Mesh

    def __hash__(self) -> int:
        return hash((id(self.mesh.vertices), id(self.mesh.faces)))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Held) and all(a is b for a, b in zip(self.mesh, other.mesh, strict=True))
