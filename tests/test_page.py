"""The page in a real Chromium: what is drawn, that it follows pointer and keyboard, and what it says when there is nothing to show."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.keys import Keys
from selenium.webdriver.support.select import Select

from server.asked import AskedSweep
from server.database import Database
from server.queue import SweepQueue
from server.store import Store
from tests.browsing import Page, chromium
from tests.measured import latency_results, sweep_results
from tests.serving import KEY, Command, serving, settings

PLAYER: dict[str, Any] = {
    "model": "gamesr",
    "model_sha256": "0" * 64,
    "provider": "cuda",
    "threads": 4,
    "machine": "a player's machine",
    "low_width": 960,
    "low_height": 540,
    "scale": 2,
    "latency_us": {"total": {"count": 1000, "p50": 9100.0, "p95": 12000.0, "p99": 15000.0, "max": 31000.0}},
    "deadline_misses": {"30": 0, "60": 4, "120": 700},
}


@pytest.fixture(scope="module")
def browser() -> Iterator[Page]:
    with chromium() as page:
        yield page


@pytest.fixture
def page(browser: Page) -> Iterator[Page]:
    """A tab whose console stays empty: no error, no warning, no violation of the content security policy."""
    browser.complaints()
    yield browser
    assert browser.complaints() == []


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """The address of a service with a sweep of two clips, five upscalers and two heights, and what one player saw."""
    of = settings(tmp_path_factory.mktemp("measured"))
    points, latencies = sweep_results(), latency_results()
    with Store(of.store) as store:
        for point in points:
            store.keep_point(point)
        for number, latency in enumerate(latencies):
            store.keep_latency(str(number), latency)
        store.keep_sweep(AskedSweep.of([result.point for result in points], [str(number) for number in range(len(latencies))]))
    with serving(of) as client:
        assert client.post("/api/v1/client-latencies", json=PLAYER).status_code == 201
        yield str(client.base_url)


@pytest.fixture
def shown(page: Page, measured: str) -> Page:
    """The page on that sweep, everything drawn."""
    page.open(measured)
    page.until(lambda: page.all("#savings tbody tr") and page.all("#latency tbody tr"))
    return page


def test_curves_are_drawn_and_follow_what_is_picked(shown: Page) -> None:
    assert shown.texts("#curves h3") == ["map, 540p to 1080p", "track, 540p to 1080p"]
    assert len(shown.all("#curves .series")) == 12 and len(shown.all("#curves path.marker")) == 60
    drawn = shown.one(".panel:first-child .series.native .line").get_attribute("d") or ""
    assert drawn.count("L") == 4  # five points
    assert shown.texts(".panel:first-child .grades text") == ["fair 70", "good 80", "excellent 90"]
    colours = {line.value_of_css_property("stroke") for line in shown.all(".panel:first-child .series .line")}
    markers = {marker.get_attribute("d") for marker in shown.all(".panel:first-child path.marker")}
    assert len(colours) == len(markers) == 6  # nothing is told by colour alone

    before = shown.one(".panel:first-child .series.colour-4 .line").value_of_css_property("stroke")
    shown.click("#pick-upscalers input[value=bicubic]")
    shown.click("#pick-clips input[value=track]")
    assert len(shown.all("#curves .series")) == 5
    assert shown.one(".series.colour-4 .line").value_of_css_property("stroke") == before  # gamesr keeps its look
    shown.click("#pick-height input[value='360']")
    assert shown.text("#curves h3") == "map, 360p to 1080p"
    shown.click("#pick-metric input[value=psnr_y_db]")
    assert shown.text(".axes .title:last-of-type") == "PSNR-Y, dB" and not shown.all(".grades text")
    shown.click("#pick-clips input[value=map]")
    assert shown.text("#curves .empty") == "No clip is picked."


def test_a_point_is_read_with_the_keyboard(shown: Page) -> None:
    shown.run("document.querySelector('.panel:first-child .chart').focus()")
    shown.keys(Keys.ARROW_RIGHT, Keys.ARROW_RIGHT)
    read = "native 1080p at 4.08 Mbit/s: VMAF 54.4, VMAF-NEG 52.4, PSNR-Y 31.40 dB, SSIM-Y 0.9500"
    assert shown.text(".panel:first-child .reading") == read
    shown.keys(Keys.ARROW_DOWN)
    assert shown.text(".panel:first-child .reading").startswith("bicubic 540p at 4.08 Mbit/s")
    assert shown.one(".panel:first-child .ring").get_attribute("visibility") == "visible"
    shown.keys(Keys.ENTER)
    assert Select(shown.one("#frame-right")).first_selected_option.text == "bicubic"
    assert Select(shown.one("#frame-bitrate")).first_selected_option.text == "4 Mbit/s"


def test_a_point_is_read_and_chosen_with_the_pointer(shown: Page) -> None:
    marker = shown.all(".panel:first-child .series.colour-4 path.marker")[3]
    ActionChains(shown.driver).move_to_element(marker).perform()
    assert shown.text(".panel:first-child .reading").startswith("gamesr 540p at 16.32 Mbit/s")
    ActionChains(shown.driver).click(marker).perform()
    assert Select(shown.one("#frame-bitrate")).first_selected_option.text == "16 Mbit/s"
    assert shown.text("#frame-status").startswith("The service has measurements of this clip, but not its file")


def test_savings_at_any_target_are_a_number_or_a_reason(shown: Page) -> None:
    def row() -> list[str]:
        """What the first clip's table says of gamesr."""
        return shown.texts("#savings .figures:first-child tbody tr:last-child > *")

    shown.until(lambda: row()[1] == "(5)")
    assert row() == ["gamesr", "(5)", "(5)", "(5)", "\N{MINUS SIGN}16.6%", "\N{MINUS SIGN}14.6%"]
    assert "(5) gamesr 540p never reaches VMAF 80 (79.5 at 25500 kbps)" in shown.text("#savings .figures:first-child .notes")
    shown.one("#target").send_keys(Keys.CONTROL, "a", Keys.NULL, "75.5")
    shown.until(lambda: "VMAF 75.5" in shown.text("#savings .figures:first-child thead"))
    kbps, over_native, over_bicubic = row()[1:4]
    assert 10 < float(kbps) < 25 and over_native.endswith("%") and over_bicubic.endswith("%")
    shown.click("#grades button[value='70']")
    shown.until(lambda: shown.one("#grades button[value='70']").get_attribute("aria-pressed") == "true")
    shown.click("#pick-metric input[value=vmaf_neg]")
    shown.until(lambda: "VMAF-NEG 70" in shown.text("#savings .figures:first-child thead"))


def test_latency_stands_against_deadlines_beside_what_players_see(shown: Page) -> None:
    rows = {row.text.split(" 0%")[0].split("\n")[0]: row.text for row in shown.all("#latency tbody tr")}
    assert rows["map: native 2.10 3.00 3.50"] == "map: native 2.10 3.00 3.50 0% 0% 0%"
    assert rows["live: gamesr 540p 9.10 12.0 15.0"].endswith("0% <1% 70%")
    assert shown.texts("text.deadline") == ["30", "fps", "60", "fps", "120", "fps"]
    deadlines = [shown.run("return arguments[0].getBBox().x", line) for line in shown.all("path.deadline")]
    ends = [shown.run("const box = arguments[0].getBBox(); return box.x + box.width", bar) for bar in shown.all(".bars .bar.p50")]
    assert deadlines == sorted(deadlines, reverse=True)
    assert ends[0] < deadlines[2] < ends[1] < deadlines[1]  # native is within 120 fps, bicubic within 60
    assert "a player's machine" in shown.text("#latency")


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("width", [1280, 390])
def test_it_fits_and_can_be_read(page: Page, measured: str, width: int, dark: bool) -> None:
    page.open(measured, width=width, dark=dark)
    page.until(lambda: page.all("#savings tbody tr"))
    page.run("document.querySelector('#start').open = true")
    page.until(lambda: page.all("#start-upscalers input"))
    assert page.run("return document.documentElement.scrollWidth") <= width
    below = [
        (pair, contrast)
        for pair, contrast in page.run(CONTRASTS)
        if contrast < (4.5 if pair.split(" on ")[0] in ("--ink", "--soft", "--alarm") else 3)
    ]
    assert below == []
    luma = sum(int(part) for part in page.run("return getComputedStyle(document.body).backgroundColor").strip("rgb()").split(","))
    assert (luma < 384) == dark


CONTRASTS = """
const value = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const linear = (part) => (part <= 0.04045 ? part / 12.92 : ((part + 0.055) / 1.055) ** 2.4);
const luminance = (hex) => [1, 3, 5].map((at) => linear(parseInt(hex.slice(at, at + 2), 16) / 255))
  .reduce((sum, part, index) => sum + part * [0.2126, 0.7152, 0.0722][index], 0);
const contrast = (one, other) => {
  const [high, low] = [luminance(value(one)), luminance(value(other))].sort((a, b) => b - a);
  return (high + 0.05) / (low + 0.05);
};
const inks = ["--ink", "--soft", "--alarm", "--focus", "--native", ...[0, 1, 2, 3, 4, 5].map((n) => `--colour-${n}`), "--p50", "--live"];
return inks.map((ink) => [`${ink} on --page`, contrast(ink, "--page")]);
"""


def test_the_keyboard_reaches_everything_and_shows_where_it_is(shown: Page) -> None:
    reached = []
    for _ in range(80):
        shown.keys(Keys.TAB)
        where = shown.run("const at = document.activeElement; return [at.id || at.getAttribute('class') || at.tagName, at.value ?? '']")
        if where[0] == "BODY":
            break
        reached.append(where[0])
        outline = shown.run("return getComputedStyle(document.activeElement).outlineStyle")
        assert outline != "none", where
    for name in ("skip", "sweep", "chart", "target", "frame-clip", "frame-left"):
        assert name in reached
    assert reached[0] == "skip"


def test_everything_has_a_name_that_can_be_spoken(shown: Page) -> None:
    shown.run("document.querySelector('#start').open = true")
    shown.until(lambda: shown.all("#start-upscalers input"))
    nodes = shown.driver.execute_cdp_cmd("Accessibility.getFullAXTree", {})["nodes"]
    speaking = ("button", "checkbox", "combobox", "link", "progressbar", "radio", "slider", "spinbutton", "textbox", "table", "image")
    nameless = [
        node["role"]["value"]
        for node in nodes
        if not node["ignored"] and node["role"]["value"] in speaking and not node.get("name", {}).get("value")
    ]
    assert nameless == []


def test_an_empty_store_and_a_service_that_is_gone_are_said(page: Page, tmp_path: Path) -> None:
    with serving(settings(tmp_path)) as client:
        page.open(str(client.base_url))
        assert page.text("#curves .empty") == "No sweep is in the store yet: start one below."
        assert page.text(".sweeps .empty").startswith("No sweep yet")
        page.until(lambda: page.text("#start-clips") == "The service has no clip yet: upload one.")
        page.click("#start-form [type=submit]")
        assert page.until(lambda: page.text("#sweep-status")) == "Choose a clip, or a file to upload."
    page.run("document.querySelector('#start').open = false")
    page.click("#start summary")
    assert page.until(lambda: page.text("#problem")) == "The service is not reached: is it running?"
    assert all("ERR_CONNECTION_REFUSED" in message for message in page.complaints())


def test_a_key_is_asked_for_when_the_service_wants_one(page: Page, tmp_path: Path, make_clip: Callable[..., Path]) -> None:
    clips = tmp_path / "clips"
    clips.mkdir()
    make_clip("clips/small.mp4", width=96, height=72)
    with serving(settings(tmp_path, clips=clips, api_key=KEY)) as client:
        page.open(str(client.base_url))
        page.click("#start-clips input[value='small.mp4']")
        page.click("#start-form [type=submit]")
        assert "key" in page.until(lambda: page.text("#sweep-status"))
        page.one("#key").send_keys(KEY, Keys.ENTER)
        page.click("#start-form [type=submit]")
        page.until(lambda: page.text("#sweep-status") == "The sweep is queued.")
        page.until(lambda: "queued" in page.text(".sweeps .words"))
        assert len(page.complaints()) == 1  # the 401
        page.click(".sweeps button[aria-label^=Cancel]")
        page.until(lambda: "cancelled" in page.text(".sweeps .words"))
        page.leave()


def test_a_half_is_of_each_clips_own_height(page: Page, tmp_path: Path, make_clip: Callable[..., Path]) -> None:
    clips = tmp_path / "clips"
    clips.mkdir()
    for name, width, height in (("large.mp4", 96, 72), ("small.mp4", 64, 48)):
        make_clip(f"clips/{name}", width=width, height=height)
    of = settings(tmp_path, clips=clips)
    with serving(of) as client:
        page.open(str(client.base_url))
        for name in ("large.mp4", "small.mp4"):
            page.click(f"#start-clips input[value='{name}']")
        page.click("#start-heights input[value='3']")
        page.click("#start-form [type=submit]")
        assert page.until(lambda: page.text("#sweep-status")) == "The sweep is queued."
        (queued,) = SweepQueue(Database(of.database), most=1, kept=1).all()
        assert (queued.request.clips, queued.request.scales) == (["large.mp4", "small.mp4"], [2])
        page.leave()


def test_a_sweep_from_upload_to_pictures(page: Page, tmp_path: Path, make_clip: Callable[..., Path]) -> None:
    clip = make_clip("small.mp4", width=192, height=144)
    with Command("--store", tmp_path / "store.sqlite", "--data", tmp_path / "data") as service:
        page.open(service.url)
        page.until(lambda: page.all("#start-upscalers input"))
        page.one("#start-file").send_keys(str(clip))
        field = page.one("#start-bitrates")
        field.clear()
        field.send_keys("0.2, 0.4, 0.8, 1.6")
        for name in ("lanczos", "fsr1", "gamesr"):
            page.click(f"#start-upscalers input[value={name}]")
        page.click("#start-heights input[value='3']")
        page.click("#start-form [type=submit]")

        shares = []

        def over() -> bool:
            """Notes how far the bar is; the sweep's line says when it is done."""
            found = page.run("const bar = document.querySelector('.sweeps progress:not([hidden])'); return bar && bar.value / bar.max")
            shares.append(found)
            return page.run("return document.querySelector('.sweeps .words')?.textContent.startsWith('done')")

        page.until(over)
        moved = [share for share in shares if share is not None]
        assert moved == sorted(moved) and len(set(moved)) >= 3
        page.until(lambda: len(page.all("#curves .series")) == 2 and len(page.all("#curves path.marker")) == 8)

        def compared() -> bool:
            page.run("document.querySelector('#frames').scrollIntoView()")  # again: the sections above it may have grown
            return page.text("#caption-right").startswith("bicubic 72p")

        page.until(compared)
        clip_of_right = "return getComputedStyle(document.querySelectorAll('.stage img')[1]).clipPath"
        middle = page.run(clip_of_right)
        page.run("document.querySelector('.wipe input').focus()")
        page.keys(*[Keys.ARROW_RIGHT] * 10)
        assert page.run(clip_of_right) != middle and page.one(".wipe input").get_attribute("value") == "55"
        page.drag(".handle", -200)
        assert float(page.one(".wipe input").get_attribute("value") or 0) < 50
        page.click("[data-zoom='4']")
        assert page.one("[data-zoom='4']").get_attribute("aria-pressed") == "true"
        place = "return document.querySelector('.stage img').style.transform"
        zoomed = page.run(place)
        assert "scale(4)" in zoomed
        page.one(".stage").click()
        page.keys("0")
        assert page.run(place) != zoomed
        Select(page.one("#frame-left")).select_by_visible_text("reference")
        page.until(lambda: page.text("#caption-left") == "reference")
        page.until(lambda: page.one(".stage img:first-child").get_attribute("alt") == "reference")
        page.leave()


def test_nothing_that_is_injected_runs(browser: Page, measured: str) -> None:
    browser.open(measured)
    browser.run("const made = document.createElement('script'); made.textContent = 'window.ran = 1'; document.body.append(made)")
    assert browser.run("return window.ran") is None
    assert any("Content Security Policy" in message for message in browser.complaints())
