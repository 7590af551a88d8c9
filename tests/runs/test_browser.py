"""A page answers whom it should: this machine, or whoever has the token."""

from __future__ import annotations

import http.client
from collections.abc import Iterator
from contextlib import closing

import pytest

from robo_manip_baselines.runs.browser import Gate, PageOptions, require_viser, serve_page
from robo_manip_baselines.runs.errors import RequestError

TOKEN = "0123456789abcdef"
OPEN, GUARDED = Gate("127.0.0.1", None), Gate("0.0.0.0", TOKEN)


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.7", "::", "example.org", ""])
def test_another_address_needs_a_token(host: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RMB_TOKEN", raising=False)
    with pytest.raises(RequestError, match=r"could connect; .* --token [0-9a-f]{32}$"):
        PageOptions(host)
    assert PageOptions(host, token=TOKEN).secret == TOKEN
    monkeypatch.setenv("RMB_TOKEN", TOKEN)
    assert PageOptions(host).secret == TOKEN


@pytest.mark.parametrize("token", ["short", "0123456789abcde", "0123456789abcdef;", "ä" * 16])
def test_a_token_is_long_and_plain(token: str) -> None:
    with pytest.raises(RequestError, match=r"^--token: must be 16 or more letters, digits"):
        PageOptions(token=token)


@pytest.mark.parametrize("host", ["127.0.0.1:8080", "localhost:9000", "[::1]:8080", "LOCALHOST"])
def test_this_machine_may_look(host: str) -> None:
    assert OPEN.refusal("/", {"Host": host}) is None
    assert OPEN.refusal("/", {"Host": host, "Origin": f"http://{host}"}) is None


@pytest.mark.parametrize(
    "headers",
    [
        {},
        {"Host": "rebound.example:8080"},  # a name of another site that now leads here
        {"Host": "127.0.0.1:8080", "Origin": "http://elsewhere.example"},
        {"Host": "127.0.0.1:8080", "Origin": "http://127.0.0.1:9999"},
        {"Host": "127.0.0.1:8080", "Origin": "null"},
    ],
)
def test_other_websites_may_not(headers: dict[str, str]) -> None:
    answer = OPEN.refusal("/", headers)
    assert answer is not None
    assert answer[0] == 403


def test_a_token_opens_and_a_cookie_remembers_it() -> None:
    there = {"Host": "robot.local:8080"}
    for target in ("/", "/?token=", "/?token=0123456789abcdeg", f"/{TOKEN}", "/assets/x.js"):
        answer = GUARDED.refusal(target, there)
        assert answer is not None
        assert answer[0] == 403, target
    answer = GUARDED.refusal(f"/?token={TOKEN}", there)
    assert answer is not None
    status, headers, _ = answer
    assert (status, headers["Location"]) == (303, "/")
    cookie = headers["Set-Cookie"].partition(";")[0]
    assert "HttpOnly; SameSite=Strict" in headers["Set-Cookie"]
    assert GUARDED.refusal("/", {**there, "Cookie": f"other=1; {cookie}"}) is None
    for wrong in (cookie[:-1], "rmb_token_8081=" + TOKEN, "=;;"):
        assert GUARDED.refusal("/", {**there, "Cookie": wrong}) is not None
    elsewhere = {**there, "Cookie": cookie, "Origin": "http://elsewhere.example"}
    assert GUARDED.refusal("/", elsewhere) is not None


@pytest.mark.parametrize(
    ("gate", "target", "headers"),
    [
        (OPEN, "/", {"Host": "["}),
        (OPEN, "/", {"Host": "127.0.0.1", "Origin": "http://["}),
        (GUARDED, "//[", {"Host": "robot.local"}),
        (GUARDED, "/?token=\udcff", {"Host": "robot.local"}),  # a byte that is no text
        (GUARDED, "/", {"Host": "robot.local:80", "Cookie": 'rmb_token_80="\\303\\251"'}),
    ],
)
def test_malformed_requests_are_refused(gate: Gate, target: str, headers: dict[str, str]) -> None:
    answer = gate.refusal(target, headers)
    assert answer is not None
    assert answer[0] in (400, 403)


def test_a_missing_library_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("robo_manip_baselines.runs.browser.find_spec", lambda _: None)
    with pytest.raises(RequestError, match=r"needs viser, which is not installed: .*pip install"):
        require_viser("view")


@pytest.fixture(params=[None, TOKEN])
def page(request: pytest.FixtureRequest) -> Iterator[tuple[int, str]]:
    """Port and address of a page that is served."""
    pytest.importorskip("viser", reason="pip install viser")
    with serve_page(PageOptions(port=0, token=request.param), "Test") as (server, address):
        yield server.get_port(), address


def answer_to(port: int, target: str, **headers: str) -> tuple[int, bytes]:
    with closing(http.client.HTTPConnection("127.0.0.1", port, timeout=30.0)) as connection:
        connection.request("GET", target, headers=headers)
        response = connection.getresponse()
        return response.status, response.read()


@pytest.mark.long
def test_a_served_page_asks_its_gate(page: tuple[int, str]) -> None:
    port, address = page
    target = address.partition(f":{port}")[2]
    assert answer_to(port, "/", Host="rebound.example")[0] == 403
    socket = {"Upgrade": "websocket", "Connection": "Upgrade", "Origin": "http://elsewhere.example"}
    assert answer_to(port, "/", **socket)[0] == 403
    if TOKEN in target:
        assert answer_to(port, "/")[0] == 403
        assert answer_to(port, target)[0] == 303
        status, body = answer_to(port, "/", Cookie=f"rmb_token_{port}={TOKEN}")
    else:
        status, body = answer_to(port, target)
    assert status == 200
    assert b"<html" in body


@pytest.mark.long
def test_a_port_in_use_is_one_line(page: tuple[int, str]) -> None:
    with (
        pytest.raises(RequestError, match=r"--port \d+: Address already in use; choose another"),
        serve_page(PageOptions(port=page[0]), "Second"),
    ):
        pass


def test_an_address_that_is_none() -> None:
    options = PageOptions("203.0.113.1", token=TOKEN)  # of no machine (RFC 5737)
    pytest.importorskip("viser", reason="pip install viser")
    with pytest.raises(RequestError, match="choose another port"), serve_page(options, "Test"):
        pass
