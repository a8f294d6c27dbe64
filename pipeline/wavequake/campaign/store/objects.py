"""Stores in object storage: what a folder does by names, locks and renames, done by conditional writes.

A PUT is whole or not at all, and happens only if the object still is the version that its writer saw
(``If-Match``), or still is not there (``If-None-Match``). What is sent again because its answer was lost
fails then, although it was done: so whoever is refused looks again. Nothing here asks a clock.
"""

import errno
import io
import os
from collections.abc import Callable, Coroutine, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from fnmatch import fnmatch
from pathlib import Path, PosixPath
from typing import IO, Any, NoReturn

from wavequake.errors import UserError

_SCHEME = "s3:"
_CONNECTIONS = 32
# What a server says when an object is not the version that a condition names; 409 while another PUT is on.
_CHANGED = {"PreconditionFailed", "ConditionalRequestConflict", "NoSuchKey", "404", "409", "412"}
_REFUSED = {"AccessDenied", "InvalidAccessKeyId", "SignatureDoesNotMatch", "ExpiredToken", "403"}


def location(address: Path | str) -> Path:
    """Return the place that an address names: in the file system, or with ``s3://BUCKET/PREFIX`` objects.

    Raises
    ------
    UserError
        If an address of objects has no prefix.
    """
    if isinstance(address, ObjectPath):
        return address
    path = Path(address)
    if path.parts[:1] != (_SCHEME,):
        return path
    if len(path.parts) < 3:
        raise UserError(f"{address} names no store: write s3://BUCKET/PREFIX.")
    return ObjectPath(path)


class ObjectPath(PosixPath):
    """The address of an object or of all below it, with what stores ask of paths; all else is refused.

    There are no folders: making one does nothing.
    """

    def __str__(self) -> str:
        text = super().__str__()
        return f"{_SCHEME}//{text[len(_SCHEME) + 1 :]}" if text.startswith(f"{_SCHEME}/") else text

    def __fspath__(self) -> NoReturn:
        raise UserError(
            f"{self} is in object storage, where this cannot be read or written: copy the store to a folder, "
            "or name a file."
        )

    @property
    def bucket(self) -> str:
        """The bucket."""
        return self.parts[1]

    @property
    def key(self) -> str:
        """The key of the object in its bucket."""
        return "/".join(self.parts[2:])

    def absolute(self) -> "ObjectPath":
        """Return this address."""
        return self

    def resolve(self, strict: bool = False) -> "ObjectPath":
        """Return this address."""
        return self

    def exists(self, *, follow_symlinks: bool = True) -> bool:
        """Return whether there is this object, or one below it."""
        found = _ask(_call("list_objects_v2", self, Prefix=self.key, MaxKeys=1))
        keys = [one["Key"] for one in found.get("Contents", ())]
        return any(key == self.key or key.startswith(f"{self.key}/") for key in keys) or self.is_file()

    def is_file(self, *, follow_symlinks: bool = True) -> bool:
        """Return whether there is this object."""
        return versions([self])[self] is not None

    def stat(self, *, follow_symlinks: bool = True) -> os.stat_result:
        """Return the size of the object as file systems do."""
        size = _ask(_call("head_object", self))["ContentLength"]
        return os.stat_result((0, 0, 0, 0, 0, 0, size, 0, 0, 0))

    def read_bytes(self) -> bytes:
        """Return the content; raises FileNotFoundError."""
        found = get(self)
        if found is None:
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(self))
        return found[0]

    def read_text(self, encoding: str | None = None, errors: str | None = None, *_: Any) -> str:
        """Return the content as text."""
        return self.read_bytes().decode(encoding or "utf-8", errors or "strict")

    def open(self, mode: str = "r", *_: Any, encoding: str | None = None, **__: Any) -> IO[Any]:  # type: ignore[override]
        """Open the content to read it."""
        if mode not in ("r", "rb"):
            self.__fspath__()
        content = io.BytesIO(self.read_bytes())
        return content if mode == "rb" else io.TextIOWrapper(content, encoding=encoding or "utf-8")

    def write_bytes(self, data: Any) -> int:
        """Write the object."""
        write({self: bytes(data)})
        return len(data)

    def touch(self, mode: int = 0o666, exist_ok: bool = True) -> None:
        """Make an empty object."""
        self.write_bytes(b"")

    def unlink(self, missing_ok: bool = False) -> None:
        """Delete the object."""
        _ask(_call("delete_object", self))

    def mkdir(self, mode: int = 0o777, parents: bool = False, exist_ok: bool = False) -> None:
        """Do nothing."""

    def rmdir(self) -> None:
        """Do nothing."""

    def iterdir(self) -> Iterator["ObjectPath"]:  # type: ignore[override]
        """Yield what lies directly below, objects and folders."""
        yield from self.glob("*")
        yield from self.glob("*/")

    def glob(self, pattern: str, **_: Any) -> Iterator["ObjectPath"]:  # type: ignore[override]
        """Yield the objects directly below whose names fit, or with a slash at the end the folders."""
        for page in _pages(self, Delimiter="/"):
            if pattern.endswith("/"):
                keys = [one["Prefix"].rstrip("/") for one in page.get("CommonPrefixes", ())]
            else:
                keys = [one["Key"] for one in page.get("Contents", ())]
            names = [key.rpartition("/")[2] for key in keys]
            yield from (self / name for name in names if name and fnmatch(name, pattern.rstrip("/")))


def sizes(folder: Path, pattern: str = "*") -> dict[Path, int]:
    """Return the sizes of all files below a folder whose names fit; objects are listed, not asked for."""
    if not isinstance(folder, ObjectPath):
        return {file: file.stat().st_size for file in folder.rglob(pattern) if file.is_file()}
    found = {}
    for page in _pages(folder):
        for one in page.get("Contents", ()):
            file = ObjectPath(_SCHEME, folder.bucket, one["Key"])
            if fnmatch(file.name, pattern):
                found[file] = int(one["Size"])
    return dict(sorted(found.items()))


def presence(folder: Path) -> Callable[[Path], bool]:
    """Return what says of files below a folder whether they are there and not empty."""
    if isinstance(folder, ObjectPath):
        found = sizes(folder)
        return lambda file: found.get(file, 0) > 0
    return lambda file: file.is_file() and file.stat().st_size > 0


def get(path: ObjectPath) -> tuple[bytes, str] | None:
    """Return content and version of an object, None if there is none."""
    (found,) = get_each([path])
    return found


def get_each(paths: Sequence[ObjectPath]) -> list[tuple[bytes, str] | None]:
    """Return contents and versions of objects, which are read at the same time."""

    async def one(path: ObjectPath) -> tuple[bytes, str]:
        answer = await _call("get_object", path)
        async with answer["Body"] as body:
            return await body.read(), answer["ETag"]

    answers = _ask_all(map(one, paths))
    return [None if isinstance(answer, FileNotFoundError) else _sound(answer) for answer in answers]


def versions(paths: Iterable[ObjectPath]) -> dict[ObjectPath, str | None]:
    """Return the version of each object, None where there is none."""
    paths = list(paths)
    answers = _ask_all([_call("head_object", path) for path in paths]) if paths else []
    return {
        path: None if isinstance(answer, FileNotFoundError) else _sound(answer)["ETag"]
        for path, answer in zip(paths, answers, strict=True)
    }


def put(path: ObjectPath, content: bytes, version: str | None) -> bool:
    """Write an object if it still is this version, None: if there still is none; return whether it was."""
    return _put_all({path: content}, {path: version})[path]


def create(path: ObjectPath, content: bytes) -> None:
    """Write an object that nobody else writes, and nobody overwrites."""
    if not put(path, content, None) and path.read_bytes() != content:  # else our own, whose answer was lost
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))


def overwrite(path: ObjectPath, content: bytes) -> None:
    """Write an object that nobody else writes."""
    _ask(_call("put_object", path, Body=content))


def change(path: ObjectPath, changed: Callable[[bytes | None], bytes]) -> bytes:
    """Replace an object by what `changed` makes of it, which is asked again if another writer was first.

    Where the object then is as this would have made it, that is enough: the answer may have been lost.
    """
    while True:
        found = get(path)
        content = changed(found and found[0])
        if put(path, content, found and found[1]):
            return content
        if (now := get(path)) is not None and now[0] == content:
            return content


def write(
    contents: Mapping[ObjectPath, bytes],
    allowed: Callable[[], None] | None = None,
    seen: Mapping[ObjectPath, str | None] | None = None,
) -> None:
    """Write objects at the same time, each over a version that was there before `allowed` was asked last.

    So a writer that is stopped, and wakes when others have begun to write these objects because it is not
    allowed to any more, overwrites nothing of theirs. `allowed` raises then. By default it is what
    :func:`guarded` says. `seen` are versions that were looked up before, if they were.
    """
    left = dict(contents)
    before = dict(seen or {})
    while left:
        before |= versions([path for path in left if path not in before])
        for guard in [allowed] if allowed else _guards_of(next(iter(left))):
            guard()
        written = _put_all(left, before)
        left = {path: content for path, content in left.items() if not written[path]}
        before = {}


_guards: dict[ObjectPath, Callable[[], None]] = {}


@contextmanager
def guarded(path: Path, allowed: Callable[[], None]) -> Iterator[None]:
    """Ask `allowed` before every write of this process below `path`, if that is in object storage."""
    if not isinstance(path, ObjectPath):
        yield
        return
    _guards[path] = allowed
    try:
        yield
    finally:
        del _guards[path]


def _guards_of(path: ObjectPath) -> list[Callable[[], None]]:
    return [_guards[parent] for parent in path.parents if parent in _guards]


def upload(source: Path, target: ObjectPath) -> list[str]:
    """Write the files of a folder that differ from the objects below `target`; return their names.

    Numbers first, then what describes them, and last what describes all: others may be reading.
    """
    files = sorted(file.relative_to(source) for file in source.rglob("*") if file.is_file())
    contents = {ObjectPath(target, *file.parts): (source / file).read_bytes() for file in files}
    there = dict(zip(contents, get_each(list(contents)), strict=True))
    differing = {path: one for path, one in contents.items() if (there[path] or (None,))[0] != one}

    def rank(path: ObjectPath) -> int:
        return 2 if path.parent == target else 1 if path.name == "zarr.json" else 0

    seen = {path: found and found[1] for path, found in there.items()}
    for now in range(3):
        write({path: one for path, one in differing.items() if rank(path) == now}, seen=seen)
    return [str(path.relative_to(target)) for path in differing]


def remove(folder: ObjectPath) -> None:
    """Delete all objects below an address."""
    files = [path for path in sizes(folder) if isinstance(path, ObjectPath)]
    for answer in _ask_all(_call("delete_object", path) for path in files):
        _sound(answer)


def file_system(asynchronous: bool = False) -> Any:
    """Return the file system of fsspec; credentials and addresses are what boto finds, never ours.

    Raises
    ------
    UserError
        If what it needs is not installed.
    """
    try:
        import s3fs
    except ImportError:
        raise UserError("Stores at s3:// need s3fs: pip install s3fs.") from None
    return s3fs.S3FileSystem(
        asynchronous=asynchronous,
        use_listings_cache=False,  # others write at the same time
        config_kwargs={"max_pool_connections": _CONNECTIONS},
    )


async def _call(method: str, path: ObjectPath, **keywords: Any) -> Any:
    """Send one request."""
    if "Prefix" not in keywords:
        keywords["Key"] = path.key
    try:
        return await file_system()._call_s3(method, Bucket=path.bucket, **keywords)
    except Exception as error:
        if words := _why(path, error):
            raise UserError(f"{path}: {words}.") from error
        raise


def _why(path: ObjectPath, error: Exception) -> str:
    """Say why requests fail, in words for the user; "" where that is no matter of theirs."""
    code = _code(error)
    if code == "NoSuchBucket":
        return f"there is no bucket {path.bucket!r}; make it first"
    if code in _REFUSED or isinstance(error, PermissionError):
        return f"the object store refuses access ({code or error})"
    if "Credential" in type(error).__name__:
        return (
            f"there are no credentials for the object store ({error}); docs/clusters.md says how to give them"
        )
    if type(error).__module__.startswith(("botocore", "aiohttp")):
        return f"the object store does not answer ({error}); repeat the command"
    return ""


def _code(error: BaseException | None) -> str:
    """Return the code of a server's error, which may be the cause of another one."""
    while error is not None:
        response = getattr(error, "response", None)
        if isinstance(response, dict):
            return str(response.get("Error", {}).get("Code", ""))
        error = error.__cause__
    return ""


def _put_all(
    contents: Mapping[ObjectPath, bytes], before: Mapping[ObjectPath, str | None]
) -> dict[ObjectPath, bool]:
    def condition(path: ObjectPath) -> dict[str, str]:
        version = before[path]
        return {"IfNoneMatch": "*"} if version is None else {"IfMatch": version}

    answers = _ask_all(
        _call("put_object", path, Body=content, **condition(path)) for path, content in contents.items()
    )
    written = {}
    for path, answer in zip(contents, answers, strict=True):
        written[path] = not (isinstance(answer, Exception) and _code(answer) in _CHANGED)
        if written[path]:
            _sound(answer)
    return written


def _pages(folder: ObjectPath, **keywords: Any) -> Iterator[dict[str, Any]]:
    more: dict[str, Any] = {}
    while True:
        page = _ask(_call("list_objects_v2", folder, Prefix=f"{folder.key}/", **keywords, **more))
        yield page
        if not page.get("IsTruncated"):
            return
        more = {"ContinuationToken": page["NextContinuationToken"]}


def _ask(request: Coroutine[Any, Any, Any]) -> Any:
    (answer,) = _ask_all([request])
    return _sound(answer)


def _ask_all(requests: Iterable[Coroutine[Any, Any, Any]]) -> list[Any]:
    """Send requests at the same time; return their answers or errors in this order."""
    import asyncio  # slow to load, as fsspec is

    from fsspec.asyn import sync

    async def together() -> list[Any]:
        return await asyncio.gather(*requests, return_exceptions=True)

    found: list[Any] = sync(file_system().loop, together)
    return found


def _sound(answer: Any) -> Any:
    if isinstance(answer, BaseException):
        raise answer
    return answer
