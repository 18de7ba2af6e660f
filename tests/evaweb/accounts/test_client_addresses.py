"""The address of who asks is that of the connection, or what a declared proxy says; nobody writes one for himself."""

from ipaddress import ip_network

import pytest

from evaweb.accounts.client_addresses import client_address, client_key

PROXIES = [ip_network("127.0.0.1"), ip_network("10.1.0.0/16")]


@pytest.mark.parametrize(
    ("peer", "forwarded", "found"),
    [
        ("192.0.2.7", "", "192.0.2.7"),
        ("192.0.2.7", "198.51.100.1", "192.0.2.7"),
        ("127.0.0.1", "", "127.0.0.1"),
        ("127.0.0.1", "198.51.100.1", "198.51.100.1"),
        ("127.0.0.1", "1.1.1.1, 198.51.100.1", "198.51.100.1"),
        ("127.0.0.1", "1.1.1.1, 198.51.100.1, 10.1.2.3", "198.51.100.1"),
        ("127.0.0.1", "10.1.2.3", "10.1.2.3"),
        ("127.0.0.1", "unknown", "127.0.0.1"),
        ("127.0.0.1", "198.51.100.1, \x00", "127.0.0.1"),
        ("::ffff:127.0.0.1", "2001:db8::1", "2001:db8::1"),
        ("fe80::1%eth0", "", "fe80::1"),
        (None, "198.51.100.1", None),
        ("", "", None),
    ],
)
def test_the_last_that_a_proxy_of_ours_has_seen(rf, settings, peer, forwarded, found):
    settings.EVA_PROXIES = PROXIES
    request = rf.get("/", headers={"x-forwarded-for": forwarded} if forwarded else {})
    request.META["REMOTE_ADDR"] = peer
    assert client_address(request) == found


def test_without_a_declared_proxy_nothing_forwarded_is_believed(rf):
    request = rf.get("/", headers={"x-forwarded-for": "198.51.100.1"}, REMOTE_ADDR="127.0.0.1")
    assert client_address(request) == "127.0.0.1"


@pytest.mark.parametrize(
    ("peer", "forwarded", "found"),
    [
        ("192.0.2.7", [], "192.0.2.7"),
        ("192.0.2.7", ["198.51.100.1"], "192.0.2.7"),
        ("127.0.0.1", ["1.1.1.1", "198.51.100.1, 10.1.2.3"], "198.51.100.1"),
        ("::ffff:127.0.0.1", ["198.51.100.1"], "198.51.100.1"),
        ("2001:db8:1:2:3::4", [], "2001:db8:1:2::/64"),
        ("2001:db8:1:2:ffff::", [], "2001:db8:1:2::/64"),
        (None, [], "nowhere"),
    ],
)
def test_the_share_of_who_asks_is_that_of_the_address_and_of_a_whole_network_of_ipv6(
    settings, peer, forwarded, found
):
    settings.EVA_PROXIES = PROXIES
    headers = [(b"x-forwarded-for", value.encode()) for value in forwarded]
    assert client_key({"headers": headers, "client": [peer, 4000] if peer else None}) == found
