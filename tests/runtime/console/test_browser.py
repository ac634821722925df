"""A real browser shows the console: pages, losses, silence of the service; nothing leaves the host."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, expect, sync_playwright

from lightpage.runtime.client.wire.channel import TlsFiles
from lightpage.runtime.model.decoding.decoder import Decoder
from tests.runtime import toy
from tests.runtime.console.stage import stage
from tests.runtime.service.server.authority import Authority

WIDE, NARROW = 1400, 420
_WAIT_MS = 60_000


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("chromium is not installed")
    with sync_playwright() as playwright:
        running = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox", "--disable-gpu"])
        yield running
        running.close()


class Visitor:
    def __init__(self, browser: Browser, url: str, certificate: TlsFiles) -> None:
        own = {"origin": url, "certPath": str(certificate.certificate), "keyPath": str(certificate.key)}
        self.context = browser.new_context(
            ignore_https_errors=True, client_certificates=[own], viewport={"width": WIDE, "height": 900}
        )
        self.page = page = self.context.new_page()
        self.requests, self.errors = list[str](), list[str]()
        page.on("request", lambda request: self.requests.append(request.url))
        page.on("pageerror", lambda error: self.errors.append(str(error)))
        page.on("console", lambda message: self.errors.append(message.text) if message.type == "error" else None)
        page.on("dialog", lambda dialog: dialog.accept())
        page.goto(url)

    def sees(self, name: str, text: str) -> None:
        expect(self.page.locator(f"#{name}")).to_contain_text(text, timeout=_WAIT_MS)


def test_a_browser_shows_pages_and_losses_acts_for_administrators_and_says_when_nobody_answers(
    browser: Browser, decoder: Decoder, tmp_path: Path
) -> None:
    authority = Authority(tmp_path / "certificates")
    with stage(decoder, authority.service()) as running:
        other = toy.write_toy_bundle(tmp_path / "c.zip", version="toy-2")
        models = running.plane.models
        models.adopt(models.loader.opened(other, models.current.decoder))
        running.read(7)
        watcher = Visitor(browser, running.url, authority.caller("watcher", ["read"]))
        watcher.sees("facts", "7 pages")
        watcher.sees("losses", "MISSING_FRAME")
        watcher.sees("models", "toy-2 (in service)")
        expect(watcher.page.locator("#actions")).to_be_hidden()
        for name in ("in_phase", "quadrature", "air"):
            expect(watcher.page.locator(f"#{name}")).not_to_have_js_property("naturalWidth", 0, timeout=_WAIT_MS)
        assert watcher.page.locator(".chart path.line").count() >= 5
        running.read(3)
        watcher.sees("facts", "10 pages")
        expect(watcher.page.locator("#condition")).to_have_text("pages are being lost")
        for width in (WIDE, NARROW):
            watcher.page.set_viewport_size({"width": width, "height": 900})
            watcher.page.locator(".chart svg").first.hover(position={"x": 120, "y": 60})
            assert watcher.page.evaluate("document.documentElement.scrollWidth") <= width
        assert watcher.errors == []
        assert all(url.startswith(running.url) for url in watcher.requests)

        operator = Visitor(browser, running.url, authority.caller("operator 7", ["admin"]))
        operator.sees("caller", "operator 7")
        operator.page.locator("#roll-back").click()
        operator.sees("models", "toy-1 (in service)")
        operator.sees("outcome", "toy-1")
        expect(operator.page.locator("#roll-back")).to_be_disabled()
        watcher.sees("models", "toy-1 (in service)")
    operator.sees("silence", "No answer")
    expect(operator.page.locator("#condition")).to_have_text("no answer")
