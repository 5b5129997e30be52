"""A file and its record change together or not at all."""

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest

from jaxmark.errors import JaxmarkError
from jaxmark.files import pair as pairs
from jaxmark.files.pair import writing_pair
from jaxmark.watermark.record import Record

pytestmark = pytest.mark.core
OLD, NEW = (Record("keyed", 64, 0.1, "00" * 32, "11" * 32, code=digit * 64) for digit in "ab")
FILE, RECORD = "marked.ply", "records/marked.json"


def lay(folder: Path, old_file: bool, old_record: bool) -> Path:
    (folder / "records").mkdir(parents=True)
    if old_file:
        (folder / FILE).write_bytes(b"old")
    if old_record:
        (folder / RECORD).write_text(OLD.to_json())
    return folder


def states(folder: Path, old_file: bool, old_record: bool) -> Iterator[Path]:
    """Yield the folders that processes left which were killed at each call, and last that of the one that was not."""
    lay(folder / "before", old_file, old_record)
    (folder / "new.json").write_text(NEW.to_json())
    mode = "overwrite" if old_file or old_record else "new"
    program = Path(__file__).parent / "killed_pair.py"
    subprocess.run([sys.executable, program, folder, mode, folder / "new.json"], check=True)
    count = sum(place.name.isdecimal() for place in folder.iterdir())
    assert count > 15
    yield from (folder / str(number) for number in range(count))


def complete(folder: Path, content: bytes, record: Record, prefix: str = "") -> bool:
    """Whether a pair is complete; a name with the prefix replaces the plain one."""
    file, told = (path.with_name(prefix + path.name) for path in (folder / FILE, folder / RECORD))
    return file.is_file() and file.read_bytes() == content and told.is_file() and Record.load(told) == record


def write(folder: Path, record: Record = NEW, content: bytes = b"new", overwrite: bool = False) -> Path | None:
    with writing_pair(folder / FILE, folder / RECORD, overwrite=overwrite) as pair:
        pair.file.write_bytes(content)
        pair.record.write_text(record.to_json())
    return None if pair.kept is None else Path(pair.kept)


@pytest.mark.skipif(os.name != "posix", reason="only there can a process be killed at a call")
@pytest.mark.parametrize(("old_file", "old_record"), [(False, False), (True, True), (True, False), (False, True)])
def test_a_pair_is_whole_wherever_its_writer_is_killed(tmp_path: Path, old_file: bool, old_record: bool) -> None:
    *killed, done = states(tmp_path, old_file, old_record)
    for place in (*killed, done):
        kept = [Record.load(path) for path in (place / "records").glob("*.json")]  # none is damaged
        if (place / FILE).exists():
            pairs = {b"old": OLD if old_record else None, b"new": NEW}
            expected = pairs[(place / FILE).read_bytes()]
            if expected is None:
                assert kept == []
            else:
                assert Record.load(place / RECORD) == expected
        if old_record:
            assert OLD in kept
        if old_file and old_record:
            assert (
                complete(place, b"new", NEW) or complete(place, b"old", OLD) or complete(place, b"old", OLD, "old-1-")
            )
    assert any(not (place / FILE).exists() for place in killed) or (old_file and not old_record)
    assert complete(done, b"new", NEW)
    for place in killed:  # the next command completes the pair, and clears what the killed one left
        write(place, overwrite=True)
        assert complete(place, b"new", NEW)
        assert not list(place.rglob(".jaxmark-*"))
        assert not old_record or OLD in [Record.load(path) for path in (place / "records").glob("*.json")]


def test_existing_files_are_refused_without_overwriting(tmp_path: Path) -> None:
    for number, there in enumerate([(True, True), (True, False), (False, True)]):
        folder = lay(tmp_path / str(number), *there)
        before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
        with pytest.raises(JaxmarkError, match=r"exists; give another name, or replace it by --overwrite\."):
            write(folder)
        assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


def test_a_pair_that_another_process_wrote_meanwhile_is_refused(tmp_path: Path) -> None:
    folder = lay(tmp_path / "place", False, False)

    def write_late() -> None:
        with writing_pair(folder / FILE, folder / RECORD) as pair:
            pair.file.write_bytes(b"late")
            pair.record.write_text(NEW.to_json())
            write(folder, OLD, b"first")

    with pytest.raises(JaxmarkError, match="exists"):
        write_late()
    assert complete(folder, b"first", OLD)
    assert sorted(path.name for path in folder.rglob("*") if path.is_file()) == ["marked.json", "marked.ply"]


def test_pairs_are_replaced_one_after_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = lay(tmp_path / "place", True, True)
    set_aside, inside = pairs._Old.set_aside, list[int]()

    def slowly(old: pairs._Old) -> None:
        inside.append(1)
        assert len(inside) == 1
        set_aside(old)
        time.sleep(0.05)
        inside.pop()

    monkeypatch.setattr(pairs._Old, "set_aside", slowly)
    with ThreadPoolExecutor(4) as pool:
        others = [replace(NEW, bits=8 * count) for count in range(1, 5)]
        kept = list(pool.map(lambda other: write(folder, other, b"%d" % other.bits, overwrite=True), others))
    last = next(other for other in others if b"%d" % other.bits == (folder / FILE).read_bytes())
    assert complete(folder, b"%d" % last.bits, last)
    assert len(set(kept)) == 4
    assert sorted(Record.load(path).bits for path in kept if path) == sorted(
        record.bits for record in (OLD, *others) if record != last
    )


@pytest.mark.skipif(os.name != "posix", reason="only there folders have locks")
def test_a_folder_that_stays_locked_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pairs, "_LOCK_SECONDS", 0.05)
    folder = lay(tmp_path / "place", True, True)
    (tmp_path / "other").symlink_to(folder)
    with pairs._locked({folder, tmp_path / "other"}):  # one folder with two names
        with pytest.raises(JaxmarkError, match=r"Another process has locked .*place(/records)? for 0\.05 s; end it"):
            write(folder, overwrite=True)
        assert complete(folder, b"old", OLD)
    write(folder, overwrite=True)
    assert complete(folder, b"new", NEW)


def test_replaced_records_are_kept_unless_they_are_equal(tmp_path: Path) -> None:
    folder = lay(tmp_path / "place", False, False)
    told = [write(folder, OLD, overwrite=True)]
    (folder / RECORD).chmod(0o600)
    told += [write(folder, record, overwrite=True) for record in (OLD, NEW, OLD, OLD)]
    assert [path and path.name for path in told] == [None, None, "old-1-marked.json", "old-2-marked.json", None]
    assert complete(folder, b"new", OLD)
    assert [path.name for path in folder.iterdir() if path.is_file()] == [FILE]
    kept = {path.name: Record.load(path) for path in (folder / "records").iterdir()}
    assert kept == {"marked.json": OLD, "old-1-marked.json": OLD, "old-2-marked.json": NEW}


@pytest.mark.parametrize(("old_file", "old_record"), [(False, False), (True, True), (True, False), (False, True)])
@pytest.mark.parametrize("step", range(4))
def test_an_error_leaves_the_old_pair(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, old_file: bool, old_record: bool, step: int
) -> None:
    """Errors at each step, after which the files are as they were, or the new pair is complete."""
    folder = lay(tmp_path / "place", old_file, old_record)
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    calls = 0

    def replace(self: Path, target: Path) -> Path:
        nonlocal calls
        calls += 1
        if calls == step + 1:
            raise OSError(28, "No space left on device")
        os.replace(self, target)  # noqa: PTH105
        return target

    monkeypatch.setattr(Path, "replace", replace)
    monkeypatch.setattr(Path, "rename", replace)
    try:
        write(folder, overwrite=True)
    except (JaxmarkError, OSError):
        assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before
    else:
        assert complete(folder, b"new", NEW)
        assert calls <= step
    shutil.rmtree(folder)


def test_a_device_is_not_replaced(tmp_path: Path) -> None:
    with pytest.raises(JaxmarkError, match="not an ordinary file"), writing_pair(tmp_path / "a.ply", Path(os.devnull)):
        pass
    assert not Path(os.devnull).is_file()


def test_names_that_collide_with_those_of_the_old_pair_lose_nothing(tmp_path: Path) -> None:
    file, record = tmp_path / "x.obj", tmp_path / "old-1-x.obj"
    file.write_bytes(b"old")
    with writing_pair(file, record, overwrite=True) as pair:
        pair.file.write_bytes(b"new")
        pair.record.write_text(NEW.to_json())
    assert file.read_bytes() == b"new"
    assert Record.load(record) == NEW
    with (
        pytest.raises(JaxmarkError, match="cannot be both"),
        writing_pair(record, tmp_path / "." / record.name, overwrite=True),
    ):
        pass
    assert Record.load(record) == NEW
