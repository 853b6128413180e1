"""The range server as HTTP clients see it, and `pd4dgs-serve` as its users start and stop it."""

import contextlib
import gzip
import http.client
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from http import HTTPStatus

import pytest
from faulty import ask

from pd4dgs_codec.errors import DeliveryError
from pd4dgs_codec.web.server import Link, Server

CONTENT = bytes(i % 251 for i in range(1000))


def told(server: Server, request: bytes) -> bytes:
    """What the server sends on a connection of its own until it ends that."""
    received = b""
    with socket.create_connection(server.server_address[:2], timeout=20) as raw:
        raw.sendall(request)
        with contextlib.suppress(ConnectionResetError):  # what nobody reads may reset it
            while block := raw.recv(65536):
                received += block
    return received


def test_the_whole_file_with_its_validators(server):
    answer = ask(server, "/bytes.bin")
    assert answer.status == 200 and answer.body == CONTENT
    assert answer.headers["Content-Length"] == "1000" and answer.headers["Accept-Ranges"] == "bytes"
    assert answer.headers["ETag"].startswith('"') and answer.headers["Last-Modified"].endswith("GMT")
    assert ask(server, "/scene.pd4").headers["Content-Type"] == "model/vnd.pd4dgs"


@pytest.mark.parametrize("name, kind", [("viewer.css", "text/css"), ("playcanvas.mjs", "text/javascript")])
def test_browsers_take_modules_and_styles_of_pages_beside_scenes(server, folder, name, kind):
    (folder / name).write_bytes(b"")
    assert ask(server, f"/{name}").headers["Content-Type"] == f"{kind}; charset=utf-8"


@pytest.mark.parametrize(
    ("header", "part"),
    [
        *{"bytes=0-0": (0, 1), "bytes=10-19": (10, 20), "bytes=990-": (990, 1000), "Bytes=3-4": (3, 5)}.items(),
        *{"bytes=990-5000": (990, 1000), "bytes=-7": (993, 1000), "bytes=-5000": (0, 1000)}.items(),
        *((header, "no byte") for header in ("bytes=1000-", "bytes=5000-6000", "bytes=-0")),
        *((header, None) for header in ("bytes=5-4", "bytes=a-b", "bytes=", "bytes=-", "lines=0-4", "bytes=0-1,5-6")),
        (f"bytes={'9' * 5000}-", None),
    ],
)
def test_ranges(server, header, part):
    """One range is 206, one without a byte of the file 416; anything else gets the whole file."""
    answer = ask(server, "/bytes.bin", Range=header)
    if part is None:
        assert answer.status == 200 and answer.body == CONTENT
    elif part == "no byte":
        assert answer.status == 416 and answer.headers["Content-Range"] == "bytes */1000"
    else:
        start, end = part
        assert answer.status == 206 and answer.body == CONTENT[start:end]
        assert answer.headers["Content-Range"] == f"bytes {start}-{end - 1}/1000"
        assert answer.headers["Content-Length"] == str(end - start)


def test_head_sends_no_body_and_ignores_ranges(server):
    answer = ask(server, "/bytes.bin", "HEAD", Range="bytes=0-9")
    assert answer.status == 200 and answer.body == b"" and answer.headers["Content-Length"] == "1000"


def test_if_range_holds_for_the_same_file_only(server, folder):
    etag = ask(server, "/bytes.bin", "HEAD").headers["ETag"]
    assert ask(server, "/bytes.bin", Range="bytes=5-", If_Range=etag).status == 206
    assert ask(server, "/bytes.bin", Range="bytes=5-", If_Range="W/" + etag).status == 200
    (folder / "bytes.bin").write_bytes(CONTENT[::-1])  # the same length
    changed = ask(server, "/bytes.bin", Range="bytes=5-", If_Range=etag)
    assert changed.status == 200 and changed.body == CONTENT[::-1] and changed.headers["ETag"] != etag


def test_not_modified(server):
    first = ask(server, "/bytes.bin").headers
    for header in (first["ETag"], f'"x", W/{first["ETag"]}', "*"):
        answer = ask(server, "/bytes.bin", If_None_Match=header)
        assert answer.status == 304 and answer.body == b"" and answer.headers["ETag"] == first["ETag"]
    assert ask(server, "/bytes.bin", If_None_Match='"x"').status == 200


def test_pages_of_other_sites_may_read_and_resume(server):
    assert ask(server, "/bytes.bin").headers["Access-Control-Allow-Origin"] == "*"
    assert "Content-Range" in ask(server, "/nothing").headers["Access-Control-Expose-Headers"]
    preflight = ask(server, "/bytes.bin", "OPTIONS", Origin="http://example.org", Access_Control_Request_Method="GET")
    assert preflight.status == 204 and preflight.body == b""
    assert {"Range", "If-Range"} <= set(preflight.headers["Access-Control-Allow-Headers"].split(", "))


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH"])
def test_other_methods_are_refused(server, method):
    answer = ask(server, "/bytes.bin", method)
    assert answer.status == 405 and "GET" in answer.headers["Allow"]


@pytest.mark.parametrize(
    "target",
    [
        *("/../secret.txt", "/%2e%2e/secret.txt", "/..%2fsecret.txt", "/%2E%2E%2Fsecret.txt", "/sub/../../secret.txt"),
        *("/sub/%2e%2e/%2e%2e/secret.txt", "/..\\secret.txt", "//secret.txt", "/%00", "/bytes.bin%00.txt", "/%ff"),
        *("/out.txt", "/outside/secret.txt", "/loop", "/.hidden", "/pipe", "/sub/", "/bytes.bin/", "/%5b"),
        *("http://[/bytes.bin", "*"),
    ],
)
def test_only_files_of_the_folder(server, folder, target):
    (folder.parent / "secret.txt").write_text("secret")
    (folder / ".hidden").write_text("secret")
    (folder / "sub").mkdir()
    (folder / "out.txt").symlink_to(folder.parent / "secret.txt")
    (folder / "outside").symlink_to(folder.parent)
    (folder / "loop").symlink_to(folder / "loop")
    os.mkfifo(folder / "pipe")
    answer = ask(server, target)
    assert answer.status == 404 and b"secret" not in answer.body


def test_a_folder_shows_its_page(server, folder):
    (folder / "sub").mkdir()
    for place in (folder, folder / "sub"):
        (place / "index.html").write_text(f"page of {place.name}")
    assert ask(server, "/").body == b"page of www" and ask(server, "/sub/?level=1").body == b"page of sub"
    assert ask(server, "/").headers["Content-Type"].startswith("text/html")


def test_the_name_of_a_folder_leads_to_its_page(server, folder):
    (folder / "a b").mkdir()
    (folder / "a b" / "index.html").write_text("page")
    for query in ("", "?level=1&x=%2F"):
        answer = ask(server, f"/a%20b{query}")
        assert answer.status == 302 and answer.headers["Location"] == f"/a%20b/{query}"
    assert ask(server, "/a%20b/").body == b"page"
    for target in ("//a%20b", "//evil.example/..", "/..", "/missing", "http://evil.example"):
        assert ask(server, target).headers["Location"] in (None, "/a%20b/")


def test_a_folder_without_a_page_names_its_scenes(server, folder):
    (folder / "<b>&.pd4").write_bytes(b"")
    (folder / ".hidden.pd4").write_bytes(b"")
    for name in ("packed", "empty", "scenes"):
        (folder / name).mkdir()
    (folder / "packed" / "index.html").write_text("page")
    answer = ask(server, "/")
    assert answer.status == 200 and answer.headers["Content-Type"].startswith("text/html")
    links = re.findall(r'href="([^"]*)">([^<]*)<', answer.body.decode())
    assert links == [("./%3Cb%3E%26.pd4", "&lt;b&gt;&amp;.pd4"), ("./packed/index.html", "packed/index.html"),
                     ("./scene.pd4", "scene.pd4")]  # fmt: skip
    assert ask(server, "/", "HEAD").body == b"" and ask(server, "/empty/").status == 404


@pytest.mark.parametrize(("host", "shown"), [("0.0.0.0", "127.0.0.1"), ("::", "[::1]")])
def test_the_address_that_is_told_can_be_opened(folder, host, shown):
    try:
        server = Server(folder, host)
    except DeliveryError:
        pytest.skip(f"no network with {host}")
    with server, server.running():
        assert server.url == f"http://{shown}:{server.server_address[1]}/"
        with urllib.request.urlopen(server.url + "bytes.bin", timeout=10) as response:
            assert response.read() == CONTENT


def test_pages_and_scripts_are_compressed_for_who_takes_that(server, folder):
    text = b"let a = 1;\n" * 500
    (folder / "a.js").write_bytes(text)
    (folder / "long.js").write_bytes(text * 200)
    plain = ask(server, "/a.js")
    assert plain.body == text and plain.headers["Vary"] == "Accept-Encoding"
    zipped = ask(server, "/a.js", Accept_Encoding="br, gzip")
    assert zipped.headers["Content-Encoding"] == "gzip" and gzip.decompress(zipped.body) == text
    assert zipped.headers["ETag"] != plain.headers["ETag"] and len(zipped.body) < 200
    again = ask(server, "/a.js", Accept_Encoding="gzip", If_None_Match=zipped.headers["ETag"])
    assert again.status == 304
    assert ask(server, "/a.js", "HEAD", Accept_Encoding="gzip").headers["Content-Length"] == str(len(zipped.body))
    assert ask(server, "/a.js", Accept_Encoding="gzip", Range="bytes=4-8").body == text[4:9]
    for name in ("/long.js", "/bytes.bin"):
        assert "Content-Encoding" not in ask(server, name, Accept_Encoding="gzip").headers


def test_links_and_odd_names_inside_the_folder_are_served(server, folder):
    (folder / "a b%ü.txt").write_text("here")
    (folder / "link.txt").symlink_to("a b%ü.txt")
    assert ask(server, server.url_of("a b%ü.txt").removeprefix(server.url.rstrip("/"))).body == b"here"
    assert ask(server, "/link.txt?query#fragment").body == b"here"


def test_a_connection_serves_several_requests(server):
    connection = http.client.HTTPConnection(*server.server_address[:2], timeout=10)
    for i in range(5):
        connection.request("GET", "/bytes.bin", headers={"Range": f"bytes={i}-{i}"})
        assert connection.getresponse().read() == CONTENT[i : i + 1]
    connection.close()


SMUGGLED = b"GET /scene.pd4 HTTP/1.1\r\nHost: x\r\n\r\n"


@pytest.mark.parametrize("method", ["GET", "HEAD", "OPTIONS", "POST", "TRACE"])
@pytest.mark.parametrize(
    "field",
    ["Content-Length: {}", "content-length:{}", "Content-Length : {}", "Content-Length\t: {}", ": {}",
     "Transfer-Encoding: chunked", "Transfer-Encoding : chunked", "Transfer-Encoding: identity",
     "Accept: a\r\n Content-Length: {}", "X\rContent-Length: {}", "no field at all\r\nContent-Length: {}",
     "\x0bContent-Length: {}", "Host: y\r\nContent-Length: 0"],
)  # fmt: skip
def test_a_body_is_not_the_next_request(server, method, field):
    """However it is announced: the server reads no body, so it ends the connection."""
    head = f"{method} /bytes.bin HTTP/1.1\r\nHost: x\r\n{field.format(len(SMUGGLED))}\r\n\r\n"
    received = told(server, head.encode("latin-1") + SMUGGLED)
    assert received.count(b"HTTP/1.1 ") <= 1 and b"scene" not in received


def test_a_body_that_drips_is_not_waited_for(server):
    received = told(server, b"POST /bytes.bin HTTP/1.1\r\nHost: x\r\nContent-Length: 1000000000\r\n\r\nx")
    assert received.count(b"HTTP/1.1 ") <= 1


@pytest.fixture
def private(folder):
    with Server(folder, private=True) as served, served.running():
        yield served


@pytest.mark.parametrize("host", ["127.0.0.1:{}", "localhost:{}", "LOCALHOST:{}"])
def test_a_private_server_answers_its_own_pages(private, host):
    own = host.format(private.server_address[1])
    for origin in ({}, {"Origin": f"http://{own.lower()}"}):
        answer = ask(private, "/bytes.bin", Host=own, **origin)
        assert answer.status == 200 and answer.body == CONTENT
        assert answer.headers["Access-Control-Allow-Origin"] is None
        assert answer.headers["Cross-Origin-Resource-Policy"] == "same-origin"
    assert "Access-Control-Allow-Headers" not in ask(private, "/bytes.bin", "OPTIONS", Host=own).headers


@pytest.mark.parametrize(
    "headers",
    [{"Host": "evil.example:{}"}, {"Host": "127.0.0.1"}, {"Host": "127.0.0.1:1"}, {"Host": ""},
     {"Host": "127.0.0.1.evil.example:{}"}, {"Origin": "http://evil.example"}, {"Origin": "null"},
     {"Origin": "http://127.0.0.1:1"}, {"Origin": "https://127.0.0.1:{}"}],
)  # fmt: skip
@pytest.mark.parametrize("method", ["GET", "HEAD", "OPTIONS"])
def test_a_private_server_answers_no_other_site(private, method, headers):
    """Not under a name that a site gives this machine, and not to a page of another origin."""
    given = {name: value.format(private.server_address[1]) for name, value in headers.items()}
    answer = ask(private, "/bytes.bin", method, **given)
    assert answer.status == 421 and CONTENT[:9] not in answer.body
    assert answer.headers["Access-Control-Allow-Origin"] is None


@pytest.mark.parametrize(
    ("target", "field"),
    [("/bytes.bin", "Origin: http://{}\r\nOrigin: http://evil.example"), ("http://x/bytes.bin", "A: b")],
)
def test_a_private_server_takes_no_request_that_names_two_sites(private, target, field):
    own = "{}:{}".format(*private.server_address[:2])
    fields = f"Host: {own}\r\n{field.format(own)}\r\nConnection: close"
    assert told(private, f"GET {target} HTTP/1.1\r\n{fields}\r\n\r\n".encode()).startswith(b"HTTP/1.1 4")


def test_a_file_that_shrinks_while_it_is_sent_cuts_the_answer(folder, monkeypatch):
    link, changed, blocks = Link(1e6), threading.Event(), []

    def cross(size):
        blocks.append(size)
        assert len(blocks) < 3 or changed.wait(10)

    monkeypatch.setattr(link, "cross", cross)
    (folder / "long.bin").write_bytes(bytes(40_000))
    with Server(folder, link=link) as server, server.running():
        connection = http.client.HTTPConnection(*server.server_address[:2], timeout=10)
        connection.request("GET", "/long.bin")
        response = connection.getresponse()
        response.read(1000)
        (folder / "long.bin").write_bytes(b"new")
        changed.set()
        with pytest.raises(http.client.IncompleteRead):
            response.read()
        connection.close()


def test_the_folder_and_the_address_must_be_usable(folder, server):
    with pytest.raises(DeliveryError, match="not a folder"):
        Server(folder / "bytes.bin")
    for host, port in (server.server_address[:2], ("203.0.113.77", 0), ("no such host", 0), ("ä..b", 0)):
        with pytest.raises(DeliveryError, match="cannot listen"):
            Server(folder, host, port)


def test_request_lines_cannot_act_on_the_terminal(folder):
    lines: list[str] = []
    with Server(folder, log=lines.append) as server, server.running():
        told(server, b"GET /\x1b[31m\x9b HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n")
    assert len(lines) == 1 and lines[0].isprintable() and "404" in lines[0]


@pytest.mark.parametrize(
    ("request_line", "status"),
    [
        ("GET / HTTP/9.9", 505),
        ("GET / HTTP/x", 400),
        ("nonsense", 400),
        ("BREW / HTTP/1.1", 501),
        ("GET " + "/" * 70_000, 414),
    ],
)
def test_what_is_no_request_is_refused_like_any_other(server, request_line, status):
    answer = told(server, f"{request_line}\r\n\r\n".encode()).decode()
    assert answer.startswith(f"HTTP/1.1 {status} ") and "Access-Control-Allow-Origin: *" in answer
    assert answer.endswith(f"\r\n\r\n{status} {HTTPStatus(status).phrase}\n")


def test_a_request_that_drips_is_left(folder, monkeypatch):
    monkeypatch.setattr("pd4dgs_codec.web.server.IDLE_SECONDS", 0.2)
    with Server(folder).running() as server:
        with socket.create_connection(server.server_address[:2], timeout=20) as client:
            with contextlib.suppress(OSError):
                for _ in range(1000):  # 20 s of header, a byte at a time
                    client.sendall(b"x")
                    time.sleep(0.02)
                pytest.fail("the server waits for the whole of it")


# -- the command; wrong options are cases of tests/cli/test_bad_input.py -----------------------------------------------


def start(*argv: object) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "pd4dgs_codec", "serve", *map(str, argv)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_the_first_line_is_the_url_and_a_signal_ends_it(folder, number):
    process = start(folder, "--port", 0, "-v")
    url = process.stdout.readline().strip()
    with urllib.request.urlopen(url + "bytes.bin", timeout=10) as response:
        assert len(response.read()) == 1000
    process.send_signal(number)
    out, err = process.communicate(timeout=10)
    assert process.returncode == 0 and out == "" and "GET /bytes.bin" in err


def test_json_rate_and_latency(folder):
    process = start(folder, "--port", 0, "--rate", "500k", "--latency", "20ms", "--json")
    told = json.loads(process.stdout.readline())
    process.terminate()
    process.communicate(timeout=10)
    assert told["url"].startswith("http://127.0.0.1:") and told["rate"] == 5e5 and told["latency"] == 0.02
