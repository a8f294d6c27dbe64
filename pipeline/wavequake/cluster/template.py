"""Cluster files: what a campaign must know of a cluster, as YAML that holds data and nothing else.

Their text ends up in job scripts and command lines, so that every entry has the form of what it names.
"""

from pathlib import Path
from typing import Annotated, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from wavequake.errors import UserError
from wavequake.user_files import read_text

Word = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.:@+/-]*$", max_length=255)]
PathText = Annotated[str, Field(pattern=r"^[A-Za-z0-9_.~/+@-]+$", max_length=4096)]
Directive = Annotated[str, Field(pattern=r"^--?[A-Za-z][A-Za-z-]*(=[A-Za-z0-9_.,:/+@&|%*\[\]-]+)?$")]
Memory = Annotated[str, Field(pattern=r"^[0-9]+(\.[0-9]+)? ?(MB|GB|MiB|GiB)$")]
WallTime = Annotated[str, Field(pattern=r"^([0-9]+-)?[0-9]{1,4}:[0-9]{2}:[0-9]{2}$")]


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Tls(_Section):
    """Files of the certificates by which scheduler, workers and the run know each other."""

    ca: PathText
    certificate: PathText
    key: PathText


class Slurm(_Section):
    """Jobs of Slurm, each with `processes` workers that share its memory."""

    interface: Word = "lo"
    partition: Word | None = None
    account: Word | None = None
    jobs: int = Field(default=1, ge=1)
    processes: int = Field(default=1, ge=1)
    memory: Memory = "4 GiB"
    walltime: WallTime = "01:00:00"
    directives: tuple[Directive, ...] = ()
    modules: tuple[Word, ...] = ()
    python: PathText | None = None
    local_directory: PathText | None = None
    log_directory: PathText | None = None
    shared_directory: PathText = "~"
    tls: Tls | None = None


class Ssh(_Section):
    """Hosts that are reached by ssh; the scheduler runs on the first."""

    hosts: tuple[Word, ...] = Field(min_length=1)
    processes: int = Field(default=1, ge=1)
    listen: Word = "127.0.0.1"
    interface: Word | None = None
    user: Word | None = None
    port: int = Field(default=22, ge=1, le=65535)
    key: PathText | None = None
    known_hosts: PathText | None = None
    python: PathText | None = None
    tls: Tls | None = None


class Address(_Section):
    """A scheduler that somebody else runs."""

    tls: Tls | None = None


_MOST_TEXT = 100_000

Kind = TypeVar("Kind", Slurm, Ssh, Address)


def read_template(kind: type[Kind], path: Path) -> Kind:
    """Read a cluster file.

    Raises
    ------
    UserError
        If it cannot be read, is no plain YAML, or a key is unknown or has a value that does not fit.
    """
    try:
        text = read_text(path)
    except UserError as error:
        raise UserError(f"The cluster file {error}") from None
    if len(text) > _MOST_TEXT:
        raise UserError(f"The cluster file {path} has {len(text)} characters, {_MOST_TEXT} are possible.")
    try:
        entries = yaml.safe_load(text)
    except Exception as error:  # PyYAML raises all sorts
        words = " ".join(str(error).split())
        raise UserError(f"The cluster file {path} is no plain YAML: {words}.") from None
    if not isinstance(entries, dict):
        raise UserError(f"The cluster file {path} must hold keys and values, such as `processes: 4`.")
    try:
        return kind.model_validate(entries)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            known = ", ".join(sorted(kind.model_fields))
            raise UserError(
                f"The cluster file {path} has the unknown key {key!r}; known are {known}."
            ) from None
        raise UserError(f"The cluster file {path}: {key}: {first['msg']}.") from None


def tls_settings(tls: Tls | None) -> dict[str, object]:
    """Return Dask's settings for encrypted connections between parties that a certificate proves."""
    if tls is None:
        return {}
    files = {"ca": tls.ca, "certificate": tls.certificate, "key": tls.key}
    paths = {}
    for name, text in files.items():
        paths[name] = str(Path(text).expanduser().absolute())
        if not Path(paths[name]).is_file():
            raise UserError(f"There is no file {text}, which the cluster file names as tls.{name}.")
    return tls_paths(paths["ca"], paths["certificate"], paths["key"])


def tls_paths(ca: str, certificate: str, key: str) -> dict[str, object]:
    """Return Dask's settings for the files of certificates at these paths, here or on other hosts."""
    pair = {"cert": certificate, "key": key}
    return {
        "distributed.comm.default-scheme": "tls",
        "distributed.comm.require-encryption": True,
        "distributed.comm.tls.ca-file": ca,
        "distributed.comm.tls.scheduler": pair,
        "distributed.comm.tls.worker": pair,
        "distributed.comm.tls.client": pair,
    }
