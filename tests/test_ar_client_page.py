"""The document of the page: title and icon from the start, and a script for browsers without WebGL."""

import gzip
import http.client
from contextlib import closing

import pytest
from test_ar_access_guard import Page

from ar.page.client_page import NO_WEBGL_CLASS, SCRIPT, build_document
from ar.page.style import build_style


@pytest.mark.parametrize("encoding", ["gzip", "identity"])
def test_page_has_own_title_icon_and_script(encoding):
    with closing(Page()) as page, closing(http.client.HTTPConnection("127.0.0.1", page.port, timeout=10)) as wire:
        wire.request("GET", "/", headers={"Accept-Encoding": encoding})
        answer = wire.getresponse()
        body = answer.read()
    assert int(answer.headers["Content-Length"]) == len(body)
    text = (gzip.decompress(body) if encoding == "gzip" else body).decode()
    head = text[: text.index("</head>")]
    assert head.count("<title>") == 1 and "<title>sulcus</title>" in head and "Viser</title>" not in text
    assert head.count('rel="icon"') == 1 and "37e36b" in head
    assert head.index(SCRIPT[:60]) < head.index("<title>")  # before any of viser's own


def test_unknown_document_is_left_as_it_is():
    assert build_document(b"<p>none</p>", False) == b"<p>none</p>"
    assert f":root.{NO_WEBGL_CLASS} canvas" in build_style(1.3)
