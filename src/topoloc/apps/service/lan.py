"""Access to a service from phones in the same network: a certificate and a token made on the spot,
and a link with its QR code."""

from __future__ import annotations

import ipaddress
import secrets
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import cv2
import numpy as np

from topoloc import MissingExtraError, TopolocError
from topoloc.apps.core_names import temporary_folder

_DAYS = 30  # that the certificate is valid
_ELSEWHERE = "192.0.2.1"  # of no machine (RFC 5737); nothing is sent to it
_BLOCKS = " ▄▀█"  # of two modules, light ones in the colour of the text
_WHITE, _RESET = "\033[97;40m", "\033[0m"  # on black, in terminals of any colours


@dataclass(frozen=True)
class LanFiles:
    """Files of a token, a certificate and its key."""

    token: str
    tls_cert: str
    tls_key: str


@contextmanager
def create_lan_files(addresses: list[str]) -> Iterator[LanFiles]:
    """Create a random token, and a certificate of these addresses that is its own authority, in a
    folder that only this user can read. They are removed in the end. Raises MissingExtraError:
    `cryptography` is not installed."""
    with MissingExtraError.on_import("a certificate for --lan needs {}", "lan"):
        certificate, key = _create_certificate(addresses)
    with temporary_folder("topoloc-lan-") as folder:
        contents = secrets.token_urlsafe(18).encode(), certificate, key
        paths = [folder / name for name in ("token", "cert.pem", "key.pem")]
        for path, content in zip(paths, contents, strict=True):
            path.touch(0o600)
            path.write_bytes(content)
        yield LanFiles(*map(str, paths))


def find_lan_addresses(host: str) -> list[str]:
    """Return the IPv4 addresses at which other machines reach `host`, the likeliest first. Raises
    TopolocError: there are none."""
    if host != "0.0.0.0":
        return [host]
    found = list[str]()
    with suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect((_ELSEWHERE, 9))
        found.append(probe.getsockname()[0])
    with suppress(OSError):
        found += socket.gethostbyname_ex(socket.gethostname())[2]
    usable = [one for one in dict.fromkeys(found) if not ipaddress.ip_address(one).is_loopback]
    if not usable:
        raise TopolocError(
            "--lan: this machine has no address in a network; connect it, or name one with --host"
        )
    return usable


def _create_certificate(addresses: list[str]) -> tuple[bytes, bytes]:
    """Return a certificate and its key (PEM)."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    key, now = ec.generate_private_key(ec.SECP256R1()), datetime.now(UTC)
    name = x509.Name([x509.NameAttribute(x509.oid.NameOID.COMMON_NAME, "topoloc")])
    names = [_general_name(one) for one in dict.fromkeys([*addresses, "127.0.0.1", "localhost"])]
    builder = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - timedelta(days=1))  # clocks of phones differ
        .not_valid_after(now + timedelta(days=_DAYS))
        .add_extension(x509.SubjectAlternativeName(names), critical=False)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(
            x509.ExtendedKeyUsage([x509.oid.ExtendedKeyUsageOID.SERVER_AUTH]), critical=False
        )
    )
    pem = serialization.Encoding.PEM
    form = serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    certificate = builder.sign(key, hashes.SHA256()).public_bytes(pem)
    return certificate, key.private_bytes(pem, *form)


def _general_name(host: str):  # no return type: cryptography is an extra
    from cryptography import x509

    with suppress(ValueError):
        return x509.IPAddress(ipaddress.ip_address(host))
    return x509.DNSName(host)


def print_links(addresses: list[str], port: int, token_file: str) -> None:
    """Print the links for phones, and the code of the first one if there is a terminal."""
    token = Path(token_file).read_text(encoding="utf-8").strip()
    shown = (f"[{one}]" if ":" in one else one for one in addresses)
    links = [f"https://{one}:{port}/#token={token}" for one in shown]
    code = [qr_text(links[0])] if sys.stderr.isatty() else []
    warning = "The browser warns of the certificate, which this service made itself: go on."
    text = "\n".join([*code, "On a phone in this network:", *links, warning])
    print(text, file=sys.stderr, flush=True)


def qr_text(text: str) -> str:
    """Return the QR code of a text as lines of half blocks, in black and white."""
    light = cv2.QRCodeEncoder.create().encode(text) > 0
    rows, columns = (np.flatnonzero(~light.all(axis=axis)) for axis in (1, 0))
    code = light[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    framed = np.pad(code, 4, constant_values=True)
    framed = np.pad(framed, ((0, len(framed) % 2), (0, 0)), constant_values=True)
    halves = 2 * framed[0::2].astype(int) + framed[1::2]
    return "\n".join(_WHITE + "".join(_BLOCKS[one] for one in row) + _RESET for row in halves)
