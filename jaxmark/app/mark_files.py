"""Mark mesh files: of one mesh, or of several."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from jaxmark import distortion
from jaxmark.alignment.original import Original, shift_of
from jaxmark.app.output import FileOutcome, payload_text, survival_text
from jaxmark.app.process import release_programs
from jaxmark.app.progress import Doing, quietly
from jaxmark.errors import JaxmarkError
from jaxmark.files import Scene, load_mesh, load_scene, load_texture, number_check, save_mesh, save_scene
from jaxmark.files.atomic import replacing, write_atomically
from jaxmark.geometry.mesh import Mesh
from jaxmark.watermark.coding.keys import Key
from jaxmark.watermark.everyday import embed_scene
from jaxmark.watermark.mark import EmbedInfo
from jaxmark.watermark.markers import Marker, prepare
from jaxmark.watermark.perception.budget import Budget
from jaxmark.watermark.perception.capacity import Survival
from jaxmark.watermark.schemes.passband import ADAPTIVE
from jaxmark.watermark.schemes.registry import DEFAULT_SCHEME, AnyScheme, name_of
from jaxmark.watermark.tracing.tracer import make_tracer

_MOST_NAMED = 5  # meshes that are named in a sentence


def pick(scene: Scene, names: Sequence[str], path: Path) -> Scene:
    """The meshes of these names; all of them if there are none.

    Raises:
        JaxmarkError: if the file has no mesh of such a name, or it cannot be used.
    """
    for name in names:
        if name in scene.skipped:
            raise JaxmarkError(f"{path}: the mesh {name!r} cannot be used: {scene.skipped[name]}.")
        if name not in scene.meshes:
            known = ", ".join(map(repr, list(scene.meshes)[:_MOST_NAMED]))
            raise JaxmarkError(f"{path} has no mesh {name!r}; there are {len(scene.meshes)}, such as {known}.")
    if not names:
        return scene
    others = {name: "it was not picked" for name in scene.meshes if name not in names}
    return Scene({name: scene.meshes[name] for name in names}, {**scene.skipped, **others})


def mark_file(
    original: Path,
    marked: Path,
    record: Path,
    *,
    key: Key,
    message: bytes | None = None,
    recipient: str | None = None,
    budget: Budget,
    scheme: AnyScheme = DEFAULT_SCHEME,
    meshes: Sequence[str] = (),
    doing: Doing = quietly,
) -> FileOutcome:
    """Mark a mesh file, and write the marked file and its record, both or neither.

    Args:
        original: the mesh file to mark.
        marked: path of the marked file, with the same suffix.
        record: path of the mark's record.
        key: the key to mark with.
        message: the message to write, empty for a presence mark; None if `recipient` is given.
        recipient: identifier of the recipient of this copy; None if `message` is given.
        budget: see `embed`.
        scheme: see `embed`.
        meshes: names of the meshes to mark, of several in the file; by default all that can carry the message.
        doing: is told what begins.

    Raises:
        JaxmarkError: see `embed`; also if the mark does not read from the written file, whose numbers are rounded.
    """
    if (message is None) == (recipient is None):
        raise JaxmarkError("Give --message, --presence or --recipient, one of them.")
    doing(f"reading {original}")
    scene = pick(load_scene(original), meshes, original)
    if len(scene.meshes) + len(scene.skipped) > 1:
        if message is None:
            raise JaxmarkError("Fingerprints are for files of one mesh; save the meshes of this one apart.")
        try:
            return _mark_scene(original, marked, record, scene, message, key, budget, scheme, doing)
        except JaxmarkError:
            # The objects of an OBJ file lie in the same coordinates, and together they may carry what none can alone.
            if original.suffix.lower() != ".obj" or meshes:
                raise
    mesh = load_mesh(original)
    doing(f"preparing {original}")
    tries: Callable[[Mesh], Survival | bool | None]
    if message is not None:
        marker = prepare(mesh, key, 8 * len(message), scheme, adapt_to=budget)
        doing(f"embedding {original}")
        result, info = marker.embed(message, budget, read_back=False)
        marker = marker.with_record(info.record)
        prepared, said = marker.original, payload_text(info.record.bits)
        tries = partial(marker.measure_survival, message=message, predicted=info.survives)
        check = partial(marker.check, result, message)
    else:
        if scheme != DEFAULT_SCHEME:
            raise JaxmarkError(f"Fingerprints are carried by the scheme {DEFAULT_SCHEME!r}, not {scheme!r}.")
        tracer, name = make_tracer(mesh, key), str(recipient)
        doing(f"embedding {original}")
        result, info = tracer.fingerprint(name, budget)
        prepared, said = tracer.mark.original, f"fingerprint of {recipient}"
        tries, check = partial(tracer.finds, recipient=name), None
    with replacing(marked) as draft, replacing(record) as record_draft:
        doing(f"writing {marked}, and trying what the mark survives")
        save_mesh(result, draft, like=original)
        # The mark must read from the written file, whose numbers are rounded.
        written = load_mesh(draft)
        survives = tries(written)
        if not survives:
            if check is not None:
                check()
            raise JaxmarkError(
                f"Rounded to the numbers of {original}, the mark no longer reads; use a larger budget, or a file with"
                " more digits."
            )
        write_atomically(record_draft, info.record.to_json().encode())
    doing("measuring what was moved")
    texture = load_texture(original)
    drift = None if texture is None else distortion.texture_drift(mesh, written, texture)
    moved = _moved(prepared, written)
    values = {
        **moved,
        "bits": info.record.bits,
        "scheme": name_of(scheme),
        "parameters": dict(info.record.parameters),
        "content": info.record.content,
        "survives": survives._asdict() if isinstance(survives, Survival) else None,
        "texture_drift": drift,
        "record": str(record),
        "marked": str(marked),
    }
    text = f"{said} → {marked}, {_moved_text(moved)} of the diagonal; record → {record}"
    if isinstance(survives, Survival):
        text += f"; it survives {survival_text(survives)}"
    if (band := info.record.parameters.get("passband")) in ADAPTIVE[1:]:
        text += f"; so faint a mark is written in the pass band {band!r}, which the record says"
    if drift is not None:
        text += f"; a texture of 2,048 x 2,048 drifts by {drift:.2g} texels"
    return FileOutcome(values, text)


def _mark_scene(
    original: Path,
    marked: Path,
    record: Path,
    scene: Scene,
    message: bytes,
    key: Key,
    budget: Budget,
    scheme: AnyScheme,
    doing: Doing,
) -> FileOutcome:
    """Mark the meshes of a file that can carry a message, and write the file and its record, both or neither.

    Raises:
        JaxmarkError: if no mesh can carry the message; see `embed_scene`.
    """
    markers: dict[str, Any] = {}
    fine_enough = number_check(original)

    def check(name: str, marker: Marker, result: Mesh, info: EmbedInfo) -> EmbedInfo:
        """Check that the file's numbers are fine enough for a mark."""
        release_programs()
        doing(f"{len(markers) + 1} of {len(scene.meshes)} meshes: checking {name!r}")
        fine_enough(name, result)
        # What a marker has computed to read is dropped: that of all meshes would not fit.
        markers[name] = _without_caches(marker.with_record(info.record))
        return info

    doing(f"embedding {len(scene.meshes)} meshes of {original}")
    meshes, info = embed_scene(scene.meshes, message, key, budget=budget, scheme=scheme, after=check)
    survives: dict[str, Survival] = {}
    with replacing(marked) as draft, replacing(record) as record_draft:
        doing(f"writing {marked}, and reading it back")
        notes = save_scene(meshes, draft, like=original)
        # The marks must read from the written file, whose numbers are rounded.
        written = load_scene(draft).meshes
        for name, marker in markers.items():
            predicted = info.meshes[name].survives
            found = _without_caches(marker).measure_survival(written[name], message, predicted)
            if found is None:
                raise JaxmarkError(
                    f"Rounded to the numbers of {original}, the mark of the mesh {name!r} no longer reads; pick the"
                    " others by --mesh."
                )
            survives[name] = found
        write_atomically(record_draft, info.record.to_json().encode())
    each = {
        name: {**_moved(markers[name].original, written[name]), "survives": survives[name]._asdict()}
        for name in info.meshes
    }
    skipped = {**scene.skipped, **info.skipped}
    most = {size: max(one[size] for one in each.values()) for size in ("rms", "max")}
    values = {
        **most,
        "bits": info.record.bits,
        "scheme": name_of(scheme),
        "content": "message" if message else "presence",
        "meshes": each,
        "skipped": skipped,
        "notes": list(notes),
        "record": str(record),
        "marked": str(marked),
    }
    least = Survival(*(min(found) for found in zip(*survives.values(), strict=True)))
    text = (
        f"{payload_text(info.record.bits)} in {len(each)} of {len(each) + len(skipped)} meshes → {marked},"
        f" {_moved_text(most)} of their diagonals; record → {record}; the weakest survives {survival_text(least)}"
    )
    for name, reason in list(skipped.items())[:_MOST_NAMED]:
        text += f"\nleft alone: {name!r}: {reason}"
    if len(skipped) > _MOST_NAMED:
        text += f"\nleft alone: {len(skipped) - _MOST_NAMED} more, see --json"
    return FileOutcome(values, "\n".join([text, *notes]))


def _without_caches(marker: Any) -> Any:
    """A copy of a marker, a dataclass, without what it has computed."""
    return replace(marker)


def _moved(original: Original, written: Mesh) -> dict[str, float]:
    """How far a mesh was moved, in its diagonals."""
    change = distortion.DisplacementSize.of(shift_of(original, written)[original.used])
    return {"rms": change.rms, "max": change.max}


def _moved_text(moved: dict[str, float]) -> str:
    return f"RMS {moved['rms']:.3g} and max {moved['max']:.3g}"
