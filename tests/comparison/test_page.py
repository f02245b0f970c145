"""The page in a real browser, without a network: Chromium judges what a reader would see."""

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, sync_playwright

from depthreg.cli import main

MakeRun = Callable[..., Path]
OpenPage = Callable[..., Page]

NASTY = "</script><script>document.title='owned'</script><b>&"


@pytest.fixture(scope="module")
def browser(chromium: str) -> Iterator[Browser]:
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture
def open_page(browser: Browser, tmp_path: Path) -> Iterator[OpenPage]:
    """Compares the runs in `tmp_path/runs` and opens the page; nothing may be complained of or requested."""
    complaints: list[str] = []
    requested: list[str] = []

    def opened(width: int = 1280, **options: str) -> Page:
        assert main(["compare", str(tmp_path / "runs"), "--out", str(tmp_path / "out")]) == 0
        page = browser.new_context(offline=True, viewport={"width": width, "height": 900}, **options).new_page()
        page.on("console", lambda message: complaints.append(message.text))
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("request", lambda request: requested.append(request.url.split(":")[0]))
        page.goto((tmp_path / "out" / "compare.html").as_uri())
        return page

    yield opened
    assert complaints == []
    assert requested.count("file") == 1 and set(requested) <= {"file", "data", "blob"}


def weight(value: float) -> dict:
    return {"overrides": [f"loss.weight={value}"], "config": {"loss": {"weight": value}}}


@pytest.fixture
def three_rows(make_run: MakeRun) -> None:
    """RMSEs of 3 and 5, 10, and none; the last epoch's pictures are red, green and blue."""
    red, green, blue = (200, 0, 0), (0, 200, 0), (0, 0, 200)
    make_run("runs/a1", seed=1, rmse_m=3.0, color=red, **weight(0.1))
    make_run("runs/a2", seed=2, rmse_m=5.0, color=red, **weight(0.1))
    make_run("runs/b1", seed=1, rmse_m=10.0, color=green, **weight(0.02))
    make_run("runs/c1", seed=1, rmse_m=None, color=blue, frozen=[0, 2], **weight(0.3))


def names(page: Page) -> list[str]:
    return page.locator("#table tbody .name a").all_text_contents()


def pixel(page: Page, index: int) -> list[int]:
    """The middle of a picture of the strip, RGB."""
    return (
        page.locator("#strip img")
        .nth(index)
        .evaluate(
            """async image => {
            await image.decode();
            const canvas = document.createElement("canvas"), context = canvas.getContext("2d");
            context.drawImage(image, 0, 0);
            return [...context.getImageData(4, 3, 1, 1).data].slice(0, 3);
        }"""
        )
    )


def test_a_heading_sorts_by_click_and_by_keyboard_and_what_has_no_value_stays_last(
    three_rows: None, open_page: OpenPage
) -> None:
    page = open_page()
    found = ["loss.weight=0.1", "loss.weight=0.02", "loss.weight=0.3"]
    assert names(page) == found
    heading = page.locator("#table thead th", has_text="RMSE (m)")
    heading.locator("button").click()
    assert names(page) == found and heading.get_attribute("aria-sort") == "ascending"  # 4, 10 and none
    heading.locator("button").press("Enter")
    assert names(page) == [found[1], found[0], found[2]] and heading.get_attribute("aria-sort") == "descending"
    page.get_by_role("button", name="configuration", exact=True).press("Space")
    assert names(page) == [found[1], found[0], found[2]]  # 0.02, 0.1, 0.3
    assert heading.get_attribute("aria-sort") == "none"
    assert page.locator("#table tbody strong").all_text_contents() == ["4.000"]


def test_an_unticked_row_leaves_the_curves_and_the_pictures(three_rows: None, open_page: OpenPage) -> None:
    page = open_page()
    visible = "document.getElementById('plot-0').data.filter(t => t.visible !== false).map(t => t.meta)"
    assert set(page.evaluate(visible)) == {0, 1, 2} and page.locator("#strip figure").count() == 3
    page.get_by_label("show loss.weight=0.02").uncheck()
    assert set(page.evaluate(visible)) == {0, 2}
    page.locator("#details").uncheck()
    drawn = (
        "document.getElementById('plot-0').data.filter(t => t.visible && t.type === 'scatter').map(t => t.line.width)"
    )
    assert min(page.evaluate(drawn)) > 1  # means alone
    assert page.locator("#strip figcaption").all_text_contents() == ["loss.weight=0.1", "loss.weight=0.3"]


def test_the_slider_the_seed_and_a_click_show_the_pictures_of_every_row(three_rows: None, open_page: OpenPage) -> None:
    page = open_page()
    slider = page.locator("#moment")
    assert page.locator("#when").text_content() == "joint, last epoch"
    for index, expected in enumerate([(200, 0, 0), (0, 200, 0), (0, 0, 200)]):
        assert pixel(page, index) == pytest.approx(expected, abs=12)  # WebP
    slider.press("ArrowLeft")
    assert slider.get_attribute("aria-valuetext") == page.locator("#when").text_content() == "joint, epoch 0"
    page.locator("#seed").select_option(label="2")
    assert page.locator("#strip img").count() == 1 and page.locator("#strip .none").count() == 2
    page.locator("#strip button").click()
    shown = page.get_by_role("dialog")
    assert "a2/joint/panels/epoch_000_frame_0.png" in shown.text_content()
    page.keyboard.press("Escape")
    assert not shown.is_visible()


def test_whatever_a_configuration_holds_is_shown_as_text(make_run: MakeRun, open_page: OpenPage) -> None:
    make_run("runs/a", overrides=[f"tag={NASTY}"], config={"tag": NASTY})
    make_run("runs/b", overrides=["tag='{{ 7 * 7 }}'"], config={"tag": "{{ 7 * 7 }}"})
    page = open_page()
    assert names(page) == [f"tag={NASTY}", "tag='{{ 7 * 7 }}'"]
    assert page.title() == "2 configurations, 2 runs"
    page.locator("#table tbody a").first.click()
    assert NASTY in page.locator("#row-0 td code").first.text_content()
    assert page.locator("#row-0").evaluate("details => details.open")


@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (390, "dark")])
def test_the_page_fits_and_its_text_can_be_read(width: int, scheme: str, three_rows: None, open_page: OpenPage) -> None:
    page = open_page(width, color_scheme=scheme)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    page.locator("#log").check()
    luminance = """selector => {
        const style = getComputedStyle(document.querySelector(selector));
        const color = selector === 'body' ? style.backgroundColor : style.fill;
        return color.match(/\\d+/g).slice(0, 3).reduce((sum, value) => sum + value / 765, 0);
    }"""
    paper, ticks = (page.evaluate(luminance, selector) for selector in ("body", "#plot-0 .ytick text"))
    assert abs(paper - ticks) > 0.4
    assert page.evaluate("document.getElementById('plot-0').layout.yaxis.type") == "log"
