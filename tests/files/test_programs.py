"""Compiled programs between processes, and of many meshes in one."""

import os
import stat
import subprocess
import sys
from pathlib import Path

import jax
import pytest

from jaxmark.files import programs

pytestmark = pytest.mark.core

SAY = "print(jax.config.jax_compilation_cache_dir)"
CODE = f"import jax; from jaxmark.files.programs import keep_programs; keep_programs(); {SAY}"


@pytest.fixture(autouse=True)
def _no_cache_of_the_tests(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")


def kept(home: Path, **more: str) -> str:
    """Where another process keeps programs."""
    environment = {**os.environ, "XDG_CACHE_HOME": str(home), **more}
    return subprocess.run([sys.executable, "-c", CODE], env=environment, capture_output=True, text=True).stdout.strip()


@pytest.mark.slow
def test_programs_are_kept_in_a_private_folder(tmp_path: Path):
    assert kept(tmp_path) == str(tmp_path / "jaxmark")
    assert stat.S_IMODE((tmp_path / "jaxmark").stat().st_mode) == 0o700
    assert kept(tmp_path / "none", JAX_ENABLE_COMPILATION_CACHE="false") == "None"
    assert not (tmp_path / "none").exists()
    assert kept(tmp_path, JAX_COMPILATION_CACHE_DIR=str(tmp_path / "own")) == str(tmp_path / "own")


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="only there do permissions tell")
def test_a_folder_that_others_may_write_is_not_used(tmp_path: Path):
    (tmp_path / "jaxmark").mkdir()
    (tmp_path / "jaxmark").chmod(0o777)
    assert kept(tmp_path) == "None"
    (tmp_path / "file").write_text("")
    assert kept(tmp_path / "file") == "None"


def test_the_oldest_programs_go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(programs, "_MAX_BYTES", 250)
    monkeypatch.setattr(jax.config, "update", lambda name, value: None)
    (tmp_path / "jaxmark").mkdir(mode=0o700)
    for age in range(4):
        (tmp_path / "jaxmark" / str(age)).write_bytes(bytes(100))
        os.utime(tmp_path / "jaxmark" / str(age), (1e9 - age, 1e9 - age))
    programs.keep_programs()
    assert sorted(file.name for file in (tmp_path / "jaxmark").iterdir()) == ["0", "1"]


@pytest.mark.parametrize(("most", "cleared"), [(10**9, False), (10, True)])
def test_a_process_lets_go_before_it_is_full(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, most, cleared):
    (tmp_path / "most").write_text(str(most))
    (tmp_path / "maps").write_text(20 * "a map\n")
    monkeypatch.setattr(programs, "_MOST", tmp_path / "most")
    monkeypatch.setattr(programs, "_MAPS", tmp_path / "maps")
    called = []
    monkeypatch.setattr(jax, "clear_caches", lambda: called.append(True))
    programs.release_programs()
    assert bool(called) == cleared
    monkeypatch.setattr(programs, "_MOST", tmp_path / "absent")
    programs.release_programs()
    assert bool(called) == cleared
