"""A headless Chromium, for pictures and tests of the viewer's page."""

import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from selenium import webdriver
from selenium.webdriver.chrome.service import Service

WIDTH, HEIGHT = 1280, 800
PROGRAMS = ("chromium", "chromedriver")  # Debian: chromium, chromium-driver
PATIENCE_SECONDS = 240  # software rendering on a machine that may be busy

NEXT_FRAME = "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"


def missing() -> list[str]:
    """The programs that are not installed."""
    return [name for name in PROGRAMS if not shutil.which(name)]


@contextmanager
def chromium(logs: Mapping[str, str]) -> Iterator[webdriver.Chrome]:
    """A driver of WIDTH × HEIGHT pixels without GPU and network; `logs` maps each log kept to its level."""
    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or ""
    for flag in ("headless=new", "no-sandbox", "use-angle=swiftshader", "enable-unsafe-swiftshader"):
        options.add_argument(f"--{flag}")
    options.add_argument("--disable-dev-shm-usage")  # containers have little of it
    options.set_capability("goog:loggingPrefs", dict(logs))
    driver = webdriver.Chrome(options=options, service=Service(shutil.which("chromedriver")))
    try:
        driver.set_script_timeout(PATIENCE_SECONDS)
        driver.set_page_load_timeout(PATIENCE_SECONDS)
        driver.execute_cdp_cmd("Network.enable", {})
        off = {"offline": True, "latency": 0, "downloadThroughput": -1, "uploadThroughput": -1}
        driver.execute_cdp_cmd("Network.emulateNetworkConditions", off)
        size(driver, WIDTH, HEIGHT)
        yield driver
    finally:
        driver.quit()


def size(driver: webdriver.Chrome, width: int, height: int) -> None:
    window = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", window)


def drawn(driver: webdriver.Chrome, address: str) -> str | None:
    """Load the viewer's page and wait until its first start is drawn; returns the error or None."""
    driver.get(address)
    return wait_for(driver, "qrlView.ready")


def wait_for(driver: webdriver.Chrome, promise: str) -> str | None:
    """Wait for a promise of the page; returns the error or None."""
    return driver.execute_async_script(
        f"const done = arguments[0]; (async () => {promise})().then(() => done(null), error => done(String(error)))"
    )
