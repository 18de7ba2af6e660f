"""Listening beyond a Unix socket, for programs that serve a station to other programs: token, certificate, options."""

from __future__ import annotations

import argparse
import secrets
import socket
import ssl
import struct
from ipaddress import ip_address
from pathlib import Path

from runtime.core.durable_files import write_durably
from runtime.core.errors import ConfigurationError

_LEAST_TOKEN = 32  # characters: a file that was emptied admits nobody
_SEND_S = 5  # [s]


def add_listener_arguments(parser: argparse.ArgumentParser, port: int) -> None:
    """Add the options of the address, of the certificate and of the station to a command line."""
    parser.add_argument("station", help="name of a station of this computer")
    parser.add_argument("--data-dir", type=Path, metavar="DIR", help="$EVA_DATA_DIR or ./data if not given")
    parser.add_argument(
        "--host", default="127.0.0.1", help="address to listen at; beyond this machine it needs a certificate"
    )
    parser.add_argument("--port", type=int, default=port, help="0 takes a free one")
    parser.add_argument("--certificate", type=Path, help="certificate with its chain, as PEM")
    parser.add_argument("--key", type=Path, help="its private key, as PEM")
    parser.add_argument("--lifeline", action="store_true", help="end when standard input ends")


def get_or_create_token(station_dir: Path, file_name: str) -> str:
    """Return the token in a file of the station, which is made once, and which only this account can read.

    Raises:
        ConfigurationError: Other accounts can read the file.
    """
    file = station_dir / file_name
    if not file.exists() or len(file.read_bytes().strip()) < _LEAST_TOKEN:
        station_dir.mkdir(parents=True, exist_ok=True)
        write_durably(file, f"{secrets.token_urlsafe(24)}\n".encode(), mode=0o600)
    if file.stat().st_mode & 0o077:
        raise ConfigurationError(
            f"{file} can be read by other accounts; allowed: mode 0600, or remove it for another"
        )
    return file.read_text("ascii").strip()


def limit_sending(connection: socket.socket) -> None:
    """Let a send on a blocking connection fail if its peer has taken nothing for `_SEND_S` [s].

    Without it a peer that does not read blocks the sender, and with it the keepalive of its websocket, for as long as
    the peer exists.
    """
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, struct.pack("ll", _SEND_S, 0))


def make_ssl_context(options: argparse.Namespace) -> ssl.SSLContext | None:
    """Return the context of the certificate, None on loopback without one.

    Raises:
        ConfigurationError: Without a certificate beyond this machine, or one that cannot be used.
    """
    try:
        loopback = ip_address(options.host).is_loopback
    except ValueError:
        raise ConfigurationError(
            f"--host {options.host!r:.100}: must be an address in numbers, as 127.0.0.1"
        ) from None
    if options.certificate is None:
        if not loopback:
            raise ConfigurationError(
                f"--host {options.host}: beyond this machine it needs --certificate and --key; allowed without: "
                "127.0.0.1"
            )
        return None
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        context.load_cert_chain(options.certificate, options.key)
    except (OSError, ssl.SSLError) as error:
        raise ConfigurationError(f"--certificate {options.certificate}: {error}") from None
    return context
