"""Mark files of one mesh or of several meshes."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from jaxmark import distortion
from jaxmark.alignment.original import Original, shift_of
from jaxmark.app.output import FileOutcome, payload_text, survival_text
from jaxmark.app.progress import Doing, quietly
from jaxmark.errors import JaxmarkError
from jaxmark.files import Scene, load_mesh, load_scene, load_texture, may_stay, number_check, save_mesh, save_scene
from jaxmark.files.atomic import write_atomically
from jaxmark.files.pair import refuse_existing_pair, writing_pair
from jaxmark.files.programs import release_programs
from jaxmark.files.source import concerning
from jaxmark.files.typed import find_name
from jaxmark.geometry.mesh import Mesh, digest
from jaxmark.watermark.coding.keys import Key
from jaxmark.watermark.everyday import SceneInfo, embed_scene
from jaxmark.watermark.mark import EmbedInfo
from jaxmark.watermark.markers import Marker, prepare
from jaxmark.watermark.perception.budget import Bounds, Budget, excesses
from jaxmark.watermark.perception.capacity import Survival
from jaxmark.watermark.record import SceneRecord, looks_like_record
from jaxmark.watermark.schemes.passband import ADAPTIVE
from jaxmark.watermark.schemes.registry import DEFAULT_SCHEME, AnyScheme, name_of
from jaxmark.watermark.tracing.tracer import make_tracer

_MOST_NAMED = 5  # most meshes that a message lists by name
_SLIGHT_ROUNDING = 0.005  # RMS of what rounding adds to a displacement, over its own, that moves no metric visibly


def pick(scene: Scene, names: Sequence[str], path: Path) -> Scene:
    """Select the meshes with the given names; all meshes if no names are given.

    Raises:
        JaxmarkError: if the file has no mesh with one of the names, or this mesh cannot be used.
    """
    chosen: list[str] = []
    known_names = {**scene.meshes, **scene.skipped}
    for name in names:
        with concerning(path):
            known_name = find_name(name, known_names)
        if known_name is None:
            known = ", ".join(map(repr, list(scene.meshes)[:_MOST_NAMED]))
            raise JaxmarkError(f"{path} has no mesh {name!r}; there are {len(scene.meshes)}, such as {known}.")
        if known_name in scene.skipped:
            raise JaxmarkError(f"{path}: the mesh {name!r} cannot be used: {scene.skipped[known_name]}.")
        chosen.append(known_name)
    if not names:
        return scene
    others = {name: "it was not selected" for name in scene.meshes if name not in chosen}
    return Scene({name: scene.meshes[name] for name in chosen}, {**scene.skipped, **others})


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
    overwrite: bool = False,
    doing: Doing = quietly,
) -> FileOutcome:
    """Mark a mesh file, and write the marked file and its record together, see `writing_pair`.

    Args:
        original: the mesh file to mark.
        marked: path of the marked file, with the same suffix.
        record: path of the mark's record.
        key: the key to mark with.
        message: the message to write, empty for a presence mark; None if `recipient` is given.
        recipient: identifier of the recipient of this copy; None if `message` is given.
        budget: see `embed`.
        scheme: see `embed`.
        meshes: names of the meshes to mark, in a file of several meshes; by default all that can carry the message.
        overwrite: whether an existing marked file and its record may be replaced; the old record is kept.
        doing: progress callback, called with a description of each step that begins.

    Raises:
        JaxmarkError: see `embed`; also if the mark cannot be read from the written file, whose numbers are rounded, or
            a file exists that may not be replaced.
    """
    if (message is None) == (recipient is None):
        raise JaxmarkError("Give one of --message, --text, --presence and --recipient.")
    refuse_existing_pair(marked, record, overwrite=overwrite, original=original)
    if record.is_file() and not looks_like_record(record):
        raise JaxmarkError(f"{record} is no record, so it is not replaced by one; give another name by --record.")
    doing(f"reading {original}")
    scene = pick(load_scene(original), meshes, original)
    if len(scene.meshes) + len(scene.skipped) > 1:
        if message is None:
            raise JaxmarkError(
                f"A fingerprint needs a file of one mesh, and {original} has several; save each mesh in its own file."
            )
        try:
            return _mark_scene(original, marked, record, scene, message, key, budget, scheme, overwrite, doing)
        except JaxmarkError:
            # All objects of an OBJ file share one coordinate system. Marked as one mesh, they may carry a message that
            # is too long for each of them.
            if original.suffix.lower() != ".obj" or meshes:
                raise
    number_check(original)  # refuses a file that cannot be written before a mark is computed
    mesh = load_mesh(original)
    doing(f"preparing {original}")
    read_back: Callable[[Mesh], Survival | bool | None]
    if message is not None:
        marker = prepare(mesh, key, 8 * len(message), scheme, adapt_to=budget)
        doing(f"embedding {original}")
        result, info = marker.embed(message, budget, read_back="later")
        marker = marker.with_record(info.record)
        prepared, payload = marker.original, payload_text(info.record.bits)
        read_back = partial(marker.measure_survival, message=message, predicted=info.survives)
        check = partial(marker.check, result, message)
    else:
        if scheme != DEFAULT_SCHEME:
            raise JaxmarkError(
                f"The scheme {scheme!r} cannot carry fingerprints; leave out --scheme, or give {DEFAULT_SCHEME!r}."
            )
        tracer, name = make_tracer(mesh, key), str(recipient)
        doing(f"embedding {original}")
        result, info = tracer.fingerprint(name, budget)
        prepared, payload = tracer.mark.original, f"fingerprint of {recipient}"
        read_back, check = partial(tracer.finds, recipient=name), None
    writing = writing_pair(marked, record, overwrite=overwrite, original=original, may_stay=may_stay)
    with info.explained(), writing as pair:
        doing(f"writing {marked}, and measuring the noise that the mark survives")
        notes = (*info.notes, *save_mesh(result, pair.file, like=original))
        # The mark must be readable from the written file, whose numbers are rounded.
        written = load_mesh(pair.file)
        survives = read_back(written)
        if not survives:
            if check is not None:
                check()
            raise JaxmarkError(
                f"The mark cannot be read after rounding to the precision of {original}; use a larger budget, or a file"
                " with more digits."
            )
        write_atomically(pair.record, info.record.to_json().encode())
    doing("measuring the displacement")
    notes += _excess(prepared, result, written, budget.bounds_of(prepared))
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
        "notes": list(notes),
        "record": str(record),
        "marked": str(marked),
        "old_record": pair.kept,
    }
    text = f"{payload} → {marked}, {_moved_text(moved)} of the diagonal; record → {record}{pair}"
    if isinstance(survives, Survival):
        text += f"; it survives {survival_text(survives)}"
    if (band := info.record.parameters.get("passband")) in ADAPTIVE[1:]:
        text += f"; because the mark is weak, it is written in the pass band {band!r}, which is in the record"
    if drift is not None:
        text += f"; the texture drifts by {drift:.2g} texels, if it has 2,048 x 2,048"
    return FileOutcome(values, (text, *notes))


def _mark_scene(
    original: Path,
    marked: Path,
    record: Path,
    scene: Scene,
    message: bytes,
    key: Key,
    budget: Budget,
    scheme: AnyScheme,
    overwrite: bool,
    doing: Doing,
) -> FileOutcome:
    """Mark all meshes of a file that can carry a message; if an error occurs, neither file nor record is written.

    Raises:
        JaxmarkError: if no mesh can carry the message; see `embed_scene`.
    """
    markers: dict[str, Any] = {}
    check_numbers = number_check(original)

    def check(name: str, marker: Marker, result: Mesh, info: EmbedInfo) -> EmbedInfo:
        """Check that the numbers of the file are precise enough for a mark."""
        release_programs()
        doing(f"{len(markers) + 1} of {len(scene.meshes)} meshes: checking {name!r}")
        check_numbers(name, result)
        # The caches of the marker are dropped: the caches of all meshes together would not fit into memory.
        markers[name] = _without_caches(marker.with_record(info.record))
        return info

    doing(f"embedding {len(scene.meshes)} meshes of {original}")
    try:
        meshes, info = embed_scene(scene.meshes, message, key, budget=budget, scheme=scheme, after=check)
    except JaxmarkError as error:
        raise JaxmarkError("; ".join([str(error).rstrip("."), *_unchanged(scene.skipped)]) + ".") from error
    survives: dict[str, Survival] = {}
    with writing_pair(marked, record, overwrite=overwrite, original=original, may_stay=may_stay) as pair:
        doing(f"writing {marked}, and reading it back")
        notes = save_scene(meshes, pair.file, like=original)
        # The marks must be readable from the written file, whose numbers are rounded.
        written = load_scene(pair.file).meshes
        measured: dict[tuple[bytes, bytes], Survival | None] = {}
        for name, marker in markers.items():
            both = digest(scene.meshes[name]), digest(written[name])
            if both not in measured:  # once for equal meshes
                predicted = info.meshes[name].survives
                measured[both] = _without_caches(marker).measure_survival(written[name], message, predicted)
            if (survival := measured[both]) is not None:
                survives[name] = survival
        if not survives:
            raise JaxmarkError(
                f"No mark can be read after rounding to the precision of {original}; use a larger budget, or a file"
                " with more digits."
            )
        if len(survives) < len(markers):
            info = _restricted(info, survives, key)
            notes = save_scene({name: meshes[name] for name in survives}, pair.file, like=original)
        write_atomically(pair.record, info.record.to_json().encode())
    each = {
        name: {**_moved(markers[name].original, written[name]), "survives": survives[name]._asdict()}
        for name in info.meshes
    }
    skipped = {**scene.skipped, **info.skipped}
    most = {size: max(values[size] for values in each.values()) for size in ("rms", "max")}
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
        "old_record": pair.kept,
    }
    least = Survival(*(min(noises) for noises in zip(*survives.values(), strict=True)))
    text = (
        f"{payload_text(info.record.bits)} in {len(each)} of {len(each) + len(skipped)} meshes → {marked},"
        f" {_moved_text(most)} of their diagonals; record → {record}{pair};"
        f" the weakest mark survives {survival_text(least)}"
    )
    noted = [f"{name}: {note}" for name, info in info.meshes.items() for note in info.notes]
    for name in info.meshes:
        prepared: Original = markers[name].original
        excess = _excess(prepared, meshes[name], written[name], budget.bounds_of(prepared))
        noted += [f"{name}: {note}" for note in excess]
    return FileOutcome(values, (text, *_unchanged(skipped), *noted, *notes))


def _restricted(info: SceneInfo, names: Collection[str], key: Key) -> SceneInfo:
    """Leave out the marks of all other meshes, which cannot be read from the file."""
    lost = dict.fromkeys(info.meshes.keys() - names, "its mark cannot be read after rounding to the file's precision")
    records = {name: info.record.meshes[name] for name in names}
    meshes = {name: info.meshes[name] for name in names}
    return SceneInfo(meshes, {**info.skipped, **lost}, SceneRecord(records).sealed(key))


def _unchanged(skipped: Mapping[str, str]) -> list[str]:
    """List the meshes that were left unchanged, with the reasons, at most five of them."""
    lines = [f"left unchanged: {name!r}: {reason}" for name, reason in list(skipped.items())[:_MOST_NAMED]]
    if len(skipped) > _MOST_NAMED:
        lines.append(f"left unchanged: {len(skipped) - _MOST_NAMED} more, see --json")
    return lines


def _without_caches(marker: Any) -> Any:
    """Copy a marker, which is a dataclass, without its cached values."""
    return replace(marker)


def _excess(original: Original, exact: Mesh, written: Mesh, bounds: Bounds) -> tuple[str, ...]:
    """Say which bounds a written mesh exceeds, because the numbers of its file are rounded; nothing if it does not."""
    intended, actual = (shift_of(original, mesh)[original.used] for mesh in (exact, written))
    if distortion.rms(actual - intended) <= _SLIGHT_ROUNDING * distortion.rms(intended):
        return ()
    found = excesses(original, written, bounds)
    return (f"after rounding to the numbers of the file, {' and '.join(found)}",) if found else ()


def _moved(original: Original, written: Mesh) -> dict[str, float]:
    """Measure the RMS and the largest displacement of a marked mesh, as fractions of its diagonal."""
    change = distortion.DisplacementSize.of(shift_of(original, written)[original.used])
    return {"rms": change.rms, "max": change.max}


def _moved_text(moved: dict[str, float]) -> str:
    return f"RMS {moved['rms']:.3g} and max {moved['max']:.3g}"
