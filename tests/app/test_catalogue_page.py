"""The catalogue's page in a browser: Chromium, driven by Selenium; skipped by name where one of them is absent."""

import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import jaxmark as jm
from tests.samples import rough_sphere

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("unchecked")]
OPTIONS = (
    *("headless", "no-sandbox", "disable-gpu", "disable-quic", "no-first-run", "disable-background-networking"),
    *("disable-component-update", "disable-sync", "window-size=1000,900"),
)
MOST_SECONDS = 120


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[Any]:
    selenium = pytest.importorskip("selenium.webdriver")
    programs = {name: shutil.which(name) for name in ("chromium", "chromedriver")}
    for name, path in programs.items():
        if path is None:
            pytest.skip(f"{name} is not installed")
    options = selenium.ChromeOptions()
    options.binary_location = programs["chromium"]
    for option in (*OPTIONS, f"user-data-dir={tmp_path / 'profile'}"):
        options.add_argument(f"--{option}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = selenium.Chrome(options, selenium.ChromeService(programs["chromedriver"]))
    yield driver
    driver.quit()


@pytest.fixture
def shop(tmp_path: Path, key: jm.Key) -> Iterator[str]:
    """The address of a page that shows a catalogue of two originals; a marked copy of one lies beside them."""
    meshes = {"model.obj": rough_sphere(900), "<b>odd.obj": rough_sphere(900, 1)}
    for name, mesh in meshes.items():
        jm.save_mesh(mesh, tmp_path / name)
    with jm.Catalogue(tmp_path / "shop.db") as catalogue:
        for name in meshes:
            catalogue.add(tmp_path / name)
    jm.save_mesh(jm.embed(meshes["model.obj"], b"8 bytes!", key, budget=0.004)[0], tmp_path / "suspect.obj")
    jm.watermark.save_key(key, tmp_path / "owner.key")
    words = ("catalogue", "serve", "--catalogue", "shop.db", "--key", "owner.key", "--port", "0")
    command = [sys.executable, "-m", "jaxmark", *words]
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        yield server.stdout.readline().split()[0]
        server.terminate()


def test_a_chosen_file_is_named_with_its_dossier(browser: Any, shop: str, tmp_path: Path):
    wait = pytest.importorskip("selenium.webdriver.support.ui").WebDriverWait(browser, MOST_SECONDS)

    def element(selector: str) -> Any:
        return browser.find_element("css selector", selector)

    def shows(selector: str, text: str) -> Callable[[Any], bool]:
        return lambda _: text in element(selector).text

    browser.get(shop)
    wait.until(shows("#count", "2 originals"))
    assert "<b>odd.obj: 900 vertices" in element("#originals").text
    wait.until(lambda _: browser.execute_script("return [...document.images].every((one) => one.naturalWidth > 0)"))
    element("#file").send_keys(str(tmp_path / "suspect.obj"))
    wait.until(shows("#verdict", "false-positive probability"))
    head, proof, *_ = element("#verdict").text.splitlines()
    assert head == f'suspect.obj: made from model.obj, message {b"8 bytes!".hex()} ("8 bytes!")'
    assert "at most 10-" in proof
    element("#verdict a").click()
    wait.until(lambda _: "suspect.obj" in browser.title)
    assert b"8 bytes!".hex() in element("body").text
    assert browser.get_log("browser") == []


def test_an_answer_does_not_replace_that_of_a_later_file(browser: Any, shop: str, tmp_path: Path):
    browser.get(shop)
    (tmp_path / "notes.txt").write_text("no mesh")
    for name in ("suspect.obj", "notes.txt"):
        browser.find_element("id", "file").send_keys(str(tmp_path / name))
    finished = "return performance.getEntriesByType('resource').filter((one) => one.name.includes('/find?')).length"
    wait = pytest.importorskip("selenium.webdriver.support.ui").WebDriverWait(browser, MOST_SECONDS)
    wait.until(lambda _: browser.execute_script(finished) == 2)
    assert browser.find_element("id", "verdict").text.startswith("This is not a mesh file")
