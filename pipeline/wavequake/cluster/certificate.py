"""One certificate for one run: only who holds its key can talk to the run's scheduler and workers.

Scheduler, workers and client show the same certificate, which signs itself, and trust no other. Dask runs
what a connection sends it: whoever may connect runs programs as the user.
"""

import datetime
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, NamedTuple

from wavequake.errors import UserError

if TYPE_CHECKING:
    from distributed.security import Security

# Clocks of a cluster differ, and jump; as the key dies with its run, the certificate need not expire.
_FROM = datetime.datetime(1970, 1, 1)
_UNTIL = datetime.datetime(9999, 12, 31, 23, 59, 59)  # "no date" of RFC 5280, section 4.1.2.5


class Certificate(NamedTuple):
    """A certificate and its private key, as PEM."""

    certificate: str
    key: str


def make_certificate() -> Certificate:
    """Return a new certificate that signs itself, with a key on the curve P-256 (quick to make)."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import NameOID

    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "wavequake-run")])
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(_FROM)
        .not_valid_after(_UNTIL)
        .sign(key, hashes.SHA256())
    )
    pem = serialization.Encoding.PEM
    secret = key.private_bytes(pem, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    return Certificate(certificate.public_bytes(pem).decode(), secret.decode())


def make_security(certificate: Certificate) -> "Security":
    """Return Dask's settings of connections between holders of `certificate`, which stays in memory."""
    from distributed.security import Security

    public, key = certificate
    return Security(
        require_encryption=True,
        tls_ca_file=public,
        **{f"tls_{role}_cert": public for role in ("client", "scheduler", "worker")},
        **{f"tls_{role}_key": key for role in ("client", "scheduler", "worker")},
    )


@contextmanager
def certificate_file(folder: Path) -> Iterator[Path]:
    """Write a new certificate and its key into one file that only the user can read, and remove it at last.

    Raises
    ------
    UserError
        If nothing can be written in `folder`.
    """
    try:
        kept = TemporaryDirectory(prefix=".wavequake-run-", dir=folder)  # mode 0700
    except OSError as error:
        raise UserError(
            f"The certificate of this run cannot be written in {folder} ({error.strerror}): "
            "`shared_directory` in the cluster file must name a folder that this machine and the jobs share."
        ) from None
    with kept as name:
        file = Path(name) / "run.pem"
        file.write_text("".join(make_certificate()), encoding="ascii")
        yield file
