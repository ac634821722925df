"""A real browser shows the console: pages, losses, silence of the service; nothing leaves the host."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect, sync_playwright

from tests.runtime import toy
from tests.runtime.console.stage import stage
from tests.runtime.identity.authority import Authority

WIDE, NARROW = 1400, 420
_WAIT_MS = 20_000


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("chromium is not installed")
    with sync_playwright() as playwright:
        running = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox", "--disable-gpu"])
        yield running
        running.close()


def loaded(page: Page, name: str) -> bool:
    """Whether a picture comes; the page's own rules forbid playwright to wait for it there."""
    for _ in range(100):
        if page.locator(f"#{name}").evaluate("image => image.complete && image.naturalWidth > 0"):
            return True
        page.wait_for_timeout(100)
    return False


@pytest.mark.parametrize("width", [WIDE, NARROW])
def test_the_console_shows_pages_and_losses(browser: Browser, toy_zip: Path, tmp_path: Path, width: int) -> None:
    with stage(toy_zip) as running:
        running.read(7)
        page = browser.new_page(viewport={"width": width, "height": 900})
        requests: list[str] = []
        errors: list[str] = []
        page.on("request", lambda request: requests.append(request.url))
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
        page.goto(running.url)
        expect(page.locator("#facts")).to_contain_text("7 pages", timeout=_WAIT_MS)
        expect(page.locator("#losses")).to_contain_text("MISSING_FRAME")
        expect(page.locator("#models")).to_contain_text("toy-1 (in service)")
        for name in ("in_phase", "quadrature", "confidence"):
            assert loaded(page, name)
        assert page.locator(".chart path.line").count() >= 5
        running.read(3)
        expect(page.locator("#facts")).to_contain_text("10 pages", timeout=_WAIT_MS)
        expect(page.locator("#condition")).to_have_text("pages are being lost")
        page.locator(".chart svg").first.hover(position={"x": 120, "y": 60})
        page.screenshot(path=str(tmp_path / f"console-{width}.png"), full_page=True)
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        assert errors == []
        assert all(url.startswith(running.url) for url in requests)
        page.close()


def test_the_console_says_when_nobody_answers(browser: Browser, toy_zip: Path) -> None:
    page = browser.new_page()
    with stage(toy_zip) as running:
        running.read(1)
        page.goto(running.url)
        expect(page.locator("#facts")).to_contain_text("1 pages", timeout=_WAIT_MS)
    expect(page.locator("#silence")).to_contain_text("No answer from the service since", timeout=_WAIT_MS)
    expect(page.locator("#condition")).to_have_text("no answer")
    page.close()


def test_an_administrator_rolls_back_and_others_see_no_button(browser: Browser, toy_zip: Path, tmp_path: Path) -> None:
    authority = Authority(tmp_path / "certificates")
    with stage(toy_zip, authority.service()) as running:
        other = toy.write_toy_bundle(tmp_path / "c.zip", version="toy-2")
        running.plane.adopt(running.plane.registry.opened(other))
        for name, role in (("watcher", "read"), ("operator 7", "admin")):
            tls = authority.caller(name, [role])
            own = {"origin": running.url, "certPath": str(tls.certificate), "keyPath": str(tls.key)}
            context = browser.new_context(ignore_https_errors=True, client_certificates=[own])
            page = context.new_page()
            page.on("dialog", lambda dialog: dialog.accept())
            page.goto(running.url)
            expect(page.locator("#models")).to_contain_text("toy-2 (in service)", timeout=_WAIT_MS)
            if role == "read":
                expect(page.locator("#actions")).to_be_hidden()
            else:
                expect(page.locator("#caller")).to_have_text(name)
                page.screenshot(path=str(tmp_path / "actions.png"), full_page=True)
                page.locator("#roll-back").click()
                expect(page.locator("#models")).to_contain_text("toy-1 (in service)", timeout=_WAIT_MS)
                expect(page.locator("#outcome")).to_have_text("toy-1 is in service again, toy-2 is not")
                expect(page.locator("#roll-back")).to_be_disabled()
            context.close()
