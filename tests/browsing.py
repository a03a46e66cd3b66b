"""A headless Chromium for the tests of the page: Debian's packages chromium and chromium-driver, driven by Selenium."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator
from typing import Any

import pytest
from selenium import webdriver
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.by import By
from selenium.webdriver.remote.webelement import WebElement
from selenium.webdriver.support.wait import WebDriverWait

WAIT_S = 120
# Root, which a container's gate is, may not have Chromium's sandbox; and its /dev/shm is small.
_SWITCHES = ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--disable-gpu", "--hide-scrollbars", "--lang=en-US")


class Page:
    """One tab; selectors are those of CSS."""

    def __init__(self, driver: webdriver.Chrome) -> None:
        self.driver = driver

    def open(self, url: str, *, width: int = 1280, height: int = 900, dark: bool = False, pixels: float = 1) -> None:
        size = {"width": width, "height": height, "deviceScaleFactor": pixels, "mobile": width < 500}
        self.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
        features = [
            {"name": "prefers-color-scheme", "value": "dark" if dark else "light"},
            {"name": "prefers-reduced-motion", "value": "reduce"},
        ]
        self.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})
        self.driver.get(url)

    def leave(self) -> None:
        """So that a service that ends does not break off what the page is waiting for."""
        self.driver.get("about:blank")

    def all(self, selector: str) -> list[WebElement]:
        return self.driver.find_elements(By.CSS_SELECTOR, selector)

    def one(self, selector: str) -> WebElement:
        """The only such element, once it is there."""
        return self.until(lambda: self.all(selector) if len(self.all(selector)) == 1 else None)[0]

    def text(self, selector: str) -> str:
        self.one(selector)
        return self.texts(selector)[0]

    def texts(self, selector: str) -> list[str]:
        """Of all such elements at one moment, whatever is drawn again at the next."""
        return list(self.run("return [...document.querySelectorAll(arguments[0])].map((each) => each.textContent)", selector))

    def click(self, selector: str) -> None:
        found = self.one(selector)
        self.run("arguments[0].scrollIntoView({block: 'center'})", found)
        found.click()

    def keys(self, *keys: str) -> None:
        """Typed into what has the focus."""
        actions = ActionChains(self.driver)
        for key in keys:
            actions.send_keys(key)
        actions.perform()

    def drag(self, selector: str, right: int) -> None:
        ActionChains(self.driver).drag_and_drop_by_offset(self.one(selector), right, 0).perform()

    def run(self, script: str, *arguments: Any) -> Any:
        return self.driver.execute_script(script, *arguments)

    def until(self, found: Any) -> Any:
        return WebDriverWait(self.driver, WAIT_S, poll_frequency=0.1).until(lambda _: found())

    def complaints(self) -> list[str]:
        """What the console says since it was last asked: errors, warnings, violations of the content security policy."""
        return [entry["message"] for entry in self.driver.get_log("browser")]


@contextlib.contextmanager
def chromium() -> Iterator[Page]:
    """Skips the test where there is no Chromium: its packages are the machine's, and nothing here may install them."""
    programs = [shutil.which(name) for name in ("chromium", "chromedriver")]
    if None in programs:
        pytest.skip("the page is not tested: Chromium is missing (apt-get install chromium chromium-driver)")
    options = webdriver.ChromeOptions()
    options.binary_location = str(programs[0])
    for switch in _SWITCHES:
        options.add_argument(switch)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options, Service(programs[1]))
    try:
        yield Page(driver)
    finally:
        driver.quit()
