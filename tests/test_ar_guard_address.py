"""Page behind a proxy or a forwarded port: allowed addresses and the token."""

import pytest
from test_ar_access_guard import Page, ask, knock

from ar.page import access_guard


@pytest.fixture(scope="module")
def proxied():
    """A page that this machine alone reaches, and a proxy and a forwarded port lead to."""
    page = Page(origins=("https://page.example", "http://localhost:9000"))
    yield page
    page.close()


@pytest.mark.parametrize(
    ("host", "origin", "secure"),
    [
        ("page.example", "https://page.example", True),
        ("PAGE.example:443", "https://page.example", True),
        ("localhost:9000", "http://localhost:9000", False),
        ("localhost:{port}", "http://localhost:{port}", False),
        ("localhost:{port}", "https://page.example", False),  # a proxy that names the host itself
    ],
)
def test_allowed_address_requires_the_token(proxied, host, origin, secure):
    host, origin = (text.format(port=proxied.port) for text in (host, origin))
    assert ask(proxied, Host=host, Origin=origin)[0] == 403
    status, headers = ask(proxied, f"/?token={proxied.token}", Host=host, Origin=origin)
    assert status == 200 and headers["Set-Cookie"].endswith("; Secure") == secure
    cookie = headers["Set-Cookie"].split(";")[0]
    assert knock(proxied, origin=origin) == 403
    assert knock(proxied, origin=origin, additional_headers={"Cookie": cookie}) == 101


@pytest.mark.parametrize(
    ("host", "origin"),
    [
        ("evil.example", "https://page.example"),
        ("page.example", "https://evil.example"),
        ("page.example", "http://page.example"),
        ("page.example:80", "https://page.example"),
        ("page.example", "https://page.example.evil.example"),
        ("page.example", "https://page.example:8443"),
        ("localhost:9001", "http://localhost:9000"),
        ("localhost:9000", "null"),
    ],
)
def test_unlisted_address_with_token_is_rejected(proxied, host, origin):
    assert ask(proxied, f"/?token={proxied.token}", Host=host, Origin=origin)[0] == 403


def test_page_address_contains_the_token(proxied):
    assert proxied.addresses[0] == f"https://page.example/?token={proxied.token}"


@pytest.mark.parametrize(
    ("text", "origin"),
    [
        ("https://Page.example/", "https://page.example"),
        ("https://page.example:443", "https://page.example"),
        ("http://localhost:9000", "http://localhost:9000"),
        ("https://[::1]:8443", "https://[::1]:8443"),
    ],
)
def test_origin_is_normalised_as_in_browsers(text, origin):
    assert access_guard.format_origin(text) == origin


@pytest.mark.parametrize(
    "text",
    ["", "page.example", "ftp://a", "https://", "https://a/b", "https://u@a", "https://a?b", "https://a:0"]
    + ["https://a:99999", "https://*.example", "https://a b", "https://[::1", "https://a\r\nb", "https://pagé.example"],
)
def test_malformed_address_is_rejected(text):
    with pytest.raises(ValueError, match="must be https://NAME"):
        access_guard.format_origin(text)
