"""The command line: files in, files and one answer out.

Exit status 0: done, or detected. 1: `detect` found nothing, or `identify` nobody. 2: refused, with one sentence on
standard error and no output file. With --json, standard output holds exactly one JSON object. For a folder, there is a
line, or such an object, for each file, and the exit status is the worst of theirs.
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
    QUIET,
    WORKERS,
    Schemes,
    budget_options,
    message_options,
    read_key,
)
from jaxmark.app.output import FileOutcome, answer, check_distinct, check_suffix, error_text, power, say
from jaxmark.app.process import end_by_exception
from jaxmark.app.progress import current
from jaxmark.app.read_files import FileReader
from jaxmark.app.serving import serve_command
from jaxmark.errors import JaxmarkError, require
from jaxmark.evaluation.cells import left_over
from jaxmark.evaluation.pictures import Measure
from jaxmark.evaluation.study import load_study
from jaxmark.files import load_mesh, load_scene, load_skin, save_mesh, save_scene
from jaxmark.files.atomic import replacing, write_atomically
from jaxmark.geometry import unpose
from jaxmark.geometry.mesh import same_connectivity
from jaxmark.watermark.coding.keys import commitment, new_key, save_key
from jaxmark.watermark.coding.message import DEFAULT_BITS
from jaxmark.watermark.everyday import capacity
from jaxmark.watermark.perception.budget import Budget
from jaxmark.watermark.perception.capacity import COVERAGE, NOISE
from jaxmark.watermark.record import RECORD_SUFFIX, Record, TimestampedCommitment, load_record, make_commitment
from jaxmark.watermark.schemes.registry import BLIND_SCHEMES, DEFAULT_SCHEME, NAMES
from jaxmark.watermark.tracing.tracer import identify


@click.group(
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog="Exit status: 0 done or detected, 1 nothing detected, 2 refused. Compiled programs are kept in"
    " ~/.cache/jaxmark for the next command; JAX_ENABLE_COMPILATION_CACHE=false keeps none.",
)
@click.version_option(package_name="jaxmark", prog_name="jaxmark")
def cli() -> None:
    """Hide a keyed message in the vertex positions of a mesh, and read it again from a suspect.

    \b
    A first round:
      jaxmark keygen owner.key
      jaxmark embed model.ply marked.ply --key owner.key --message 0123456789abcdef
      jaxmark attack marked.ply suspect.ply noise 0.001
      jaxmark detect suspect.ply --original model.ply --key owner.key

    Meshes are OBJ, PLY, OFF, STL, GLB, glTF or 3MF; point clouds PLY, XYZ, LAS or LAZ, too. Keep the key secret, and
    keep the original: detection needs both, but for marks of `field` and `local`.
    """  # noqa: D301


@cli.command()
@click.argument("keyfile", type=FILE)
@JSON
def keygen(keyfile: Path, as_json: bool) -> None:
    """Make a key of 256 random bits in a new file that only you can read.

    The file is never overwritten, and there is no copy: without it a mark can be neither read nor proven.
    """
    key = new_key()
    save_key(key, keyfile)
    answer(as_json, {"key_file": str(keyfile), "commitment": commitment(key)}, f"key → {keyfile}")


@cli.command(name="embed")
@click.argument("original", type=FILE)
@click.argument("marked", type=FILE)
@KEY
@message_options(
    "Hexadecimal digits; 16 of them are 64 bits.",
    "The message as text instead, in UTF-8: 8 bits for most letters.",
    "Instead of a message: say nothing but that the mark is there.",
)
@click.option("--recipient", help="Instead of a message: the recipient of this copy, for `jaxmark identify`.")
@budget_options(
    noise_help="Noise that the message must survive with half of the vertices lost: half width, relative to the mean"
    " distance of vertices to the centre.  [default: none; what it survives is told]"
)
@MESHES
@click.option(
    "--scheme",
    "schemes",
    type=Schemes(),
    default=DEFAULT_SCHEME,
    show_default=True,
    help=f"Scheme that carries the bits, of {', '.join(NAMES)}; marks of `field` and `local` are read without the"
    " original. Several with commas between, such as keyed,field, mark for both.",
)
@click.option("--record", "record_file", type=FILE, help=f"File for the record.  [default: MARKED{RECORD_SUFFIX}]")
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
    record_file: Path | None,
    workers: int,
    as_json: bool,
) -> None:
    """Mark ORIGINAL and write MARKED, of the same format; or every mesh file of a folder into another folder.

    Only positions change (and normals, where the file has them); materials, colours, groups and comments stay byte by
    byte. A record is written beside MARKED: it holds no secret, and with it nothing about the mark needs remembering.

    Of a file of several meshes, all are marked that can carry the message; the others are left alone and named.

    For a folder, each file gets a line of output, and a refused file does not stop the others.
    """
    if presence and message is not None:
        raise JaxmarkError("Give either --message or --presence.")
    mark = partial(
        mark_file,
        message=b"" if presence else message,
        recipient=recipient,
        budget=budget,
        scheme=schemes[0] if len(schemes) == 1 else schemes,
        meshes=meshes,
    )
    check_distinct(original=original, marked=marked)
    if not original.is_dir():
        record_file = record_file or marked.with_name(marked.name + RECORD_SUFFIX)
        check_suffix(original, marked)
        check_distinct(original=original, marked=marked, key=key_file, record=record_file)
        outcome = mark(original, marked, record_file, key=read_key(key_file), doing=current().doing)
        return answer(as_json, outcome.values, outcome.text)
    if record_file is not None:
        raise JaxmarkError("Each file of a folder has a record beside it; leave out --record.")
    work = partial(_mark_member, partial(mark, key=read_key(key_file)), marked)
    mesh_files(original)  # refuses a folder without any before another is made
    marked.mkdir(parents=True, exist_ok=True)
    _each(original, as_json, work, workers)


@cli.command(name="detect")
@click.argument("suspect", type=FILE)
@click.option("--original", type=FILE, help="The unmarked mesh; marks of `field` and `local` are read without it.")
@KEY
@click.option("--bits", type=int, help=f"Payload, a multiple of 8.  [default: the record's, else {DEFAULT_BITS}]")
@message_options(
    "A message that you claim is there; it can be proven even where it cannot be read.",
    "The claimed message as text instead.",
    "Claim that a presence mark is there; its record says so, too.",
)
@click.option(
    "--record",
    "record_file",
    type=FILE,
    help="The mark's record, which gives scheme and payload, and binds key and original.",
)
@MESHES
@click.option(
    "--scheme",
    "schemes",
    type=Schemes(),
    help="Without a record: scheme that carries the bits; several as in `embed`, to unite what they prove."
    f"  [default: {DEFAULT_SCHEME}, without --original any blind one]",
)
@ALIGN
@click.option(
    "--commitment", "commitment_file", type=FILE, help="Timestamped commitment to the record, from `jaxmark commit`."
)
@click.option("--obtained", default="", help="When and where SUSPECT was got, for the dossier.")
@click.option("--report", type=FILE, help="Folder for a picture of how SUSPECT was aligned (needs the extra `plot`).")
@click.option("--dossier", type=FILE, help="Folder for a page that shows a detection to others (extra `plot`).")
@click.option("--charges", is_flag=True, help="Say what each choice of the reading cost, too.")
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
    """Look for a mark in SUSPECT: a file in any pose, with the original's connectivity or not; or a folder of files.

    Exit status 0 if the false-positive probability is at most --alpha, else 1. The probability holds for any suspect
    made without the key, as long as key, original, record and a claimed message were fixed before it existed. A second
    figure is for claims that nothing dates; a deposit dates them.

    Of files of several meshes, each mesh is compared with the one that looks like it, and what all of them prove is
    united.

    Without --original, marks of the schemes `field` and `local` are read.

    With its record, an original will do as you have it now: saved again in another format, rounded, moved, reordered.

    For a folder, each file gets a line of output, and the exit status is the worst of all. --original and --record may
    then be folders, too, with files of the same names.
    """
    if commitment_file is not None and record_file is None:
        raise JaxmarkError("A commitment applies to a record: give the --record that is in it, too.")
    if presence and (message is not None or bits):
        raise JaxmarkError("A presence mark has no message; leave out --message and --bits, or --presence.")
    named = schemes or ()
    blind = [name for name in named if name in BLIND_SCHEMES]
    if original is None or len(named) == len(blind) == 1:
        if named and not blind:
            raise JaxmarkError(f"The scheme {named[0]!r} is read beside the original; give --original.")
        if align != "auto" or report is not None or dossier is not None:
            raise JaxmarkError("--align, --report and --dossier are for reading beside the original; give --original.")
        original = None
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
    answer(as_json, outcome.values, outcome.text)
    sys.exit(0 if outcome.done else 1)


@cli.command(name="identify")
@click.argument("suspect", type=FILE)
@click.option("--original", type=FILE, help="The unmarked mesh.")
@KEY
@click.option("--recipients", type=FILE, help="Text file with the recipients of copies, one identifier per line.")
@click.option(
    "--catalogue", "catalogue_file", type=FILE, help="Catalogue that knows originals and recipients, in place of both."
)
@click.option("--record", "record_file", type=FILE, help="The record of a copy, which binds key and original.")
@click.option(
    "--top", type=click.IntRange(1), default=10, show_default=True, help="Number of recipients in the ranking."
)
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
    top: int,
    align: Align,
    alpha: float,
    as_json: bool,
) -> None:
    """Name the recipients whose copies SUSPECT was made from.

    Exit status 0 if somebody is accused: if the probability that any innocent recipient scores so high is at most
    --alpha; else 1.
    """
    if not 0 < alpha < 1:
        raise JaxmarkError(f"alpha is a probability and must be in (0, 1), got {alpha:g}.")
    if catalogue_file is not None:
        if original is not None or recipients is not None or record_file is not None:
            raise JaxmarkError("A catalogue knows originals, recipients and records; leave those out.")
        identify_by_catalogue(suspect, catalogue_file, key_file, align, alpha, as_json)
    if original is None or recipients is None:
        raise JaxmarkError("Give --original and --recipients, or a --catalogue that knows them.")
    try:
        names = [line for line in recipients.read_text(encoding="utf-8").splitlines() if line]
    except UnicodeDecodeError:
        raise JaxmarkError(f"{recipients} is no text in UTF-8; give one identifier a line.") from None
    if not names:
        raise JaxmarkError(f"{recipients} names nobody; give one identifier a line.")
    record = None if record_file is None else Record.load(record_file)
    key = read_key(key_file)
    current().doing(f"reading {suspect} and {original}")
    meshes = load_mesh(suspect), load_mesh(original)
    current().doing(f"looking for the copies of {len(names)} recipients in {suspect}")
    found = identify(meshes[0], names, original=meshes[1], key=key, record=record, top=top, align=align)
    accused = [one for one in found if one.log10_p <= math.log10(alpha)]
    values = {
        "accused": [one.recipient for one in accused],
        "ranking": [one._asdict() for one in found],
        "recipients": len(names),
    }
    lines = [
        f"{one.recipient}: score {one.score:.1f}, probability "
        + (f"about {power(one.log10_p)}, an estimate: {'; '.join(one.caveats)}" if one.caveats else "")
        + ("" if one.caveats else f"at most {power(one.log10_p)}")
        for one in accused
    ]
    answer(as_json, values, "\n".join(lines) or f"nobody of {len(names)} is accused (--alpha {alpha:g})")
    sys.exit(0 if accused else 1)


@cli.command(name="commit")
@click.argument("records", type=FILE, nargs=-1, required=True)
@click.option(
    "--output", type=FILE, required=True, help="File for the commitment; a timestamp request is written next to it."
)
@JSON
def commit_command(records: tuple[Path, ...], output: Path, as_json: bool) -> None:
    """Make a deposit of RECORDS, to be dated before anybody claims anything; it shows nothing of what they commit to.

    Publish its root, sign a commit with it, print it; or send OUTPUT.tsq to a time-stamping authority (RFC 3161) and
    keep the answer. `jaxmark detect --commitment OUTPUT` then counts a dated claim in full, less log10 of their number.
    """
    check_distinct(output=output, **{f"record {place}": path for place, path in enumerate(records)})
    found = make_commitment(load_record(path).digest() for path in records)
    request = output.with_name(output.name + ".tsq")
    with replacing(request) as draft:
        write_atomically(draft, found.timestamp_request())
        write_atomically(output, found.to_json().encode())
    values = {"root": found.root, "records": len(found.digests), "commitment": str(output), "request": str(request)}
    size = f"{len(found.digests)} record{'s' if len(found.digests) > 1 else ''}"
    answer(as_json, values, f"{size} → {output}, root {found.root}, request → {request}")


# click keeps the lines of a paragraph that starts with \b.
_KINDS = "\n".join(["\b", "KIND, and what STRENGTH is:", *(f"{name}: {entry.unit}" for name, entry in ATTACKS.items())])


@cli.command(name="attack", epilog=_KINDS)
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
    """Apply one attack or several to a mesh, to see what a mark survives.

    OUT is the file IN with other positions, or a new file if faces change. The RMS displacement is printed if the
    connectivity stays.
    """
    steps = _steps(words)
    check_suffix(source, target)
    check_distinct(IN=source, OUT=target)
    current().doing(f"attacking {source}: {' '.join(words)}")
    scene = load_scene(source)
    if (
        len(scene.meshes) + len(scene.skipped) > 1 and source.suffix.lower() != ".obj"
    ):  # whose objects lie in the same coordinates
        return _attack_scene(source, target, steps, seed, as_json)
    mesh = load_mesh(source)
    with replacing(target) as draft:
        attacked = chain(mesh, steps, seed=seed)
        same = same_connectivity(mesh, attacked)
        save_mesh(attacked, draft, like=source if same else None)
        change = distortion.displacement_size(mesh, load_mesh(draft))._asdict() if same else {"rms": None, "max": None}
    values = {"attacks": steps, "seed": seed, "vertices": len(attacked.vertices), "faces": len(attacked.faces)}
    said = " + ".join(f"{kind} {strength:g}" for kind, strength in steps)
    size = f"{len(attacked.vertices)} vertices and {len(attacked.faces)} faces"
    how = f"RMS {change['rms']:.3g} of the diagonal" if same else f"a mesh of {size}"
    answer(as_json, {**values, **change}, f"{said} → {target}, {how}")


def _attack_scene(source: Path, target: Path, steps: list[tuple[str, float]], seed: int, as_json: bool) -> None:
    """Attack each mesh of a file; they keep their connectivity, as their file has it."""
    scene = load_scene(source)
    meshes = scene.meshes
    attacked = {name: chain(mesh, steps, seed=seed) for name, mesh in meshes.items()}
    said = " + ".join(f"{kind} {strength:g}" for kind, strength in steps)
    for name, mesh in meshes.items():
        if not same_connectivity(mesh, attacked[name]):
            raise JaxmarkError(f"{said} changes faces, which a file of several meshes keeps; save them apart.")
    with replacing(target) as draft:
        save_scene(attacked, draft, like=source)
        after = load_scene(draft).meshes
    sizes = {name: distortion.displacement_size(mesh, after[name])._asdict() for name, mesh in meshes.items()}
    values = {"attacks": steps, "seed": seed, "meshes": sizes, "skipped": scene.skipped}
    largest = max(one["rms"] for one in sizes.values())
    lines = [f"{said} → {target}, {len(meshes)} meshes, RMS up to {largest:.3g} of their diagonals"]
    lines += [f"left alone: {name!r}: {reason}" for name, reason in scene.skipped.items()]
    answer(as_json, values, "\n".join(lines))


def _steps(words: tuple[str, ...]) -> list[tuple[str, float]]:
    """Parse alternating names and strengths."""
    kinds, strengths = words[::2], words[1::2]
    for kind in kinds:
        get_attack(kind)
    if len(kinds) != len(strengths):
        raise JaxmarkError(f"Give the strength of {kinds[-1]}, too: {get_attack(kinds[-1]).unit}.")
    try:
        return [(kind, float(strength)) for kind, strength in zip(kinds, strengths, strict=True)]
    except ValueError as error:
        raise JaxmarkError(f"A strength is a number: {error}.") from None


@cli.command()
@click.argument("original", type=FILE)
@click.argument("distorted", type=FILE)
@click.option("--pictures", is_flag=True, help="Compare pictures of the meshes, too; takes many seconds.")
@QUIET
@JSON
def compare(original: Path, distorted: Path, pictures: bool, as_json: bool) -> None:
    """Measure how DISTORTED differs from ORIGINAL, by all metrics.

    rms, max, mrms, hausdorff and gl are relative to the original's bounding-box diagonal, dame is in radians, shading
    in just noticeable differences, point_to_plane in distances of nearest points; the others lie between 0 and 1. Of
    point clouds, only rms, max and point_to_plane are known. flip and ssim compare pictures, which takes many
    seconds, and are left out without --pictures. Needs the extra `align`, with --pictures `render`.
    """
    first, second = load_mesh(original), load_mesh(distorted)
    metrics = distortion.metrics_of(first, second) + distortion.RENDERED * pictures
    current().doing(f"comparing {original} and {distorted} by {', '.join(metrics)}")
    compared = distortion.compare(first, second, metrics)._asdict()
    found = {name: compared[name] for name in metrics}
    lines = [
        f"{name:<14} {'needs the same connectivity' if value is None else f'{value:.6g}'}"
        for name, value in found.items()
    ]
    answer(as_json, found, "\n".join(lines))


@cli.command(name="capacity")
@click.argument("mesh", type=FILE)
@budget_options(
    noise=NOISE,
    noise_help="Noise that the message must survive: half width, relative to the mean distance of vertices to the"
    " centre.",
)
@click.option(
    "--coverage", type=float, default=COVERAGE, show_default=True, help="Share of the vertices that may be left."
)
@click.option(
    "--scheme", type=click.Choice(NAMES), default=DEFAULT_SCHEME, show_default=True, help="Scheme that carries them."
)
@QUIET
@JSON
def capacity_command(mesh: Path, budget: Budget, coverage: float, scheme: str, as_json: bool) -> None:
    """Say how many bits can be hidden in MESH so that they survive noise and the loss of vertices."""
    loaded = load_mesh(mesh)
    bounds, noise = budget.bounds(loaded), budget.noise
    current().doing(f"measuring the room in {mesh}")
    bits = capacity(loaded, budget, coverage=coverage, scheme=scheme)
    values = {"bits": bits, "budget": bounds.rms, "limits": bounds.limits, "noise": noise, "coverage": coverage}
    said = f"{bits} bits at {bounds}, noise {noise:g}, coverage {coverage:g}"
    answer(as_json, values, said if bits else f"{said}; `embed` says what less a mark in it survives")


@cli.command()
@click.argument("mesh", type=FILE, required=False)
@click.option("--output", type=FILE, default=Path("demo-output"), show_default=True, help="Folder for the results.")
@QUIET
@JSON
def demo(mesh: Path | None, output: Path, as_json: bool) -> None:
    """Mark MESH, attack it, read it again, and write tables and pictures. Without MESH, a sample is used.

    Needs the extra `plot`, and `attacks` for the sample.
    """
    from jaxmark.app.demo import run_demo, verdict

    rows = run_demo(mesh, output, partial(say, err=as_json), current().doing)
    if as_json:
        answer(True, {"output": str(output), "rows": [row._asdict() for row in rows], "verdict": verdict(rows)}, "")


@cli.command(name="study")
@click.argument("file", type=FILE)
@click.option("--output", type=FILE, default=Path("study-output"), show_default=True, help="Folder for the results.")
@click.option("--workers", type=click.IntRange(1), default=1, show_default=True, help="Number of processes.")
@QUIET
@JSON
def study_command(file: Path, output: Path, workers: int, as_json: bool) -> None:
    """Run the study that a TOML FILE declares: what marks survive, with intervals and controls.

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

    Only meshes, with paths relative to the folder of FILE, and attacks are required. The command writes results.jsonl,
    from which it resumes when run again, results.csv, rates.md and, with the extra `plot`, study.html, one page of
    all to look at or to hand on, and its pictures: read.png, log10_p.png and log10_p_unfloored.png, where the evidence
    goes on below the floor at -77.
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
        say(f"No page, no pictures: {error}")
    else:
        current().doing("drawing pictures")
        for of in get_args(Measure):
            results.plot(of).save(output / f"{of}.png")
        results.save_page(output / "study.html")
    answer(as_json, {"output": str(output), "readings": len(results.rows), "rates": results.rates()}, table.rstrip())


@cli.command(name="unpose")
@click.argument("suspect", type=FILE)
@click.argument("original", type=FILE)
@click.argument("target", metavar="OUT", type=FILE)
@QUIET
@JSON
def unpose_command(suspect: Path, original: Path, target: Path, as_json: bool) -> None:
    """Bring SUSPECT, in any pose of the skeleton of ORIGINAL, back to the pose in which ORIGINAL is stored.

    ORIGINAL is a GLB or glTF file with a skin, as it is, unmarked; SUSPECT has its vertices in its order. OUT is the
    file SUSPECT with other positions, which `jaxmark detect` reads.
    """
    check_suffix(suspect, target)
    check_distinct(SUSPECT=suspect, ORIGINAL=original, OUT=target)
    current().doing(f"bringing {suspect} back")
    back = unpose(load_mesh(original), load_skin(original), load_mesh(suspect))
    with replacing(target) as draft:
        save_mesh(back, draft, like=suspect)
    answer(as_json, {"vertices": len(back.vertices), "output": str(target)}, f"{suspect} as {original} lies → {target}")


for command in (bench_command, bench_equal_command, bench_corpus_command, catalogue_group, mark_for_command):
    cli.add_command(command)
catalogue_group.add_command(serve_command)


def main() -> None:
    """Run the command line; refused input ends with exit status 2 and one sentence."""
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
    click.echo(f"jaxmark: {sentence}", err=True)
    sys.exit(2)


def _each(folder: Path, as_json: bool, work: Work, workers: int) -> NoReturn:
    """Work on the mesh files of a folder, print a line for each, and exit with the worst status."""
    files, status, start = mesh_files(folder), 0, time.monotonic()
    current().doing(f"0/{len(files)} files of {folder}")
    with closing(each(files, work, workers)) as results:
        for done, (file, one) in enumerate(results, 1):
            status = max(status, 2 if one.refused else 0 if one.done else 1)
            answer(as_json, {"file": file.name, **one.values}, f"{file.name}: {one.text}")
            pace = (time.monotonic() - start) / done
            current().doing(f"{done}/{len(files)} files of {folder}, {left_over((len(files) - done) * pace)}")
    sys.exit(status)


def _mark_member(mark: Callable[..., FileOutcome], folder: Path, file: Path) -> FileOutcome:
    """Mark a file of a folder into another."""
    return mark(file, folder / file.name, folder / (file.name + RECORD_SUFFIX))


def _read_member(
    reader: FileReader,
    original: Path | None,
    record: Path | None,
    report: Path | None,
    dossier: Path | None,
    file: Path,
) -> FileOutcome:
    """Read a file of a folder, with a folder each for originals, records, reports and dossiers, or one file for all."""
    return reader.read(
        file,
        None if original is None else _member(original, file.name),
        None if record is None else _member(record, file.name + RECORD_SUFFIX),
        None if report is None else report / file.name,
        None if dossier is None else dossier / file.name,
    )


def _member(path: Path, name: str) -> Path:
    """The path itself, or the file of that name in it if it is a folder."""
    return path / name if path.is_dir() else path
