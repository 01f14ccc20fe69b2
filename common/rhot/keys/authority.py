"""A rig's own certificate authority, by the `cryptography` package: ECDSA over P-256, X.509 version 3.

Certificates begin in 2020, whenever they are made: a Raspberry Pi has no clock of its own and may start years in the
past, and would then trust nobody. They end after ten years, the authority after twenty.
"""

from __future__ import annotations

import datetime as dt
import ipaddress
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from rhot.errors import ConfigError

_LABEL: Final = "[A-Za-z0-9]([A-Za-z0-9-]{0,61}[A-Za-z0-9])?"
_HOST_NAME: Final = re.compile(rf"{_LABEL}(\.{_LABEL})*")
"""RFC 1123, section 2.1."""
_BEGIN: Final = dt.datetime(2020, 1, 1, tzinfo=dt.UTC)
_EARLIEST: Final = dt.datetime(2026, 1, 1, tzinfo=dt.UTC)
"""Before this program was made."""
_YEARS: Final = 10
_AUTHORITY_YEARS: Final = 20


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
    end = _years_from_now(_AUTHORITY_YEARS)
    certificate = (
        _builder(name, name, key.public_key(), end)
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
        _builder(_name(name), issuer.subject, key.public_key(), end)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(sign=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage([purpose]), critical=False)
    )
    if addresses:
        names = x509.SubjectAlternativeName([_alternative(address) for address in addresses])
        builder = builder.add_extension(names, critical=False)
    return _pair(builder.sign(signing, hashes.SHA256()), key, end)


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey, end: dt.datetime
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(_BEGIN)
        .not_valid_after(end)
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
