"""What commands say while they work: on a terminal, and nowhere else."""

import io
import sys

import jax
import jax.numpy as jnp
import pytest

from jaxmark.app.progress import Progress
from jaxmark.evaluation.cells import left_over
from tests.app.test_cli import DETECT, Workshop

pytestmark = pytest.mark.usefixtures("unchecked")


class Terminal(io.StringIO):
    """A stream that says it is a terminal."""

    def isatty(self) -> bool:
        return True

    def shown(self) -> list[str]:
        """All that a line was, one after the other."""
        return [line.partition("\x1b[K")[0] for line in self.getvalue().split("\r")[1:]]


@pytest.fixture
def workshop(tmp_path, monkeypatch, capfd) -> Workshop:
    return Workshop(tmp_path, monkeypatch, capfd)


def test_a_line_is_replaced_and_removed():
    terminal = Terminal()
    progress = Progress(terminal)
    progress.doing("one")
    progress.doing("two " + 500 * "x")
    progress.clear()
    progress.clear()
    first, second, last = terminal.shown()
    assert first == "one"
    assert second.startswith("two x")
    assert len(second) < 300
    assert last == ""


def test_compiling_is_said(tmp_path, monkeypatch):
    terminal = Terminal()
    progress = Progress(terminal)
    kept = jax.config.jax_compilation_cache_dir  # pyright: ignore[reportAttributeAccessIssue]
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    try:
        progress.doing("adding")
        jax.jit(lambda x: jnp.sin(x) + 4321)(jnp.ones(7)).block_until_ready()
        progress.clear()
        jax.jit(lambda x: jnp.cos(x) + 4321)(jnp.ones(7)).block_until_ready()
    finally:
        jax.config.update("jax_compilation_cache_dir", kept)
    assert "adding: compiling program 1" in terminal.shown()
    assert terminal.shown()[-1] == ""


def test_nothing_is_said_without_a_terminal(workshop: Workshop):
    code, _, err = workshop("attack", "model.ply", "suspect.ply", "noise", 0.001)
    assert (code, err) == (0, "")


@pytest.mark.slow
@pytest.mark.parametrize("quiet", [False, True])
def test_commands_say_what_they_do(workshop: Workshop, monkeypatch, quiet: bool):
    more = ["--quiet"] if quiet else []
    for command, said in (
        (["embed", "model.ply", "marked.ply", "--key", "owner.key", "--text", "hi"], "embedding model.ply"),
        (["attack", "marked.ply", "suspect.ply", "noise", 0.001], "attacking marked.ply: noise 0.001"),
        (["detect", "suspect.ply", *DETECT, "--bits", 16], "aligning suspect.ply and reading it"),
    ):
        terminal = Terminal()
        monkeypatch.setattr(sys, "stderr", terminal)
        code, out, _ = workshop(*command, *more)
        assert code == 0
        assert "\r" not in out
        assert any(line.startswith(said) for line in terminal.shown()) != quiet
        assert terminal.getvalue() == "" if quiet else terminal.shown()[-1] == ""


def test_refusals_have_a_line_of_their_own(workshop: Workshop, monkeypatch):
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    code, _, _ = workshop("capacity", "absent.ply")
    assert code == 2
    assert terminal.getvalue().rpartition("\x1b[K")[2].startswith("jaxmark: ")


def test_time_that_is_left():
    assert [left_over(seconds) for seconds in (0.4, 40, 119, 120, 7199, 9000)] == [
        *("about 0 s left", "about 40 s left", "about 119 s left", "about 2 min left"),
        *("about 120 min left", "about 2 h left"),
    ]
