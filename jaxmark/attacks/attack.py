"""Attacks by their names, and functions that apply one or several attacks to a mesh."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from numbers import Real
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key, PRNGKeyArray

from jaxmark.attacks._points import floaters, merging, outliers, resampling, subsampling
from jaxmark.attacks.deformation import as_rigid_as_possible
from jaxmark.attacks.denoising import nonlocal_means, shrinkage
from jaxmark.attacks.flips import edge_flips, reordering
from jaxmark.attacks.noise import diagonal_noise, gaussian_noise, uniform_noise
from jaxmark.attacks.parts import adding_geometry, cropping, holes, missing_pieces, mosaic, region_cropping
from jaxmark.attacks.refitting import plane_fitting, primitive_fitting
from jaxmark.attacks.remeshing import iso_surface, isotropic, poisson, simplification
from jaxmark.attacks.smoothing import bilateral_smoothing, cotangent_smoothing, laplacian_smoothing, taubin_smoothing
from jaxmark.attacks.storage import digits, float_bits, quantisation, soup
from jaxmark.attacks.subdivision import loop, midpoint, sqrt3
from jaxmark.attacks.symmetry import instance_averaging, mirror_averaging
from jaxmark.attacks.transformations import affine, bending, similarity, twisting, warp
from jaxmark.errors import JaxmarkError
from jaxmark.geometry.mesh import (
    Mesh,
    Weld,
    check_faces,
    compact,
    diagonal,
    host_mesh,
    same_connectivity,
    used_vertices,
    weld,
    weld_mesh,
)
from jaxmark.seeds import Seed, generator, random_key

# The ends of the units of strengths that are lengths, relative to the vertices' mean distance to their centre or to the
# diagonal.
_MOST_STRENGTH = 1e30  # far beyond any use, and far within the range of float32
_OVER_RADIUS, _OVER_DIAGONAL = "over the mean distance to the centre", "over the diagonal"


class Attack(NamedTuple):
    """An attack: one of the library's, or your own.

    Attributes:
        apply: function (mesh, strength, seed) → mesh. On the host, the seed is a `numpy.random.Generator`, and the mesh
            is as it is; else a JAX random key, and the mesh is centred and at unit diagonal.
        unit: description of the strength and its unit; "over the diagonal" or "over the mean distance to the centre" in
            it say that the strength is a length.
        strengths: usual strengths, weak ones first.
        host: whether the attack runs on the host, in NumPy or another program; otherwise, it is traced.
        faces: whether the attack needs faces, so that point clouds are refused.
    """

    apply: Callable[[Mesh, Any, Any], Mesh]
    unit: str
    strengths: tuple[float, ...]
    host: bool = False
    faces: bool = False

    def length(self, strength: float, radius: float) -> float | None:
        """Convert a strength to a fraction of the mesh's diagonal; None if its unit says that it is no length.

        Args:
            strength: a strength in the attack's unit.
            radius: the mean distance of the mesh's vertices to their centre, over its diagonal, see `mean_distance`.
        """
        if _OVER_RADIUS in self.unit:
            return strength * radius
        return strength if _OVER_DIAGONAL in self.unit else None


def unit_of_length(unit: str) -> str:
    """Return the unit of `Attack.length` for an attack with this unit."""
    return unit.replace(_OVER_RADIUS, _OVER_DIAGONAL)


def mean_distance(mesh: Mesh) -> float:
    """Compute the mean distance of a mesh's welded vertices that faces use to their centre, over its diagonal."""
    points = np.asarray(compact(weld_mesh(mesh, weld(mesh.vertices))).vertices, np.float64)
    return float(np.linalg.norm(points - points.mean(axis=0), axis=1).mean()) / diagonal(mesh)


# Attacks that need faces, that run on the host, and both.
surface_attack, _host = partial(Attack, faces=True), partial(Attack, host=True)
_host_surface = partial(Attack, host=True, faces=True)

#: Attacks by accident or by a tool; `jaxmark.adversaries.by_name.ATTACKS` has all attacks.
ATTACKS: Mapping[str, Attack] = {
    "noise": Attack(uniform_noise, f"half width {_OVER_RADIUS}", (0.0005, 0.001, 0.003, 0.005, 0.01)),
    "diagonal-noise": Attack(diagonal_noise, "half width over the diagonal", (0.0002, 0.0005, 0.001, 0.002, 0.005)),
    "gaussian-noise": Attack(
        gaussian_noise,
        f"standard deviation of a coordinate {_OVER_RADIUS}",
        (0.0003, 0.0006, 0.002, 0.003, 0.006),
    ),
    "smoothing": surface_attack(laplacian_smoothing, "steps of 0.1", (5, 10, 30, 50, 100)),
    "taubin": surface_attack(taubin_smoothing, "pairs of steps 0.5, -0.53", (5, 10, 20, 50, 100)),
    "cotangent-smoothing": surface_attack(cotangent_smoothing, "time of diffusion by cotangents", (0.5, 1, 3, 5, 10)),
    "bilateral": surface_attack(bilateral_smoothing, "iterations", (1, 2, 5, 10, 20)),
    "shrinkage": surface_attack(
        shrinkage, "length over the diagonal that wavelets are shrunk by", (0.0001, 0.0003, 0.001, 0.003, 0.01)
    ),
    "non-local-means": _host_surface(
        nonlocal_means, "time of diffusion, whose detail is averaged", (1, 3, 10, 30, 100)
    ),
    "quantisation": Attack(quantisation, "bits per coordinate", (11, 10, 9, 8, 7)),
    "similarity": Attack(
        similarity, "shift over the diagonal, and scale up or down less 1; any rotation", (0.1, 0.3, 1, 3, 9)
    ),
    "affine": Attack(affine, "Frobenius norm of the map less the identity", (0.02, 0.05, 0.1, 0.2, 0.4)),
    "warp": Attack(warp, "RMS over the diagonal", (0.002, 0.005, 0.01, 0.02, 0.04)),
    "bending": Attack(bending, "degrees", (2, 5, 10, 20, 45)),
    "twisting": Attack(twisting, "degrees over the whole length", (2, 5, 10, 20, 45)),
    "edge-flips": _host_surface(edge_flips, "share of the edges", (0.01, 0.03, 0.1, 0.2, 0.3)),
    "midpoint": surface_attack(midpoint, "steps", (1, 2, 3)),
    "sqrt3": surface_attack(sqrt3, "steps", (1, 2, 3)),
    "loop": surface_attack(loop, "steps", (1, 2, 3)),
    "simplification": _host_surface(
        simplification, "share of the edges that goes", (0.1, 0.3, 0.5, 0.7, 0.9, 0.95, 0.975)
    ),
    "isotropic": _host_surface(isotropic, "edge length over the mean one", (0.5, 0.7, 1, 1.4, 2)),
    "iso-surface": _host_surface(iso_surface, "cells along the longest side", (200, 150, 100, 70, 50)),
    "poisson": _host_surface(poisson, "depth of the octree", (8, 7, 6, 5)),
    "cropping": _host(cropping, "share of the vertices, beyond a plane", (0.1, 0.3, 0.5, 0.7, 0.8)),
    "region-cropping": _host(region_cropping, "share of the vertices, in one region", (0.1, 0.3, 0.5, 0.7, 0.8)),
    "holes": _host(holes, "share of the vertices, in ten regions", (0.02, 0.05, 0.1, 0.2, 0.3)),
    "reordering": _host(reordering, "share of the vertices and of the faces", (0.01, 0.1, 0.3, 1)),
    "added-geometry": _host_surface(
        adding_geometry, "size of a ring and of a box over the diagonal", (0.25, 0.5, 1, 2)
    ),
    "mosaic": _host_surface(mosaic, "shift of eight pieces over the diagonal", (0.01, 0.03, 0.1, 0.3, 1)),
    "missing-pieces": _host_surface(missing_pieces, "share of eight pieces", (0.125, 0.25, 0.5, 0.75)),
    "digits": _host(digits, "significant decimal digits of a coordinate", (7, 6, 5, 4, 3)),
    "float-bits": _host(float_bits, "bits of a coordinate, 64, 32 or 16", (32, 16)),
    "soup": _host_surface(soup, "times through a binary STL file", (1, 2)),
    "arap": _host_surface(
        as_rigid_as_possible, "drag of one end sideways over the diagonal", (0.02, 0.05, 0.1, 0.2, 0.4)
    ),
    "plane-fitting": _host_surface(plane_fitting, "degrees between normals of a flat region", (1, 2, 5, 10)),
    "primitive-fitting": _host_surface(primitive_fitting, "degrees between normals of a flat region", (1, 2, 5, 10)),
    "mirror-averaging": _host_surface(
        mirror_averaging, "share of the way to the mean with the mirror image", (0.25, 0.5, 0.75, 1)
    ),
    "instance-averaging": _host_surface(
        instance_averaging, "share of the way to the mean of all instances", (0.25, 0.5, 0.75, 1)
    ),
    "subsampling": _host(subsampling, "share of a cloud's points, at random", (0.1, 0.3, 0.5, 0.7, 0.9)),
    "outliers": _host(outliers, "share of a cloud's points, thrown off", (0.01, 0.03, 0.1, 0.3)),
    "floaters": _host(floaters, "points added anywhere over a cloud's own", (0.01, 0.03, 0.1, 0.3)),
    "merging": _host(merging, "half width of a second scan's noise over the diagonal", (0, 0.0005, 0.001, 0.002)),
    "resampling": _host(resampling, "points sampled anew over a cloud's own", (2, 1, 0.5, 0.25)),
}
Kind = str | Attack  # a name in `ATTACKS`, or an attack of your own
Step = tuple[Kind, float]  # an attack and its strength


class Registry(NamedTuple):
    """Attacks by their names, and functions of the host that apply them to meshes."""

    attacks: Mapping[str, Attack]

    def attack(self, mesh: Mesh, kind: Kind, strength: float, *, seed: Seed) -> Mesh:
        """Apply an attack as a modelling tool would: to the welded points, so that copies of a point move together.

        A face that an attack changes refers to the first copy of each of its points: along a seam, where copies carry
        different data in the file, it takes that of the first. An attack that makes a new mesh leaves no copies, and no
        vertex that no face uses.

        Args:
            mesh: any mesh.
            kind: a name in `ATTACKS`, or an `Attack` of your own.
            strength: strength of the attack, in its unit.
            seed: seed of the attack's random choices, if it makes any: a whole number or a JAX random key.

        Returns:
            The attacked mesh with float64 vertices, in the same number and order unless the attack makes a new mesh.

        Raises:
            JaxmarkError: if there is no such attack, its strength is out of range, it is not possible on this mesh, or
                a package that it needs is not installed.
        """
        return self.chain(mesh, [(kind, strength)], seed=seed)

    def chain(self, mesh: Mesh, steps: Sequence[Step], *, seed: Seed) -> Mesh:
        """Apply attacks one after the other, each as `attack` does and with random choices of its own."""
        entries = [(self.get(kind), strength) for kind, strength in steps]
        for place, (entry, strength) in enumerate(entries):
            _check_strength(strength)
            key, mesh = random_key(seed), host_mesh(mesh)
            self._check_faces(entry, mesh)
            mesh = _apply(mesh, entry, strength, jax.random.fold_in(key, place) if place else key)
        return mesh

    def attack_each(self, meshes: Sequence[Mesh], kind: Kind, strength: float, *, seeds: Sequence[Seed]) -> list[Mesh]:
        """Apply one attack to several meshes, each with a seed of its own; with one mesh this is `attack`.

        A traced attack on meshes with the same faces, such as differently marked copies, is one `jax.vmap`: its random
        numbers are those of `attack`, and its positions differ by rounding at most.

        If one mesh is refused, all are.
        """
        entry, meshes = self.get(kind), [host_mesh(mesh) for mesh in meshes]
        _check_strength(strength)
        welded = weld(meshes[0].vertices)
        self._check_faces(entry, meshes[0])
        if entry.host or not all(
            same_connectivity(mesh, meshes[0]) and np.array_equal(weld(mesh.vertices).point, welded.point)
            for mesh in meshes[1:]
        ):
            return [self.attack(mesh, entry, strength, seed=seed) for mesh, seed in zip(meshes, seeds, strict=True)]
        return _apply_to_all(meshes, welded, entry, strength, jnp.stack([random_key(seed) for seed in seeds]))

    def get(self, kind: Kind) -> Attack:
        """Look up an attack by its name, or raise `JaxmarkError`; an `Attack` is returned as it is."""
        if isinstance(kind, Attack):
            return kind
        if not isinstance(kind, str):
            raise JaxmarkError(
                f"An attack is a name of ATTACKS or an Attack, such as Attack(function, 'unit', (0.1,)); got"
                f" {getattr(kind, '__name__', kind)!r}."
            )
        if kind not in self.attacks:
            raise JaxmarkError(f"There is no attack {kind!r}; there are {', '.join(self.attacks)}.")
        return self.attacks[kind]

    def _check_faces(self, entry: Attack, mesh: Mesh) -> None:
        """Refuse a point cloud where an attack needs faces."""
        if entry.faces:
            names = (name for name, other in self.attacks.items() if other is entry)
            check_faces(f"The attack {next(names, entry.apply.__name__)!r}", mesh)


def _check_strength(strength: float) -> None:
    if not (isinstance(strength, Real) and 0 <= strength <= _MOST_STRENGTH):
        raise JaxmarkError(
            f"The strength of an attack must be a number from 0 to {_MOST_STRENGTH:g}, got {strength!r}."
        )


def _apply(mesh: Mesh, entry: Attack, strength: float, seed: PRNGKeyArray) -> Mesh:
    """Apply an attack to the welded points of a mesh."""
    welded = weld(mesh.vertices)
    points = weld_mesh(mesh, welded)
    if entry.host:
        found = entry.apply(points, strength, generator(seed))
    else:
        small, restore = _normalise(points)
        found = restore(entry.apply(small, strength, seed))
    return _restore_copies(mesh, welded, points, found)


def _apply_to_all(
    meshes: Sequence[Mesh], welded: Weld, entry: Attack, strength: float, seeds: Key[Array, " meshes"]
) -> list[Mesh]:
    """Apply a traced attack to meshes with the same faces and welding, all at once."""
    points = [weld_mesh(mesh, welded) for mesh in meshes]
    small, restore = zip(*map(_normalise, points), strict=True)
    faces = small[0].faces

    def apply(vertices: Array, seed: PRNGKeyArray) -> tuple[Array, Array]:
        moved = entry.apply(Mesh(vertices, faces), strength, seed)
        return jnp.asarray(moved.vertices), jnp.asarray(moved.faces)

    starts = jnp.asarray(np.stack([one.vertices for one in small]))
    vertices, faces = jax.vmap(apply, out_axes=(0, None))(starts, seeds)
    return [
        _restore_copies(mesh, welded, start, back(Mesh(moved, faces)))
        for mesh, start, back, moved in zip(meshes, points, restore, np.asarray(vertices), strict=True)
    ]


def _restore_copies(mesh: Mesh, welded: Weld, points: Mesh, found: Mesh) -> Mesh:
    """Turn an attack's result on welded points into a mesh with its copies, if it still has the same points."""
    found = Mesh(np.asarray(found.vertices, np.float64), np.asarray(found.faces, np.int64))
    if len(points.faces) and not len(found.faces):
        raise JaxmarkError("The attack leaves no faces of the mesh; make it weaker.")
    still = found.vertices.shape == points.vertices.shape and np.array_equal(found.vertices, points.vertices)
    if not (same_connectivity(found, points) or (still and len(found.faces) == len(points.faces))):
        return compact(host_mesh(found))
    kept = (found.faces == points.faces).all(axis=1)
    faces = np.where(kept[:, None], mesh.faces, welded.first[found.faces])
    return Mesh(found.vertices[welded.point], faces)


def _normalise(points: Mesh) -> tuple[Mesh, Callable[[Mesh], Mesh]]:
    """Centre a mesh and scale it to unit diagonal, so that float32 is accurate; also return the map back."""
    centre, length = np.asarray(points.vertices)[used_vertices(points)].mean(axis=0), diagonal(points)
    start = (points.vertices - centre) / length

    def restore(moved: Mesh) -> Mesh:
        found = np.asarray(moved.vertices)
        there = centre + length * found.astype(np.float64)
        # Coordinates that the attack left alone stay exactly as they were.
        count = min(len(start), len(found))
        still = found[:count] == start[:count].astype(found.dtype)
        there[:count] = np.where(still, points.vertices[:count], there[:count])
        return Mesh(there, np.asarray(moved.faces))

    return Mesh(start, points.faces), restore
