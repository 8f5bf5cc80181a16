"""Whatever the service serves to a browser works without another host: no page or file of it loads one."""

from __future__ import annotations

import re
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import urljoin, urlsplit

import pytest
from fastapi.testclient import TestClient

from services.status.app import SharedStatus, StatusServer, create_app
from services.status.config import Config
from services.status.page import STATIC
from tests.status.browser import chromium, until
from tests.status.test_every_route import flat

BASE = "http://127.0.0.1:8080"
_LOADING = {"src", "href", "srcset", "action", "data", "poster", "formaction"}


class _Links(HTMLParser):
    """Every address that a page names in an attribute, and its scripts' and styles' own text."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []
        self.inline = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found += [value for name, value in attrs if name in _LOADING and value]

    def handle_data(self, data: str) -> None:
        self.inline += data


@pytest.fixture(scope="module")
def client() -> TestClient:
    return TestClient(create_app(SharedStatus(Config(), "husky1")), base_url=BASE)


def html_pages(client: TestClient) -> dict[str, str]:
    """Every path without parameters that answers with HTML, with its text; event streams left out."""
    app: Any = client.app
    paths = {str(getattr(route, "path", "")) for route in flat(list(app.routes))}
    pages = {}
    for path in sorted(p for p in paths if p and "{" not in p and not p.endswith("/stream")):
        answer = client.get(path)
        if answer.headers.get("content-type", "").startswith("text/html"):
            pages[path] = answer.text
    return pages


def test_no_html_refers_to_another_host_and_what_it_refers_to_is_served(client: TestClient) -> None:
    pages = html_pages(client)
    assert {"/", "/docs"} <= set(pages)
    for path, text in pages.items():
        links = _Links()
        links.feed(text)
        assert links.found
        assert "//" not in links.inline
        for address in links.found:
            whole = urljoin(BASE + path, address)
            assert urlsplit(whole).netloc == urlsplit(BASE).netloc, f"{path} refers to {address}"
            assert client.get(whole).status_code == 200, f"{path} refers to {address}"


def test_every_page_forbids_other_hosts_by_its_policy(client: TestClient) -> None:
    for path in html_pages(client):
        policy = client.get(path).headers["content-security-policy"]
        assert "default-src 'none'" in policy
        assert not re.search(r"https?:|\*", policy)


@pytest.mark.parametrize("path", ["/redoc", "/docs/oauth2-redirect"])
def test_pages_of_the_framework_that_would_load_a_cdn_are_not_served(client: TestClient, path: str) -> None:
    assert client.get(path).status_code == 404


def _own_files() -> Iterator[Path]:
    yield from (f for f in STATIC.rglob("*") if f.suffix in (".html", ".js", ".css", ".svg"))


def test_no_style_and_none_of_our_scripts_names_another_host() -> None:
    for file in _own_files():
        text = file.read_text(encoding="utf-8")
        if file.suffix == ".css":
            assert not re.search(r"url\(\s*[\"']?(https?:)?//|@import", text), file
        elif "vendor" not in file.parts:
            assert not re.search(r"[\"'`(]\s*(https?:)?//\w", text.replace("http://www.w3.org/", "")), file


def test_every_vendored_file_is_told_of_with_its_licence() -> None:
    vendor = STATIC / "vendor"
    told = (vendor / "README.md").read_text(encoding="utf-8")
    for file in vendor.iterdir():
        assert file.name == "README.md" or f"`{file.name}`" in told, file.name


@pytest.mark.slow
def test_the_interface_is_shown_in_a_browser_without_another_host(tmp_path: Path) -> None:
    shared = SharedStatus(Config(port=0), "husky1")
    server = StatusServer(shared)
    server.start()
    asked: list[str] = []
    wrong: list[str] = []
    try:
        with chromium() as browser:
            page = browser.new_page()
            page.on("request", lambda request: asked.append(request.url))
            page.on("console", lambda m: wrong.append(m.text) if m.type == "error" else None)
            page.on("pageerror", lambda error: wrong.append(str(error)))
            page.goto(f"http://127.0.0.1:{server.port}/docs")
            until(page, "document.querySelectorAll('.opblock').length > 10")
            page.click("#operations-status-status_api_v1_status_get button")  # opened, to be tried
            until(page, "document.querySelector('.try-out__btn') !== null")
            page.click(".try-out__btn")
            page.click("button.execute")
            until(page, "document.querySelector('.live-responses-table .response-col_status') !== null")
            said = page.evaluate("document.querySelector('.live-responses-table').innerText")
            page.screenshot(path=str(tmp_path / "docs.png"))
    finally:
        server.stop()
    assert '"robot": "husky1"' in said
    assert not wrong
    own = (f"http://127.0.0.1:{server.port}/", "data:", "blob:")
    assert [url for url in asked if not url.startswith(own)] == []
