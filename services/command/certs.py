"""`penumbra certs`: a certificate authority of the cell, and a certificate for every participant of its bus."""

from __future__ import annotations

import datetime
import ipaddress
import os
from collections.abc import Iterable, Sequence
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from penumbra.services import flags
from penumbra.shared.contract import access
from penumbra.shared.runtime import bus

CA_DAYS = 3650
DAYS = 825
"""Validity [days] of a certificate; then `penumbra certs --force` makes all of them again."""
SKEW = datetime.timedelta(hours=1)
"""Time by which certificates are valid before their creation: the clocks of a cell's machines differ."""
LOCAL = ("localhost", "127.0.0.1", "::1", "router")
"""Names that a router always has: this machine's, and the one that Compose gives it."""


@flags.command(
    "certs",
    f"Makes a certificate authority and a certificate for each of {', '.join(access.HOLDERS)}. Each process needs ca.pem and its "
    "two files, no more: keep ca-key.pem off the robots.",
    flags.Option("--out", type=Path, default=Path("certs"), metavar="FOLDER", help="where to"),
    flags.Option(
        "--hosts",
        takes="many",
        metavar="NAME ...",
        help=f"names and addresses at which routers are reached, besides {', '.join(LOCAL)}",
    ),
    flags.Option("--force", is_flag=True, help="replace existing certificates, which then become invalid"),
    example="penumbra certs --out certs --hosts cell-7.example 192.168.0.7",
)
def main(options: flags.Options) -> None:
    """Write the certificates."""
    make(options.out, options.hosts, options.force)
    print(f"{options.out}: {len(access.HOLDERS)} certificates for {DAYS} days: penumbra up --secure {options.out}")


def make(folder: Path, hosts: Sequence[str] = (), force: bool = False, names: Iterable[str] = access.HOLDERS) -> None:
    """Write ca.pem and ca-key.pem, and NAME.pem and NAME-key.pem for each name; only the user can read them.

    hosts: names and addresses of routers. The keys are elliptic (P-256), which every TLS library accepts. Only the router's
    certificate is valid for a server: no other one passes for a router. Raises BusError if files exist already or cannot be
    written.
    """
    names = tuple(names)
    files = [path for name in ("ca", *names) for path in (folder / f"{name}.pem", folder / f"{name}-key.pem")]
    there = [path.name for path in files if path.exists()]
    if there and not force:
        more = " …" if len(there) > 3 else ""
        raise bus.BusError(f"{folder} holds {', '.join(there[:3])}{more}: give another --out, or --force to replace all of them")
    alternatives = [_alternative(host) for host in dict.fromkeys((*LOCAL, *hosts))]
    ca_key = ec.generate_private_key(ec.SECP256R1())
    ca_name = _name("Penumbra CA")
    ca = (
        _builder(ca_name, ca_name, ca_key, CA_DAYS)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage(signs_certificates=True), critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(ca_key.public_key()), critical=False)
        .sign(ca_key, hashes.SHA256())
    )
    issuer = x509.AuthorityKeyIdentifier.from_issuer_public_key(ca_key.public_key())
    made = [("ca", ca_key, ca)]
    for name in names:
        key = ec.generate_private_key(ec.SECP256R1())
        purposes = [ExtendedKeyUsageOID.CLIENT_AUTH]
        builder = _builder(_name(name), ca_name, key, DAYS)
        if name == access.ROUTER:
            purposes.append(ExtendedKeyUsageOID.SERVER_AUTH)
            builder = builder.add_extension(x509.SubjectAlternativeName(alternatives), critical=False)
        builder = (
            builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(_usage(signs_certificates=False), critical=True)
            .add_extension(x509.ExtendedKeyUsage(purposes), critical=False)
            .add_extension(issuer, critical=False)
        )
        made.append((name, key, builder.sign(ca_key, hashes.SHA256())))
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        for name, key, certificate in made:
            pem = key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
            _write(folder / f"{name}-key.pem", pem)
            _write(folder / f"{name}.pem", certificate.public_bytes(serialization.Encoding.PEM))
    except OSError as error:
        raise bus.BusError(f"{error.filename} cannot be written ({error.strerror}): give another --out") from None


def _builder(subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePrivateKey, days: int) -> x509.CertificateBuilder:
    now = datetime.datetime.now(datetime.UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - SKEW)
        .not_valid_after(now + datetime.timedelta(days=days))
    )


def _name(common: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common)])


def _usage(signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _alternative(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        pass
    try:
        if not host.strip() or any(letter in host for letter in "/: "):
            raise ValueError
        return x509.DNSName(host)
    except ValueError:
        raise bus.BusError(f"--hosts: expected a host's name or IP address without protocol and port, got {host!r}") from None


def _write(path: Path, data: bytes) -> None:
    """Replace `path` by a complete file that others can never read, not even briefly."""
    part = path.with_name(f".{path.name}.part")
    part.unlink(missing_ok=True)
    with open(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
        file.write(data)
    part.replace(path)
