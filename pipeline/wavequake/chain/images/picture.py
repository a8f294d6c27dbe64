"""Pictures and masks of one's own, read when a study is loaded and kept in it as text."""

import base64
import binascii
import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.imaging.objects.formation import checked_intensity
from wavequake.user_files import read_bytes, read_npy

Array = NDArray[np.float64]

_KEY = "object.picture"
_MOST_PIXELS = 4096 * 4096


def read_picture(path: Path) -> str:
    """Return the picture of a PNG, NPY or CSV file as text: its shape and its values in single precision.

    Gray values of a PNG become 0 to 1, colors their mean, transparent is dark; it is upright, while the
    first row of other files is the lowest.

    Raises
    ------
    UserError
        If the file cannot be read or holds no picture of finite values of at least 0.
    """
    readers = {".png": _png, ".npy": read_npy, ".csv": _csv}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise UserError(f"{_KEY}: {path} must be a .png, .npy or .csv file.")
    try:
        data = read_bytes(path)
    except UserError as error:
        raise UserError(f"{_KEY}: {error}") from None
    try:
        values = reader(data)
        if values.dtype.kind not in "biuf":
            raise ValueError(f"its values are {values.dtype}, not real numbers")
        with np.errstate(over="ignore"):  # what becomes infinite is refused
            picture = checked_intensity(values.astype("<f4"))
    except UserError as error:
        raise UserError(f"{_KEY}: {path}: {str(error).rstrip('.')}.") from None
    except Exception as error:  # decoders raise all sorts
        raise UserError(f"{_KEY}: {path} is no picture ({error}).") from None
    rows, columns = picture.shape
    return f"{rows}x{columns}:" + base64.b64encode(picture.astype("<f4").tobytes()).decode()


def picture_of(text: str) -> Array:
    """Return the picture (rows, columns) that `read_picture` turned into text."""
    try:
        shape, _, data = text.partition(":")
        rows, columns = map(int, shape.split("x"))
        values = np.frombuffer(base64.b64decode(data, validate=True), dtype="<f4")
        return checked_intensity(values.reshape(rows, columns))
    except (ValueError, binascii.Error):
        raise UserError(
            "object.picture_data is what a study keeps of object.picture; name a file there instead"
        ) from None


def in_frame(picture: Array, pixels: int) -> Array:
    """Return a picture in the middle of a dark frame (pixels, pixels); UserError if it is larger."""
    rows, columns = picture.shape
    if max(rows, columns) > pixels:
        raise UserError(
            f"{_KEY} has {rows} x {columns} pixels, more than the frame of {pixels} x {pixels}; "
            "make it smaller, or imaging.pixels larger"
        )
    frame = np.zeros((pixels, pixels))
    top, left = (pixels // 2 - length // 2 for length in (rows, columns))
    frame[top : top + rows, left : left + columns] = picture
    return frame


def _png(data: bytes) -> NDArray[np.generic]:
    from matplotlib.image import imread  # slow to import, and few studies need it

    columns, rows = (int.from_bytes(data[start : start + 4], "big") for start in (16, 20))  # IHDR is first
    if rows * columns > _MOST_PIXELS:
        raise ValueError(f"it has {rows} x {columns} pixels, {_MOST_PIXELS} are possible")
    values = np.asarray(imread(io.BytesIO(data), format="png"), dtype=np.float64)
    if values.ndim == 3:
        alpha = values[..., 3] if values.shape[2] == 4 else 1.0
        values = values[..., :3].mean(axis=2) * alpha
    return values[::-1]


def _csv(data: bytes) -> NDArray[np.generic]:
    text = data.decode("utf-8-sig")
    if not text.strip():
        raise ValueError("it is empty")
    rows = [line.partition("#")[0] for line in text.splitlines()]
    lengths = [line.count(",") + 1 for line in rows if line.strip()]
    for number, length in enumerate(lengths, start=1):
        if length != lengths[0]:
            raise ValueError(f"row 1 has {lengths[0]} values, row {number} has {length}")
    return np.loadtxt(io.StringIO(text), delimiter=",", ndmin=2)


def embed_picture(record: dict[str, Any], base: Path) -> None:
    """Read the picture that the section ``object`` of a study names into the study."""
    shown = record.get("object")
    if isinstance(shown, dict) and isinstance(shown.get("picture"), str):
        shown["picture_data"] = read_picture(base / shown["picture"])
