import socket

import pytest

from twofold.errors import TwofoldError
from twofold.viewer.server import LOOPBACK, choose_port, is_loopback, is_own_page


@pytest.fixture
def taken():
    with socket.socket() as one:
        one.bind((LOOPBACK, 0))
        one.listen()
        yield one.getsockname()[1]


def test_a_port_that_was_asked_for_and_is_taken_is_one_sentence(taken):
    with pytest.raises(TwofoldError, match=f"Port {taken} of 127.0.0.1 is taken by another program; choose another"):
        choose_port(LOOPBACK, taken)


def test_without_a_wish_the_next_free_port_is_taken(taken, monkeypatch):
    monkeypatch.setattr("twofold.viewer.server.FIRST_PORT", taken)
    assert taken < choose_port(LOOPBACK, None) < taken + 50
    monkeypatch.setattr("twofold.viewer.server.TRIED", 1)
    with pytest.raises(TwofoldError, match="are all taken"):
        choose_port(LOOPBACK, None)


@pytest.mark.parametrize("host", ["203.0.113.7", "no.such.host.invalid"])
def test_an_address_of_another_machine_is_one_sentence(host):
    with pytest.raises(TwofoldError, match=f"{host} is not an address of this machine"):
        choose_port(host, 8080)


@pytest.mark.parametrize("port", [-1, 70_000])
def test_numbers_that_are_no_ports_are_refused(port):
    with pytest.raises(TwofoldError, match="--port should be"):
        choose_port(LOOPBACK, port)


@pytest.mark.parametrize(("host", "alone"), [("::1", True), ("127.1.2.3", True), ("192.168.1.5", False), ("me", False)])
def test_loopback_addresses_are_known(host, alone):
    assert is_loopback(host) == alone


@pytest.mark.parametrize(
    ("origin", "own"),
    [
        (None, True), ("http://127.0.0.1:8080", True), ("http://127.0.0.1:8081", False),
        ("https://example.org", False), ("null", False),
    ],
)  # fmt: skip
def test_only_pages_of_this_server_may_connect(origin, own):
    assert is_own_page(origin, "127.0.0.1:8080") == own
