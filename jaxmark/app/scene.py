"""Mark files of several meshes."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from jaxmark import distortion
from jaxmark.alignment.original import shift_of
from jaxmark.app.programs import release_programs
from jaxmark.app.progress import Doing
from jaxmark.app.telling import Told, told_payload, told_survival
from jaxmark.errors import JaxmarkError
from jaxmark.files import Scene, load_scene, number_check, save_scene
from jaxmark.files.atomic import replacing, write_atomically
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.coding.keys import Key
from jaxmark.watermark.everyday import AnyMarker, AnyScheme, name_of
from jaxmark.watermark.marking import EmbedInfo, Survival
from jaxmark.watermark.perception.budget import Visibility
from jaxmark.watermark.scenes import embed_scene

_MOST_TOLD = 5  # meshes that are named in a sentence


def pick(scene: Scene, names: Sequence[str], path: Path) -> Scene:
    """The meshes of these names; all of them if there are none.

    Raises:
        JaxmarkError: if the file has no mesh of such a name, or it cannot be used.
    """
    for name in names:
        if name in scene.left:
            raise JaxmarkError(f"{path}: the mesh {name!r} cannot be used: {scene.left[name]}.")
        if name not in scene.meshes:
            known = ", ".join(map(repr, list(scene.meshes)[:_MOST_TOLD]))
            raise JaxmarkError(f"{path} has no mesh {name!r}; there are {len(scene.meshes)}, such as {known}.")
    if not names:
        return scene
    others = {name: "it was not picked" for name in scene.meshes if name not in names}
    return Scene({name: scene.meshes[name] for name in names}, {**scene.left, **others})


def mark_scene(
    original: Path,
    marked: Path,
    record: Path,
    scene: Scene,
    message: bytes,
    *,
    key: Key,
    budget: float | None,
    limits: Mapping[str, float] | None,
    visibility: Visibility | None,
    noise: float | None,
    scheme: AnyScheme,
    doing: Doing,
) -> Told:
    """Mark the meshes of a file that can carry a message, and write the marked file and its record, both or neither.

    Args:
        original: the file.
        marked: path of the marked file, with the same suffix.
        record: path of the record.
        scene: the meshes to mark.
        message: see `embed`.
        key: the key to mark with.
        budget: see `embed`; relative to the diagonal of each mesh.
        limits: see `embed`.
        visibility: see `embed`.
        noise: see `embed`.
        scheme: see `embed`.
        doing: is told what begins.

    Raises:
        JaxmarkError: if no mesh can carry the message; see `embed_scene`.
    """
    markers: dict[str, AnyMarker] = {}
    fine_enough = number_check(original)

    def check(name: str, marker: AnyMarker, result: Mesh, info: EmbedInfo) -> EmbedInfo:
        """Check that the file's numbers are fine enough for a mark."""
        release_programs()
        doing(f"{len(markers) + 1} of {len(scene.meshes)} meshes: checking {name!r}")
        fine_enough(name, result)
        # What it has computed to read is let go of: that of all meshes would not fit.
        markers[name] = replace(marker.with_record(info.record))
        return info

    doing(f"embedding {len(scene.meshes)} meshes of {original}")
    meshes, info = embed_scene(
        scene.meshes,
        message,
        key,
        budget=budget,
        limits=limits,
        visibility=visibility,
        noise=noise,
        scheme=scheme,
        after=check,
    )
    survives: dict[str, Survival] = {}
    with replacing(marked) as draft, replacing(record) as record_draft:
        doing(f"writing {marked}, and reading it back")
        remarks = save_scene(meshes, draft, like=original)
        # The marks must read from the written file, whose numbers are rounded.
        written = load_scene(draft).meshes
        for name, marker in markers.items():
            found = replace(marker).tried(written[name], message, info.meshes[name].survives)
            if found is None:
                raise JaxmarkError(
                    f"Rounded to the numbers of {original}, the mark of the mesh {name!r} no longer reads; pick the"
                    " others by --mesh."
                )
            survives[name] = found
        write_atomically(record_draft, info.record.to_json().encode())
    each = {
        name: {**_moved(markers[name], written[name]), "survives": survives[name]._asdict()} for name in info.meshes
    }
    left = {**scene.left, **info.left}
    answer = {
        "rms": max(one["rms"] for one in each.values()),
        "max": max(one["max"] for one in each.values()),
        "bits": info.record.bits,
        "scheme": name_of(scheme),
        "content": "message" if message else "presence",
        "meshes": each,
        "left": left,
        "remarks": list(remarks),
        "record": str(record),
        "marked": str(marked),
    }
    least = Survival(*(min(values) for values in zip(*survives.values(), strict=True)))
    text = (
        f"{told_payload(info.record.bits)} in {len(each)} of {len(each) + len(left)} meshes → {marked}, RMS"
        f" {answer['rms']:.3g} and max {answer['max']:.3g} of their diagonals; record → {record}; the weakest survives"
        f" {told_survival(least)}"
    )
    for name, reason in list(left.items())[:_MOST_TOLD]:
        text += f"\nleft alone: {name!r}: {reason}"
    if len(left) > _MOST_TOLD:
        text += f"\nleft alone: {len(left) - _MOST_TOLD} more, see --json"
    return Told(answer, "\n".join([text, *remarks]))


def _moved(marker: AnyMarker, written: Mesh) -> dict[str, float]:
    """How far a mesh was moved, in its diagonals."""
    change = distortion.DisplacementSize.of(shift_of(marker.original, written)[marker.original.used])
    return {"rms": change.rms, "max": change.max}
