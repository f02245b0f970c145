"""The command serves its page for real, and Chromium uses it as a person would."""

import io as memory
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pytest
from playwright.sync_api import Locator, Page, expect, sync_playwright

from depthreg.checkpoint import write_published
from depthreg.networks import HalfResolutionNetwork

if find_spec("gradio") is None:
    pytest.skip("Gradio isn't installed: pip install 'depthreg[demo]'", allow_module_level=True)

import httpx

LONG_S = 240  # a machine may have other work


@dataclass(frozen=True)
class Served:
    """A running page."""

    url: str
    port: int
    elsewhere: tuple[Path, ...]  # the user's folders, which are none of its business
    temporary: Path


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    root = tmp_path_factory.mktemp("demo")
    weights, home, here, temporary, caches = (
        root / name for name in ("w.safetensors", "home", "here", "tmp", "caches")
    )
    for folder in (home, here, temporary, caches):
        folder.mkdir()
    # Untrained, it interpolates.
    write_published(weights, HalfResolutionNetwork((16, 16, 16), (1,), (16, 16, 16), 16, [(8, 1, 3)]), {})
    folders = {"HOME": str(home), "TMPDIR": str(temporary), "MPLCONFIGDIR": str(caches)}
    package = str(Path(__file__).parents[2])
    process = subprocess.Popen(
        [sys.executable, "-m", "depthreg", "demo", "--checkpoint", str(weights)],
        cwd=here,
        env={**os.environ, **folders, "PYTHONPATH": package, "PYTHONUNBUFFERED": "1"},
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    try:
        found = re.match(r"(http://127\.0\.0\.1:(\d+)/) shows it", process.stdout.readline())
        assert found
        yield Served(found[1], int(found[2]), (home, here), temporary)
        process.send_signal(signal.SIGTERM)
        assert process.wait(LONG_S) == 0
        assert "its files are removed" in process.stdout.read()
        assert not list(temporary.glob("depthreg-demo-*"))
    finally:
        process.kill()


@pytest.fixture(scope="module")
def page(served: Served, chromium: str) -> Iterator[Page]:
    """The page, opened; nothing may be asked of any other machine."""
    complaints: list[str] = []
    asked: list[str] = []
    with sync_playwright() as playwright:
        flags = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]  # 3D without a GPU
        browser = playwright.chromium.launch(executable_path=chromium, args=flags)
        page = browser.new_page(viewport={"width": 1300, "height": 1000})
        page.set_default_timeout(1000 * LONG_S)
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("request", lambda request: asked.append(request.url))
        page.goto(served.url)
        yield page
        browser.close()
    assert complaints == []
    assert len(asked) > 10 and all(url.startswith((served.url, "data:", "blob:")) for url in asked)


def words(page: Page) -> str:
    return page.get_by_label("What was found").input_value()


def block(page: Page, label: str) -> Locator:
    """The part of the page that shows a label."""
    return page.locator(".block").filter(has_text=label).last


def upload(page: Page, files: dict[str, tuple[str, bytes]]) -> None:
    """Drop files, each into the field whose label begins so; those that lie there go first."""
    for label, (name, content) in files.items():
        field = block(page, label)
        if field.get_by_label("Clear").count():
            field.get_by_label("Clear").first.click()
        field.locator("input[type=file]").set_input_files({"name": name, "mimeType": "", "buffer": content})
        expect(field.get_by_label(name, exact=True)).to_be_visible(timeout=1000 * LONG_S)


def png(array: np.ndarray) -> bytes:
    return cv2.imencode(".png", array)[1].tobytes()


def npy(array: np.ndarray) -> bytes:
    file = memory.BytesIO()
    np.save(file, array)
    return file.getvalue()


@pytest.mark.timeout(2 * LONG_S)
def test_an_example_gives_pictures_words_a_cloud_and_files(page: Page) -> None:
    page.get_by_label("Thumbnail 2 of 3").click()
    expect(page.get_by_label("What was found")).to_have_value(re.compile("The truth is known"), timeout=1000 * LONG_S)
    assert re.search(r"of 640x480 pixels had a depth, and now all have", words(page))
    for label in ("Depth as given", "Depth completed", "Error to expect", "True error"):
        picture = block(page, label).locator("img")
        assert picture.evaluate("async image => { await image.decode(); return image.naturalHeight; }") == 480
    slider = block(page, "Colour as given |")
    assert [image.evaluate("image => image.naturalWidth") for image in slider.locator("img").all()] == [640, 640]
    with page.expect_download() as download:
        page.locator("a[download='affine.json']").click()
    affine = json.loads(Path(download.value.path()).read_text())
    assert (affine["width"], affine["height"]) == (640, 480)


@pytest.mark.timeout(2 * LONG_S)
def test_the_cloud_fills_the_middle_of_its_window(page: Page) -> None:
    canvas = page.locator("canvas").first
    canvas.scroll_into_view_if_needed()
    page.wait_for_timeout(3000)
    shot = cv2.imdecode(np.frombuffer(canvas.screenshot(), np.uint8), cv2.IMREAD_COLOR)
    lit = shot.max(axis=2) > 40
    height, width = lit.shape
    assert lit[height // 4 : -height // 4, width // 3 : -width // 3].mean() > 0.3


@pytest.mark.timeout(2 * LONG_S)
def test_own_files_are_completed_and_bad_ones_are_one_sentence(page: Page) -> None:
    rgb = np.random.default_rng(0).integers(0, 256, (67, 91, 3), dtype=np.uint8)
    depth_m = np.full((67, 91), 3, np.float32)
    button, found = page.get_by_role("button", name="Align and complete"), page.get_by_label("What was found")
    page.get_by_label("Stored value per metre").fill("1")
    upload(page, {"Colour: PNG": ("mine.png", b"<script>no picture</script>"), "Depth, of": ("mine.npy", npy(depth_m))})
    button.click()
    expect(found).to_have_value("Mine.png can't be decoded: an intact image was expected.", timeout=1000 * LONG_S)
    upload(page, {"Colour: PNG": ("small.png", png(rgb[:66]))})
    button.click()
    expect(found).to_have_value(
        "Small.png is 91x66 but mine.npy is 91x67: one size was expected.", timeout=1000 * LONG_S
    )
    upload(page, {"Colour: PNG": ("right.png", png(rgb))})
    button.click()
    expect(found).to_have_value(re.compile("100.0 % of 91x67 pixels"), timeout=1000 * LONG_S)


def test_files_that_are_too_large_are_refused_while_they_come(served: Served) -> None:
    content = b"\0" * 53_000_000  # 50 MB are 52 428 800 bytes here
    answer = httpx.post(f"{served.url}gradio_api/upload", files={"files": ("x.npy", content)}, timeout=LONG_S)
    assert answer.status_code == 413


@pytest.mark.skipif(sys.platform != "linux", reason="reads Linux's list of sockets")
def test_only_this_machine_can_reach_it(served: Served) -> None:
    lines = [
        line.split() for name in ("tcp", "tcp6") for line in Path(f"/proc/net/{name}").read_text().splitlines()[1:]
    ]
    listening = [line[1].split(":") for line in lines if line[3] == "0A"]
    assert [address for address, port in listening if int(port, 16) == served.port] == ["0100007F"]  # 127.0.0.1


def test_it_hands_out_no_files_but_its_own_and_writes_none_elsewhere(served: Served, page: Page) -> None:
    (served.elsewhere[1] / "mine.txt").write_text("mine")
    for path in ("/etc/passwd", served.elsewhere[1] / "mine.txt"):
        assert httpx.get(f"{served.url}gradio_api/file={path}", timeout=LONG_S).status_code in (403, 404)
    (served.elsewhere[1] / "mine.txt").unlink()
    assert all(not list(folder.iterdir()) for folder in served.elsewhere)
    assert list(served.temporary.glob("depthreg-demo-*/answer-*"))
