"""Simulated devices that whole test modules share. They own fixed ports: one of a kind at a time."""

import base64
import os
from collections.abc import Callable, Iterator

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from playwright.sync_api import Page, expect, sync_playwright

from acquisition.simulation.camera import SimulatedCamera

collect_ignore = [] if "S2P3_RIG" in os.environ else ["hardware"]  # those tests need a lab's own devices

CHROMIUM = "/usr/bin/chromium"
CHROMIUM_ARGUMENTS = (
    "--headless=new",
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-quic",
    "--disable-sync",
)


@pytest.fixture(scope="module")
def simulated_camera() -> Iterator[SimulatedCamera]:
    """A small and fast camera on 127.0.0.1, which shows `MovingPattern`."""
    with SimulatedCamera(width=256, height=192, frame_rate=100, latency_s=0.002) as camera:
        yield camera


@pytest.fixture(scope="module")
def browser_page() -> Iterator[Page]:
    """An empty page of a Chromium without a window; small, because it draws WebGL in software."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=list(CHROMIUM_ARGUMENTS))
        page = browser.new_page(viewport={"width": 1040, "height": 820})
        page.set_default_timeout(60_000)
        expect.set_options(timeout=60_000)  # software WebGL on a busy host
        yield page
        browser.close()


@pytest.fixture(scope="session")
def shown_images() -> Callable[[Page], list[NDArray[np.uint8]]]:
    """The images that a page was sent, once it has loaded them, in their own resolution: (h, w, 3) BGR."""

    def images(page: Page) -> list[NDArray[np.uint8]]:
        urls = page.wait_for_function(
            """() => {
                const images = [...document.images].filter(image => image.src.startsWith("blob:"));
                const loaded = images.length && images.every(image => image.complete && image.naturalWidth);
                if (!loaded) return null;
                return images.map(image => {
                    const canvas = document.createElement("canvas");
                    [canvas.width, canvas.height] = [image.naturalWidth, image.naturalHeight];
                    canvas.getContext("2d").drawImage(image, 0, 0);
                    return canvas.toDataURL("image/png");
                });
            }"""
        ).json_value()
        coded = [np.frombuffer(base64.b64decode(url.split(",")[1]), np.uint8) for url in urls]
        return [np.asarray(cv2.imdecode(png, cv2.IMREAD_COLOR), np.uint8) for png in coded]

    return images
