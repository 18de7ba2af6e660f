"""What another computer answers at its ports, as JSON; to be run in a network namespace by root.

    ports HOST           `tcp`: where somebody listens; `refused`: how many TCP ports said that nobody does;
                         `udp`: from where anything came
    web ORIGIN PATH...   the status of each path without a session, and where it leads
    link HOST PORT       bytes that a stranger gets who speaks HTTP, ZMTP without keys, and ZMTP with keys that nobody
                         has enrolled: of ZMTP the messages alone

Asked with one of these after `python -m tests.e2e.scan`; it imports nothing of the product's.
"""

import http.client
import json
import select
import socket
import struct
import sys
import time

from tests.processes import PATIENCE_S

PORTS = range(1, 65536)
_AT_ONCE = 256
_LAST_S = 2.0  # for what is late
_SYN, _ACK, _RST = 0x02, 0x10, 0x04


def _sum(data):
    found = sum(struct.unpack(f"!{len(data) // 2}H", data))
    while found >> 16:
        found = (found & 0xFFFF) + (found >> 16)
    return ~found & 0xFFFF


def tcp(host):
    """A SYN to every port; those that are answered by SYN and ACK, and how many by RST."""
    own = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    own.connect((host, 9))
    here, there = socket.inet_aton(own.getsockname()[0]), socket.inet_aton(host)
    raw = socket.socket(socket.AF_INET, socket.SOCK_RAW, socket.IPPROTO_TCP)
    raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
    source = 44444
    listening: set[int] = set()
    refused: set[int] = set()

    def take(seconds):
        until = time.monotonic() + seconds
        while select.select([raw], [], [], max(0.0, until - time.monotonic()))[0]:
            packet, (sender, _) = raw.recvfrom(65535)
            head = (packet[0] & 15) * 4
            port, to, *_ = struct.unpack("!HH", packet[head : head + 4])
            if sender == host and to == source:
                (listening if packet[head + 13] & _SYN else refused).add(port)

    for port in PORTS:
        segment = struct.pack("!HHIIBBHHH", source, port, 1, 0, 5 << 4, _SYN, 1024, 0, 0)
        total = _sum(here + there + struct.pack("!BBH", 0, socket.IPPROTO_TCP, len(segment)) + segment)
        raw.sendto(segment[:16] + struct.pack("!H", total) + segment[18:], (host, 0))
        if port % _AT_ONCE == 0:
            take(0.0)
    take(_LAST_S)
    return sorted(listening), len(refused)


def udp(host):
    """A datagram to every port; those from which anything came."""
    asking = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    found = set()
    for port in PORTS:
        asking.sendto(b"\0" * 8, (host, port))
    while select.select([asking], [], [], _LAST_S)[0]:
        found.add(asking.recvfrom(65535)[1][1])
    return sorted(found)


def web(origin, paths):
    """What each path is answered to somebody without a session, with the head of where it leads."""
    host, _, port = origin.partition(":")
    found = {}
    for path in paths:
        call = http.client.HTTPConnection(host, int(port), timeout=PATIENCE_S)
        call.request("GET", path)
        answer = call.getresponse()
        found[path] = [answer.status, (answer.headers["Location"] or "").partition("?")[0]]
        call.close()
    return found


def link(host, port):
    """What strangers get at a port of the link."""
    import zmq

    with socket.create_connection((host, port), PATIENCE_S) as call:
        call.settimeout(PATIENCE_S)
        call.sendall(b"GET / HTTP/1.1\r\nHost: lab\r\n\r\n" + b"\0" * 64)
        got = b""
        try:
            while piece := call.recv(65536):
                got += piece
        except ConnectionResetError:  # cut off
            got += b""
    messages = []
    for keys in (False, True):
        asking: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.DEALER)
        asking.linger = 0
        if keys:
            asking.curve_publickey, asking.curve_secretkey = zmq.curve_keypair()
            asking.curve_serverkey = zmq.curve_keypair()[0]
        asking.connect(f"tcp://{host}:{port}")
        asking.send_multipart([b"hello", b"{}"])
        messages.append(len(asking.recv_multipart()) if asking.poll(round(1000 * _LAST_S)) else 0)
        asking.close()
    return {"http": got.hex(), "messages": messages}


def main(what, *given):
    """One of the three."""
    if what == "ports":
        listens, nobody = tcp(given[0])
        return {"tcp": listens, "refused": nobody, "udp": udp(given[0])}
    return web(given[0], given[1:]) if what == "web" else link(given[0], int(given[1]))


if __name__ == "__main__":
    print(json.dumps(main(*sys.argv[1:])))
