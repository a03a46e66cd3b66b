"""The pictures of the page in docs/: `python -m tests.screenshots` makes them again, of the sample sweep."""

from __future__ import annotations

import io
from pathlib import Path

from PIL import Image

from tests.browsing import Page, chromium
from tests.serving import ROOT, Command


def main() -> None:
    with Command("--demo") as service, chromium() as page:
        page.open(service.url, width=1280, height=960)
        page.until(lambda: page.all("#savings tbody tr"))
        _save(page, ROOT / "docs/page_1280_light.png")
        page.open(service.url, width=390, height=844, dark=True, pixels=1.5)
        page.until(lambda: page.all("#savings tbody tr"))

        def compared() -> bool:
            page.run("document.querySelector('#frames').scrollIntoView()")
            return bool(page.text("#caption-right"))

        page.until(compared)
        page.run("document.querySelector('#frames').scrollIntoView()")
        _save(page, ROOT / "docs/page_390_dark.png")


def _save(page: Page, path: Path) -> None:
    shot = Image.open(io.BytesIO(page.driver.get_screenshot_as_png())).convert("RGB")
    shot.save(path, optimize=True)
    print(path, path.stat().st_size)


if __name__ == "__main__":
    main()
