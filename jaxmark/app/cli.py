"""The command line: every command reads files, writes files, and prints one answer.

The exit status is 0 if the command is done or a mark is detected, 1 if `detect` detects nothing or `identify` accuses
nobody, and 3 if they have only an estimate, which proves nothing. It is 2 if the input is refused; then standard error
has one sentence, and no output file is written. With --json, standard output is exactly one JSON object. For a folder,
it is one line or one object per file, and the exit status is the worst of all files, see `Status`.
"""

import math
import sys
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NoReturn, get_args

import click

from jaxmark import distortion
from jaxmark.adversaries.by_name import ATTACKS, chain, get_attack
from jaxmark.alignment.result import Align
from jaxmark.app.bench_commands import bench_command, bench_corpus_command, bench_equal_command
from jaxmark.app.catalogue_commands import catalogue_group, mark_for_command
from jaxmark.app.find_commands import identify_by_catalogue
from jaxmark.app.folders import Work, each, mesh_files
from jaxmark.app.mark_files import mark_file
from jaxmark.app.options import (
    ALIGN,
    ALPHA,
    FILE,
    JSON,
    KEY,
    MESHES,
    OVERWRITE,
    QUIET,
    WORKERS,
    Schemes,
    budget_options,
    message_options,
    read_key,
    read_recipients,
)
from jaxmark.app.output import (
    ESTIMATE,
    FileOutcome,
    Status,
    answer,
    check_distinct,
    check_suffix,
    error_text,
    power,
    say,
)
from jaxmark.app.process import end_by_exception
from jaxmark.app.progress import current
from jaxmark.app.read_files import FileReader
from jaxmark.app.serving import serve_command
from jaxmark.errors import AlignmentError, JaxmarkError, require
from jaxmark.evaluation.cells import left_over
from jaxmark.evaluation.pictures import Measure
from jaxmark.evaluation.study import load_study
from jaxmark.files import load_mesh, load_scene, load_skin, may_stay, save_mesh, save_scene
from jaxmark.files.atomic import replacing, write_atomically
from jaxmark.files.pair import writing_pair
from jaxmark.geometry import unpose
from jaxmark.geometry.mesh import same_connectivity
from jaxmark.watermark.blind.field import FieldScheme
from jaxmark.watermark.coding.keys import commitment, new_key, save_key
from jaxmark.watermark.coding.message import DEFAULT_BITS
from jaxmark.watermark.everyday import capacity
from jaxmark.watermark.evidence.detection import check_alpha
from jaxmark.watermark.evidence.ledger import charges_as_json
from jaxmark.watermark.perception.budget import Budget
from jaxmark.watermark.perception.capacity import COVERAGE, NOISE
from jaxmark.watermark.record import RECORD_SUFFIX, Record, TimestampedCommitment, load_record, make_commitment
from jaxmark.watermark.schemes.registry import BLIND_SCHEMES, DEFAULT_SCHEME, NAMES, USUAL_BLIND_SCHEMES, AnyScheme
from jaxmark.watermark.tracing.tracer import identify


@click.group(
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog="Exit status: 0 if done or detected, 1 if nothing is detected, 2 if the input is refused, 3 if there is only"
    " an estimate, which proves nothing. Compiled programs are cached in ~/.cache/jaxmark for later commands;"
    " JAX_ENABLE_COMPILATION_CACHE=false turns the cache off.",
)
@click.version_option(package_name="jaxmark", prog_name="jaxmark")
def cli() -> None:
    """Hide a keyed message in the vertex positions of a mesh, and read it from a suspect.

    \b
    A first example:
      jaxmark keygen owner.key
      jaxmark embed model.ply marked.ply --key owner.key --message 0123456789abcdef
      jaxmark attack marked.ply suspect.ply noise 0.001
      jaxmark detect suspect.ply --original model.ply --key owner.key

    Mesh files are OBJ, PLY, OFF, STL, GLB, glTF, 3MF or USD. Point clouds are PLY, XYZ, LAS or LAZ. Keep the key
    secret. Keep the original, too: only marks of the blind schemes `field`, `local` and `rooted` are read without it.
    """  # noqa: D301


@cli.command()
@click.argument("keyfile", type=FILE)
@JSON
def keygen(keyfile: Path, as_json: bool) -> None:
    """Make a key of 256 random bits.

    Writes KEYFILE, which only you can read; a file that exists is not overwritten. Keep a backup: without the key, a
    mark can be neither read nor proven.
    """
    key = new_key()
    save_key(key, keyfile)
    answer(as_json, {"key_file": str(keyfile), "commitment": commitment(key)}, f"key → {keyfile}")


@cli.command(name="embed")
@click.argument("original", type=FILE)
@click.argument("marked", type=FILE)
@KEY
@message_options(
    "The message in hexadecimal digits; 16 digits are 64 bits.",
    "The message as text, in UTF-8; most letters take 8 bits.",
    "Embed a presence mark: it has no message, and proves only that the mesh is marked.",
)
@click.option("--recipient", help="Mark a copy for this recipient instead of a message; see `jaxmark identify`.")
@budget_options(
    noise_help="Noise that the message must survive with half of the vertices lost: half width of the uniform noise,"
    " relative to the mean distance of vertices to the centre.  [default: none; the noise survived is printed]"
)
@MESHES
@click.option(
    "--scheme",
    "schemes",
    type=Schemes(),
    default=DEFAULT_SCHEME,
    show_default=True,
    help=f"Scheme that carries the bits: {', '.join(NAMES)}. Marks of `field`, `local` and `rooted` are read without"
    " the original. Several schemes, separated by commas (keyed,field), mark the mesh with each of them.",
)
@click.option(
    "--no-hint",
    is_flag=True,
    help="Leave out of the record of `field` the hint with which parts are read: 100 points of the original.",
)
@click.option("--record", "record_file", type=FILE, help=f"File for the record.  [default: MARKED{RECORD_SUFFIX}]")
@OVERWRITE
@WORKERS
@QUIET
@JSON
def embed_command(
    original: Path,
    marked: Path,
    key_file: Path,
    message: bytes | None,
    presence: bool,
    recipient: str | None,
    budget: Budget,
    meshes: tuple[str, ...],
    schemes: tuple[str, ...],
    no_hint: bool,
    record_file: Path | None,
    overwrite: bool,
    workers: int,
    as_json: bool,
) -> None:
    """Embed a message in ORIGINAL: a mesh file, or a folder of mesh files.

    Needs the key and one of --message, --text, --presence and --recipient.

    Writes MARKED, in the same format, and its record. Only positions change, and normals where the file has them;
    materials, colours, groups and comments stay the same, byte by byte. The record holds no secret, but that of `field`
    holds up to 100 points of the original (--no-hint). `jaxmark detect` takes scheme and payload from it. Files that
    exist are refused without --overwrite.

    In a file of several meshes, all that can carry the message are marked; the output names those left unchanged.

    If ORIGINAL is a folder, MARKED is the folder for the marked files, and one line is printed per file. A refused file
    does not stop the others.

    Exit status 0 if ORIGINAL is marked, 2 if it or a file of it is refused.
    """
    if presence and message is not None:
        raise JaxmarkError("Give either --message or --presence.")
    scheme: AnyScheme = schemes[0] if len(schemes) == 1 else schemes
    if no_hint:
        if scheme != FieldScheme.name:
            raise JaxmarkError(f"Only records of --scheme {FieldScheme.name} have a hint; leave out --no-hint.")
        scheme = FieldScheme(with_hint=False)
    mark = partial(
        mark_file,
        message=b"" if presence else message,
        recipient=recipient,
        budget=budget,
        scheme=scheme,
        meshes=meshes,
        overwrite=overwrite,
    )
    check_distinct(original=original, marked=marked)
    if not original.is_dir():
        record_file = record_file or marked.with_name(marked.name + RECORD_SUFFIX)
        check_suffix(original, marked)
        check_distinct(original=original, marked=marked, key=key_file, record=record_file)
        outcome = mark(original, marked, record_file, key=read_key(key_file), doing=current().doing)
        return answer(as_json, outcome.values, *outcome.lines)
    if record_file is not None:
        raise JaxmarkError("In a folder, each marked file gets a record next to it; leave out --record.")
    work = partial(_mark_member, partial(mark, key=read_key(key_file)), marked)
    mesh_files(original)  # refuses a folder without any before another is made
    marked.mkdir(parents=True, exist_ok=True)
    _each(original, as_json, work, workers)


@cli.command(name="detect")
@click.argument("suspect", type=FILE)
@click.option("--original", type=FILE, help="The unmarked mesh; not needed for blind marks.")
@KEY
@click.option(
    "--bits", type=int, help=f"Payload in bits, a multiple of 8.  [default: the record's, else {DEFAULT_BITS}]"
)
@message_options(
    "The claimed message, in hexadecimal digits. Testing a claim detects marks that are too weak to be decoded.",
    "The claimed message as text.",
    "Claim a presence mark. Not needed with its record, which says that it is one.",
)
@click.option(
    "--record",
    "record_file",
    type=FILE,
    help="The mark's record. It gives scheme and payload, and it is checked against key and original.",
)
@MESHES
@click.option(
    "--scheme",
    "schemes",
    type=Schemes(),
    help="Scheme that carries the bits, if there is no record. Several, as in `embed`, combine their evidence."
    f"  [default: {DEFAULT_SCHEME}; without --original, {' and '.join(scheme.name for scheme in USUAL_BLIND_SCHEMES)}]",
)
@ALIGN
@click.option(
    "--commitment", "commitment_file", type=FILE, help="Timestamped commitment to the record, from `jaxmark commit`."
)
@click.option("--obtained", default="", help="When and where SUSPECT was obtained, for the dossier.")
@click.option("--report", type=FILE, help="Folder for a picture of the registration (needs the extra `plot`).")
@click.option(
    "--dossier", type=FILE, help="Folder for a page that explains a detection to others (needs the extra `plot`)."
)
@click.option(
    "--charges",
    is_flag=True,
    help="Print how much each choice of the reader costs of the significance budget (see docs/proof.md).",
)
@ALPHA
@WORKERS
@QUIET
@JSON
def detect_command(
    suspect: Path,
    original: Path | None,
    key_file: Path,
    bits: int | None,
    message: bytes | None,
    presence: bool,
    record_file: Path | None,
    meshes: tuple[str, ...],
    schemes: tuple[str, ...] | None,
    align: Align,
    commitment_file: Path | None,
    obtained: str,
    report: Path | None,
    dossier: Path | None,
    charges: bool,
    alpha: float,
    workers: int,
    as_json: bool,
) -> None:
    """Detect a mark in SUSPECT: a mesh file, in any pose and with any connectivity, or a folder of such files.

    Needs the key and, except for the blind schemes `field`, `local` and `rooted`, the original. With the mark's record,
    the original may be a copy that was saved in another format, rounded, moved as a whole or reordered.

    Prints the message and a bound on the false-positive probability. The bound holds for every suspect that was made
    without the key, if key, original, record and a claimed message were fixed before the suspect existed. A second
    bound holds even if they were chosen afterwards. A timestamped commitment (`jaxmark commit`) proves that the record
    is older than the suspect.

    In files of several meshes, each mesh of the suspect is compared with the most similar mesh of the original, and
    the evidence of all meshes is combined.

    If SUSPECT is a folder, one line is printed per file. --original and --record may then be folders, with files of
    the same names.

    Exit status 0 if the false-positive probability is at most --alpha, 1 if it is larger or SUSPECT cannot be aligned
    with the original, 2 if SUSPECT is refused, 3 if it is at most --alpha but only an estimate, which proves nothing,
    for example because the original was edited. For a folder, 0 if it is 0 for all files; otherwise 2, 1 or 3, the
    first of these that any file has.
    """
    if commitment_file is not None and record_file is None:
        raise JaxmarkError("--commitment is to a record; also give the --record that it contains.")
    if presence and (message is not None or bits):
        raise JaxmarkError("A presence mark has no message; leave out --message and --bits, or --presence.")
    check_alpha(alpha)
    named = schemes or ()
    blind = [name for name in named if name in BLIND_SCHEMES]
    only_blind = len(named) == len(blind) == 1
    if only_blind and original is not None and record_file is None:
        raise JaxmarkError(f"The scheme {blind[0]!r} is read without the original; leave out --original.")
    if original is None and named and not blind:
        raise JaxmarkError(f"The scheme {named[0]!r} is not blind; give --original.")
    if (only_blind or original is None) and (align, report, dossier) != ("auto", None, None):
        raise JaxmarkError(
            "--align, --report and --dossier are of marks that are read with the original; blind marks have none. For"
            " a mark of another scheme, give --original; otherwise, leave them out."
        )
    reader = FileReader(
        read_key(key_file),
        0 if presence else bits,
        message,
        named,
        align,
        alpha,
        None if commitment_file is None else TimestampedCommitment.load(commitment_file),
        obtained,
        diagnoses=not suspect.is_dir(),
        meshes=meshes,
        shows_charges=charges,
    )
    if suspect.is_dir():
        _each(suspect, as_json, partial(_read_member, reader, original, record_file, report, dossier), workers)
    outcome = replace(reader, doing=current().doing).read(suspect, original, record_file, report, dossier)
    answer(as_json, outcome.values, *outcome.lines)
    sys.exit(outcome.status)


@cli.command(name="identify")
@click.argument("suspect", type=FILE)
@click.option("--original", type=FILE, help="The unmarked mesh.")
@KEY
@click.option("--recipients", type=FILE, help="Text file of all recipients of copies, one identifier per line.")
@click.option(
    "--catalogue",
    "catalogue_file",
    type=FILE,
    help="Catalogue that holds originals and recipients; replaces --original and --recipients.",
)
@click.option(
    "--record", "record_file", type=FILE, help="The record of any copy; it is checked against key and original."
)
@click.option("--top", type=click.IntRange(1), help="Number of recipients in the ranking.  [default: 10]")
@ALIGN
@ALPHA
@QUIET
@JSON
def identify_command(
    suspect: Path,
    original: Path | None,
    key_file: Path,
    recipients: Path | None,
    catalogue_file: Path | None,
    record_file: Path | None,
    top: int | None,
    align: Align,
    alpha: float,
    as_json: bool,
) -> None:
    """Name the recipients whose copies SUSPECT was made from.

    Needs the key, and either the original and a list of recipients, or a catalogue. Prints each accused recipient. A
    recipient is accused if the probability that any innocent recipient has as high a score is at most --alpha.

    Exit status 0 if a recipient is accused, 1 if nobody is accused, 2 if SUSPECT is refused, 3 if the probability is
    only an estimate, for example because the original was edited. An estimate accuses nobody.
    """
    check_alpha(alpha)
    if catalogue_file is not None:
        if any(given is not None for given in (original, recipients, record_file, top)):
            raise JaxmarkError(
                "A catalogue holds originals, recipients and records, and names all that are accused; leave out"
                " --original, --recipients, --record and --top."
            )
        identify_by_catalogue(suspect, catalogue_file, key_file, align, alpha, as_json)
    if original is None or recipients is None:
        raise JaxmarkError("Give --original and --recipients, or a --catalogue that holds them.")
    names = read_recipients(recipients)
    record = None if record_file is None else Record.load(record_file)
    key = read_key(key_file)
    current().doing(f"reading {suspect} and {original}")
    meshes = load_mesh(suspect), load_mesh(original)
    current().doing(f"testing the copies of {len(names)} recipients in {suspect}")
    nobody = f"none of {len(names)} recipients is accused"
    try:
        ranking = identify(meshes[0], names, original=meshes[1], key=key, record=record, top=top or 10, align=align)
    except AlignmentError as error:
        values = {"accused": [], "estimates": [], "ranking": [], "recipients": len(names), "notes": [str(error)]}
        answer(as_json, values, f"{nobody}: {error}")
        sys.exit(Status.NOTHING)
    likely = [entry for entry in ranking if entry.log10_p <= math.log10(alpha)]
    accused = [entry.recipient for entry in likely if not entry.caveats]
    values = {
        "accused": accused,
        "estimates": [entry.recipient for entry in likely if entry.caveats],
        "ranking": [entry._asdict() | {"charges": charges_as_json(entry.charges)} for entry in ranking],
        "recipients": len(names),
    }
    lines = [
        f"{ESTIMATE}: {entry.recipient}: score {entry.score:.1f}, probability about {power(entry.log10_p)}:"
        f" {'; '.join(entry.caveats)}"
        if entry.caveats
        else f"{entry.recipient}: score {entry.score:.1f}, probability at most {power(entry.log10_p)} if key, original"
        f"{'' if record is None else ', record'} and the list of recipients were fixed before the suspect existed"
        for entry in likely
    ]
    answer(as_json, values, *(lines or [f"{nobody} (--alpha {alpha:g})"]))
    sys.exit(Status.of(bool(accused), bool(likely)))


@cli.command(name="commit")
@click.argument("records", type=FILE, nargs=-1, required=True)
@click.option(
    "--output", type=FILE, required=True, help="File for the commitment; a timestamp request is written next to it."
)
@OVERWRITE
@JSON
def commit_command(records: tuple[Path, ...], output: Path, overwrite: bool, as_json: bool) -> None:
    """Commit to RECORDS, so that a timestamp can prove that they existed before a suspect.

    Writes OUTPUT, the commitment, which reveals nothing of the records; and OUTPUT.tsq, a request for a timestamp. To
    timestamp the commitment, publish the root that is printed, or print it on paper, or sign a commit with it; or send
    OUTPUT.tsq to a timestamping authority (RFC 3161), and keep the answer. Files that exist are refused without
    --overwrite.

    `jaxmark detect --commitment OUTPUT` then prints the bound on the false-positive probability that holds if the
    commitment is older than the suspect. It charges log10 of the number of records.
    """
    request = output.with_name(output.name + ".tsq")
    check_distinct(output=output, request=request, **{f"record {place}": path for place, path in enumerate(records)})
    made = make_commitment(load_record(path).digest() for path in records)
    with writing_pair(request, output, overwrite=overwrite) as pair:
        write_atomically(pair.file, made.timestamp_request())
        write_atomically(pair.record, made.to_json().encode())
    values = {"root": made.root, "records": len(made.digests), "commitment": str(output), "request": str(request)}
    size = f"{len(made.digests)} record{'s' if len(made.digests) > 1 else ''}"
    answer(as_json, values, f"{size} → {output}, root {made.root}, request → {request}{pair}")


# click keeps the lines of a paragraph that starts with \b.
_KINDS = "\n".join(
    ["\b", "Each KIND and the meaning of its STRENGTH:", *(f"{name}: {entry.unit}" for name, entry in ATTACKS.items())]
)


@cli.command(name="attack", epilog=_KINDS, context_settings={"ignore_unknown_options": True})  # -1 is no option
@click.argument("source", metavar="IN", type=FILE)
@click.argument("target", metavar="OUT", type=FILE)
@click.argument("words", metavar="KIND STRENGTH [KIND STRENGTH]...", nargs=-1, required=True)
@click.option(
    "--seed",
    type=click.IntRange(0, 2**31 - 1),
    default=0,
    show_default=True,
    help="Seed of the attack's random choices.",
)
@QUIET
@JSON
def attack_command(source: Path, target: Path, words: tuple[str, ...], seed: int, as_json: bool) -> None:
    """Apply one or more attacks to a mesh, in the given order.

    Writes OUT, in the format of IN. If the connectivity stays, OUT is the file IN with other positions, and the RMS
    displacement is printed; else OUT is a new file.
    """
    steps = _steps(words)
    check_suffix(source, target)
    check_distinct(IN=source, OUT=target)
    current().doing(f"attacking {source}: {' '.join(words)}")
    scene = load_scene(source)
    if (
        len(scene.meshes) + len(scene.skipped) > 1 and source.suffix.lower() != ".obj"
    ):  # the objects of an OBJ file share one coordinate system, and are attacked as one mesh
        return _attack_scene(source, target, steps, seed, as_json)
    mesh = load_mesh(source)
    with replacing(target, may_stay) as draft:
        attacked = chain(mesh, steps, seed=seed)
        same = same_connectivity(mesh, attacked)
        save_mesh(attacked, draft, like=source if same else None)
        change = distortion.displacement_size(mesh, load_mesh(draft))._asdict() if same else {"rms": None, "max": None}
    values = {"attacks": steps, "seed": seed, "vertices": len(attacked.vertices), "faces": len(attacked.faces)}
    size = f"{len(attacked.vertices)} vertices and {len(attacked.faces)} faces"
    effect = f"RMS {change['rms']:.3g} of the diagonal" if same else f"a mesh of {size}"
    answer(as_json, {**values, **change}, f"{_steps_text(steps)} → {target}, {effect}")


def _steps_text(steps: list[tuple[str, float]]) -> str:
    return " + ".join(f"{kind} {strength:g}" for kind, strength in steps)


def _attack_scene(source: Path, target: Path, steps: list[tuple[str, float]], seed: int, as_json: bool) -> None:
    """Attack each mesh of a file of several meshes; attacks that change the connectivity are refused."""
    scene = load_scene(source)
    meshes = scene.meshes
    attacked = {name: chain(mesh, steps, seed=seed) for name, mesh in meshes.items()}
    for name, mesh in meshes.items():
        if not same_connectivity(mesh, attacked[name]):
            raise JaxmarkError(
                f"{_steps_text(steps)} changes faces, which is not possible in a file of several meshes; save each"
                " mesh in a file of its own."
            )
    with replacing(target, may_stay) as draft:
        save_scene(attacked, draft, like=source)
        after = load_scene(draft).meshes
    sizes = {name: distortion.displacement_size(mesh, after[name])._asdict() for name, mesh in meshes.items()}
    values = {"attacks": steps, "seed": seed, "meshes": sizes, "skipped": scene.skipped}
    largest = max(size["rms"] for size in sizes.values())
    lines = [f"{_steps_text(steps)} → {target}, {len(meshes)} meshes, RMS up to {largest:.3g} of their diagonals"]
    lines += [f"left unchanged: {name!r}: {reason}" for name, reason in scene.skipped.items()]
    answer(as_json, values, *lines)


def _steps(words: tuple[str, ...]) -> list[tuple[str, float]]:
    """Parse alternating names and strengths."""
    kinds, strengths = words[::2], words[1::2]
    for kind in kinds:
        get_attack(kind)
    if len(kinds) != len(strengths):
        unit = get_attack(kinds[-1]).unit
        raise JaxmarkError(f"The attack {kinds[-1]} has no strength; give it after the name: {unit}.")
    try:
        return [(kind, float(strength)) for kind, strength in zip(kinds, strengths, strict=True)]
    except ValueError as error:
        raise JaxmarkError(f"A strength must be a number: {error}.") from None


@cli.command()
@click.argument("original", type=FILE)
@click.argument("distorted", type=FILE)
@click.option("--pictures", is_flag=True, help="Also compare rendered pictures of the meshes; takes many seconds.")
@QUIET
@JSON
def compare(original: Path, distorted: Path, pictures: bool, as_json: bool) -> None:
    """Measure the distortion of DISTORTED, compared with ORIGINAL, by all metrics.

    Prints one line per metric. rms, max, mrms, hausdorff and gl are relative to the original's bounding-box diagonal.
    dame is in radians, shading in just noticeable differences, and point_to_plane in distances of neighbouring points.
    The other metrics are between 0 and 1. Point clouds have only rms, max and point_to_plane. flip and ssim compare
    rendered pictures, and are measured with --pictures only.

    Needs the extra `align`, and with --pictures the extra `render`.
    """
    first, second = load_mesh(original), load_mesh(distorted)
    metrics = distortion.metrics_of(first, second) + distortion.RENDERED * pictures
    current().doing(f"comparing {original} and {distorted} by {', '.join(metrics)}")
    compared = distortion.compare(first, second, metrics)._asdict()
    values = {name: compared[name] for name in metrics}
    lines = [
        f"{name:<14} {'needs the same connectivity' if value is None else f'{value:.6g}'}"
        for name, value in values.items()
    ]
    answer(as_json, values, *lines)


@cli.command(name="capacity")
@click.argument("mesh", type=FILE)
@budget_options(
    noise=NOISE,
    noise_help="Noise that the message must survive: half width of the uniform noise, relative to the mean distance of"
    " vertices to the centre.",
)
@click.option(
    "--coverage",
    type=float,
    default=COVERAGE,
    show_default=True,
    help="Fraction of the vertices that remains after cropping.",
)
@click.option(
    "--scheme",
    type=click.Choice(NAMES),
    default=DEFAULT_SCHEME,
    show_default=True,
    help="Scheme that carries the bits.",
)
@QUIET
@JSON
def capacity_command(mesh: Path, budget: Budget, coverage: float, scheme: str, as_json: bool) -> None:
    """Compute the largest payload, in bits, that MESH carries so that it survives noise and the loss of vertices.

    The meshes of a file are marked one by one, so the payload is that of the mesh that carries most. All objects of an
    OBJ file count as one mesh.
    """
    scene = load_scene(mesh)
    # The objects of an OBJ file may also be marked as one mesh, which carries most.
    is_one = len(scene.meshes) + len(scene.skipped) == 1 or mesh.suffix.lower() == ".obj"
    meshes = {"": load_mesh(mesh)} if is_one else scene.meshes
    each = {}
    for name, part in meshes.items():
        current().doing(f"computing the capacity of {name or mesh}")
        try:
            each[name] = capacity(part, budget, coverage=coverage, scheme=scheme)
        except JaxmarkError:
            if len(meshes) == 1:
                raise
            each[name] = 0  # as `embed` leaves such a mesh unchanged
    most = max(each, key=lambda name: each[name])
    bits, bounds, noise = each[most], budget.bounds(meshes[most]), budget.noise
    values = {"bits": bits, "budget": bounds.rms, "limits": bounds.limits, "noise": noise, "coverage": coverage}
    text = f"{bits} bits at {bounds}, noise {noise:g}, coverage {coverage:g}"
    if len(meshes) > 1:
        values["meshes"] = each
        text += f"; of {len(each)} meshes, which `embed` marks one by one, {most!r} carries most"
    answer(as_json, values, text if bits else f"{text}; `embed` without --noise prints the noise that a mark survives")


@cli.command()
@click.argument("mesh", type=FILE, required=False)
@click.option("--output", type=FILE, default=Path("demo-output"), show_default=True, help="Folder for the results.")
@QUIET
@JSON
def demo(mesh: Path | None, output: Path, as_json: bool) -> None:
    """Mark MESH with each non-blind scheme, attack the marked meshes, and read them.

    Without MESH, a sample mesh is used. Writes the marked meshes with their records, a table and pictures to the
    folder --output. Needs the extra `plot`, and for the sample mesh the extra `attacks`.
    """
    from jaxmark.app.demo import run_demo, verdict

    rows = run_demo(mesh, output, partial(say, err=as_json), current().doing)
    if as_json:
        answer(True, {"output": str(output), "rows": [row._asdict() for row in rows], "verdict": verdict(rows)})


@cli.command(name="study")
@click.argument("file", type=FILE)
@click.option("--output", type=FILE, default=Path("study-output"), show_default=True, help="Folder for the results.")
@click.option("--workers", type=click.IntRange(1), default=1, show_default=True, help="Number of processes.")
@QUIET
@JSON
def study_command(file: Path, output: Path, workers: int, as_json: bool) -> None:
    """Run the robustness study that a TOML FILE declares, with confidence intervals and controls.

    \b
      samples = 5
      schemes = ["keyed", "host"]
      payloads = [64]
      budgets = [0.0008, "hidden", {dame = 0.008}]
      [meshes]
      model = "model.ply"
      [attacks]
      noise = [0.001, 0.005]
      smoothing = [10, 50]

    Only meshes and attacks are required; paths of meshes are relative to the folder of FILE. Writes results.jsonl,
    results.csv and rates.md. If the command is run again, it resumes from results.jsonl. With the extra `plot`, it also
    writes study.html, a single page with all results, and the pictures read.png, log10_p.png and
    log10_p_unfloored.png. The last picture shows the evidence without the floor of log10 p at -77.
    """  # noqa: D301
    study = load_study(file)
    output.mkdir(parents=True, exist_ok=True)
    current().doing(f"study {file}")
    results = study.run(output / "results.jsonl", workers, current().doing)
    results.save_csv(output / "results.csv")
    table = results.markdown()
    write_atomically(output / "rates.md", table.encode())
    try:
        for module in ("matplotlib", "jinja2"):
            require(module, "plot")
    except JaxmarkError as error:
        say(f"No page and no pictures are written: {error}")
    else:
        current().doing("drawing pictures")
        for measure in get_args(Measure):
            results.plot(measure).save(output / f"{measure}.png")
        results.save_page(output / "study.html")
    values = {"output": str(output), "readings": len(results.rows), "rates": results.rates()}
    answer(as_json, values, *table.rstrip().split("\n"))


@cli.command(name="unpose")
@click.argument("suspect", type=FILE)
@click.argument("original", type=FILE)
@click.argument("target", metavar="OUT", type=FILE)
@QUIET
@JSON
def unpose_command(suspect: Path, original: Path, target: Path, as_json: bool) -> None:
    """Transform SUSPECT, which is posed by the skeleton of ORIGINAL, to the pose in which ORIGINAL is stored.

    Needs ORIGINAL as an unmarked GLB or glTF file with a skin, and SUSPECT with its vertices in the order of ORIGINAL.
    Writes OUT, the file SUSPECT with other positions, which `jaxmark detect` reads.
    """
    check_suffix(suspect, target)
    check_distinct(SUSPECT=suspect, ORIGINAL=original, OUT=target)
    current().doing(f"removing the pose of {suspect}")
    unposed = unpose(load_mesh(original), load_skin(original), load_mesh(suspect))
    with replacing(target) as draft:
        save_mesh(unposed, draft, like=suspect)
    values = {"vertices": len(unposed.vertices), "output": str(target)}
    answer(as_json, values, f"{suspect} in the pose of {original} → {target}")


for command in (bench_command, bench_equal_command, bench_corpus_command, catalogue_group, mark_for_command):
    cli.add_command(command)
catalogue_group.add_command(serve_command)


def main() -> None:
    """Run the command line; for refused input, print one sentence and end with exit status 2."""
    end_by_exception()
    try:
        cli(standalone_mode=False)
    except click.exceptions.Exit as end:
        sys.exit(end.exit_code)
    except click.Abort:
        _refuse("Interrupted.")
    except Exception as error:  # status 1 would say "nothing detected"
        _refuse(error_text(error))


def _refuse(sentence: str) -> NoReturn:
    say(f"jaxmark: {sentence}")
    sys.exit(2)


def _each(folder: Path, as_json: bool, work: Work, workers: int) -> NoReturn:
    """Process the mesh files of a folder, print a line for each, and exit with the worst status of all."""
    files, status, start = mesh_files(folder), Status.DONE, time.monotonic()
    current().doing(f"0/{len(files)} files of {folder}")
    with closing(each(files, work, workers)) as results:
        for done, (file, outcome) in enumerate(results, 1):
            status = Status.worst([status, outcome.status])
            first, *others = outcome.lines
            answer(as_json, {"file": file.name, **outcome.values}, f"{file.name}: {first}", *others)
            pace = (time.monotonic() - start) / done
            current().doing(f"{done}/{len(files)} files of {folder}, {left_over((len(files) - done) * pace)}")
    sys.exit(status)


def _mark_member(mark: Callable[..., FileOutcome], folder: Path, file: Path) -> FileOutcome:
    """Mark a file, and write the marked file and its record to a folder."""
    return mark(file, folder / file.name, folder / (file.name + RECORD_SUFFIX))


def _read_member(
    reader: FileReader,
    original: Path | None,
    record: Path | None,
    report: Path | None,
    dossier: Path | None,
    file: Path,
) -> FileOutcome:
    """Read one suspect file of a folder.

    Original and record may be folders, with files of the same names, or one file for all suspects.
    """
    return reader.read(
        file,
        None if original is None else _member(original, file.name),
        None if record is None else _member(record, file.name + RECORD_SUFFIX),
        None if report is None else report / file.name,
        None if dossier is None else dossier / file.name,
    )


def _member(path: Path, name: str) -> Path:
    """Return the path, or the file of the given name in it if the path is a folder."""
    return path / name if path.is_dir() else path
