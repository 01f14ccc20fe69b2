"""Making certificates for a rig: all at once, one more, one less."""

from __future__ import annotations

import datetime as dt
import io
import ipaddress
import re
import tarfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from rhot.atomic_file import write_atomic
from rhot.errors import ConfigError
from rhot.keys import (
    AUTHORITY,
    KEYS_FOLDER,
    OPERATOR,
    ROLES_FILE,
    ROUTER,
    SERVICES,
    Holder,
    RolesFile,
    certificate_file,
    key_file,
    load_roles,
    write_private,
)
from rhot.rig.folder import COLORS_FILE, RIG_FILE, load_config, write_json_model
from rhot.rig.toml_edit import change_rig_file, with_values

# A rig's own certificate authority, by the `cryptography` package: ECDSA over P-256, X.509 version 3.
#
# Certificates begin in 2020, whenever they are made: a Raspberry Pi has no clock of its own and may start years in the
# past, and would then trust nobody. They end after ten years, the authority after twenty.

_LABEL: Final = "[A-Za-z0-9]([A-Za-z0-9-]{0,61}[A-Za-z0-9])?"
_HOST_NAME: Final = re.compile(rf"{_LABEL}(\.{_LABEL})*")
"""RFC 1123, section 2.1."""
_BEGIN: Final = dt.datetime(2020, 1, 1, tzinfo=dt.UTC)
_EARLIEST: Final = dt.datetime(2026, 1, 1, tzinfo=dt.UTC)
"""Before this program was made."""
_YEARS: Final = 10


@dataclass(frozen=True, slots=True)
class Pair:
    """A certificate and its private key, PEM, and the certificate's last day, ISO 8601."""

    certificate: bytes
    key: bytes
    expires: str


def new_authority(rig: str) -> Pair:
    """Return a new authority that signs for one rig."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = _name(f"RHOT rig {rig}"[:64])
    authority_years = 20
    end = _years_from_now(authority_years)
    certificate = (
        _builder(name, name, key.public_key(), key.public_key(), end)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage(sign=True), critical=True)
        .sign(key, hashes.SHA256())
    )
    return _pair(certificate, key, end)


def new_certificate(authority: Pair, name: str, addresses: Sequence[str] = ()) -> Pair:
    """Return a certificate for one holder.

    Args:
        authority: that signs it.
        name: common name, by which the router knows the holder's role.
        addresses: of the router: host names and IP addresses by which clients reach it. Only with addresses may the
            certificate serve; only without may it connect.

    Raises:
        ConfigError: the authority's files are no certificate and key.
    """
    try:
        issuer = x509.load_pem_x509_certificate(authority.certificate)
        signing = serialization.load_pem_private_key(authority.key, None)
    except ValueError as error:
        raise ConfigError(f"the rig's authority cannot be used: {error}") from error
    if not isinstance(signing, ec.EllipticCurvePrivateKey):
        raise ConfigError("the rig's authority cannot be used: its key is not one of `rhot keys make`")
    key = ec.generate_private_key(ec.SECP256R1())
    end = min(_years_from_now(_YEARS), issuer.not_valid_after_utc)
    purpose = ExtendedKeyUsageOID.SERVER_AUTH if addresses else ExtendedKeyUsageOID.CLIENT_AUTH
    builder = (
        _builder(_name(name), issuer.subject, key.public_key(), signing.public_key(), end)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(sign=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage([purpose]), critical=False)
    )
    if addresses:
        names = x509.SubjectAlternativeName([_alternative(address) for address in addresses])
        builder = builder.add_extension(names, critical=False)
    return _pair(builder.sign(signing, hashes.SHA256()), key, end)


def _builder(
    subject: x509.Name,
    issuer: x509.Name,
    key: ec.EllipticCurvePublicKey,
    signing: ec.EllipticCurvePublicKey,
    end: dt.datetime,
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(_BEGIN)
        .not_valid_after(end)
        # RFC 5280, 4.2.1.1 and 2: programs that are strict, Python from 3.13 on among them, refuse one without.
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(signing), critical=False)
    )


def _usage(*, sign: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not sign,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=sign,
        crl_sign=sign,
        encipher_only=False,
        decipher_only=False,
    )


def _name(common_name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _alternative(address: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(address))
    except ValueError:
        if not _HOST_NAME.fullmatch(address):
            raise ConfigError(
                f"--address {address or '(empty)'}: neither an IP address nor a host name; give one such as "
                "192.168.1.10 or pc.local, without protocol and port"
            ) from None
        return x509.DNSName(address)


def _years_from_now(years: int) -> dt.datetime:
    """Return the end of what is made now.

    Raises:
        ConfigError: the clock of this machine shows a time before this program was made.
    """
    now = dt.datetime.now(dt.UTC).replace(microsecond=0)
    if now < _EARLIEST:
        raise ConfigError(
            f"the clock of this machine says {now:%Y-%m-%d}: certificates would be over before they are used. Set it "
            "(`timedatectl`, or connect to a network with time), then make them again"
        )
    return now + dt.timedelta(days=365 * years)


def _pair(certificate: x509.Certificate, key: ec.EllipticCurvePrivateKey, end: dt.datetime) -> Pair:
    private = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    return Pair(certificate.public_bytes(serialization.Encoding.PEM), private, end.date().isoformat())


PORT: Final = 7447
_LOCAL: Final = ("127.0.0.1", "::1", "localhost")


def make_keys(rig_path: Path, addresses: Sequence[str], port: int | None = None) -> tuple[Path, ...]:
    """Make a rig's authority, its certificates and a bundle for each camera, and switch TLS on in `rig.toml`.

    Args:
        rig_path: rig folder, on the machine of the router.
        addresses: by which the other machines reach the router; the first stands in their `rig.toml`.
        port: of the router; None = that of `[bus] listen`.

    Returns:
        the bundles to bring to the other machines.

    Raises:
        ConfigError: there are keys already, an address is none, or something cannot be written.
    """
    config = load_config(rig_path)
    folder = rig_path / KEYS_FOLDER
    if certificate_file(folder, AUTHORITY).exists():
        raise ConfigError(
            f"{folder} holds keys already: `rhot keys add` makes one more. To start over, move the folder away; all "
            "machines then need new ones"
        )
    port = port or _port(config.bus.listen)
    authority = new_authority(config.name)
    # Before anything is written: an address may be none.
    router = new_certificate(authority, ROUTER, [*addresses, *_LOCAL])
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        folder.chmod(0o700)
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be made: {error.strerror or error}") from error
    _write_pair(folder, AUTHORITY, authority)
    _write_pair(folder, ROUTER, router)
    holders = {ROUTER: Holder(role="router", expires=router.expires)}
    for name, holder in {
        SERVICES: Holder(role="services"),
        OPERATOR: Holder(role="operator"),
        **{f"camera-{camera}": Holder(role="camera", camera=camera) for camera in config.cameras},
    }.items():
        holders[name] = _signed(folder, authority, name, holder)
    write_json_model(folder / ROLES_FILE, RolesFile(holders=holders))
    change_rig_file(
        rig_path,
        {
            ("bus",): {
                "mode": "client",
                "connect": [f"tls/{_bracketed(addresses[0])}:{port}"],
                "listen": [f"tls/[::]:{port}" if ":" in addresses[0] else f"tls/0.0.0.0:{port}"],
                "tls": True,
            }
        },
    )
    return tuple(write_bundle(rig_path, name) for name, holder in holders.items() if holder.role == "camera")


def _port(listen: Sequence[str]) -> int:
    """Return the port on which a router listens already, else the usual one."""
    found = [re.search(r":(\d+)(?:$|[?#])", endpoint) for endpoint in listen]
    return next((int(each.group(1)) for each in found if each is not None), PORT)


def add_holder(rig_path: Path, name: str, holder: Holder) -> Path:
    """Make one more certificate and return its bundle; the router knows it when it is started again.

    Raises:
        ConfigError: the name is taken, there is no authority here, or something cannot be written.
    """
    folder = rig_path / KEYS_FOLDER
    roles = load_roles(folder)
    if name in roles.holders or name == AUTHORITY:
        raise ConfigError(f"{name} is taken; `rhot keys remove {name}` frees the name")
    signed = _signed(folder, _authority(folder), name, holder)
    write_json_model(folder / ROLES_FILE, RolesFile(holders={**roles.holders, name: signed}))
    return write_bundle(rig_path, name)


def remove_holder(rig_path: Path, name: str) -> None:
    """Take a certificate's rights away; the router lets it do nothing any more when it is started again.

    Raises:
        ConfigError: there is none of this name, or it is the router's.
    """
    folder = rig_path / KEYS_FOLDER
    roles = load_roles(folder)
    if name not in roles.holders or name == ROUTER:
        known = ", ".join(each for each in roles.holders if each != ROUTER)
        raise ConfigError(f"{name}: no certificate of that name can be removed; there are {known}")
    left = {each: holder for each, holder in roles.holders.items() if each != name}
    write_json_model(folder / ROLES_FILE, RolesFile(holders=left))
    for file in (certificate_file(folder, name), key_file(folder, name), bundle_file(folder, name)):
        file.unlink(missing_ok=True)


def bundle_file(folder: Path, name: str) -> Path:
    """Return where the bundle for another machine lies."""
    return folder / f"{name}.tar"


def write_bundle(rig_path: Path, name: str) -> Path:
    """Write everything that a machine needs to take part as `name`: rig.toml, colours, certificates; return the file.

    It holds a private key: whoever has the file is `name`.
    """
    folder = rig_path / KEYS_FOLDER
    text = (rig_path / RIG_FILE).read_text(encoding="utf-8")
    role = load_roles(folder).holders[name].role
    content: dict[str, bytes] = {
        RIG_FILE: with_values(text, ("bus",), {"identity": name if role in ("operator", "tool") else ""}).encode(),
        f"{KEYS_FOLDER}/{AUTHORITY}.pem": certificate_file(folder, AUTHORITY).read_bytes(),
        f"{KEYS_FOLDER}/{name}.pem": certificate_file(folder, name).read_bytes(),
        f"{KEYS_FOLDER}/{name}.key": key_file(folder, name).read_bytes(),
    }
    if (rig_path / COLORS_FILE).exists():
        content[COLORS_FILE] = (rig_path / COLORS_FILE).read_bytes()
    bundle = bundle_file(folder, name)
    write_private(bundle, _tar(content))
    return bundle


def _tar(content: Mapping[str, bytes]) -> bytes:
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w") as archive:
        for name, data in content.items():
            entry = tarfile.TarInfo(name)
            entry.size = len(data)
            entry.mode = 0o600
            archive.addfile(entry, io.BytesIO(data))
    return stream.getvalue()


def _signed(folder: Path, authority: Pair, name: str, holder: Holder) -> Holder:
    pair = new_certificate(authority, name)
    _write_pair(folder, name, pair)
    return holder.model_copy(update={"expires": pair.expires})


def _authority(folder: Path) -> Pair:
    try:
        return Pair(certificate_file(folder, AUTHORITY).read_bytes(), key_file(folder, AUTHORITY).read_bytes(), "")
    except OSError as error:
        raise ConfigError(
            f"{error.filename}: cannot be read; certificates are made on the machine of `rhot keys make`"
        ) from error


def _write_pair(folder: Path, name: str, pair: Pair) -> None:
    write_private(key_file(folder, name), pair.key)
    write_atomic(certificate_file(folder, name), pair.certificate)


def _bracketed(address: str) -> str:
    return f"[{address}]" if ":" in address else address
