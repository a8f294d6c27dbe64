"""Records of telemetry from files: evenly sampled, finite, long enough, or a sentence of what is not."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO, StringIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavequake.errors import UserError
from wavequake.mechanics.telemetry.columns import EXAMPLES, Channel, channel_of
from wavequake.user_files import read_bytes, read_npz, read_text

Array = NDArray[np.float64]

FEWEST = 512
MOST_CHANNELS = 64
_SHORTEST, _LONGEST = 1e-9, 1e6  # s: steps whose frequencies have squares and reciprocals
_ROUNDING = 16.0 * float(np.finfo(float).eps)
_DRIFT = 1e-4  # of all instants: a clock whose rate changes by 0.08 %, less than the width of a narrow line
_PILED = 1e-3  # share of samples at an end of the range, and how many of the next value there are at most
_MORE = 3.0
_LATEST = 1e305  # s: differences of instants must be numbers
_LEAST, _MOST = 1e-30, 1e30  # range of a signal in its unit: squares of spectra must be numbers


@dataclass(frozen=True)
class Record:
    """Signals at evenly spaced instants.

    Attributes
    ----------
    step : float
        s.
    channels : tuple of Channel, length c
    values : ndarray, shape (n, c)
        In the channels' units.
    """

    step: float
    channels: tuple[Channel, ...]
    values: Array

    @property
    def duration(self) -> float:
        """Length, s."""
        return self.step * len(self.values)

    @property
    def nyquist_hz(self) -> float:
        """Half the sampling frequency, Hz."""
        return 0.5 / self.step


def read_record(path: str | Path) -> Record:
    """Read telemetry from ``.csv``, ``.npz`` or ``.fits``.

    A CSV names its columns in its first line: time_s and, for example, line_of_sight.x_mas. An .npz has
    arrays of these names, with time_s or the number rate_hz; a FITS file a binary table of these columns.

    Raises
    ------
    UserError
        If it cannot be read, has gaps, values that are not finite or clipped, too few rows, or columns that
        are not known or have no unit; names the file and the place.
    """
    file = Path(path)
    read = {".csv": _from_csv, ".txt": _from_csv, ".npz": _from_npz, ".fits": _from_fits}.get(
        file.suffix.lower()
    )
    if read is None:
        raise UserError(f"{file} must end in .csv, .npz or .fits.")
    try:
        names, time, values = read(file)
        return record_of(names, time, values)
    except UserError as error:
        text = str(error)
        raise UserError(text if text.startswith(str(file)) else f"{file}: {text}") from None


def record_of(names: Sequence[str], time: Array | float, values: Array) -> Record:
    """Return a record of columns `values` (n, c) by their names, at instants (n,) or every `time` seconds.

    Raises
    ------
    UserError
        As `read_record`.
    """
    if not names:
        raise UserError(f"there is no column beside time_s; add some, such as {EXAMPLES}.")
    if len(names) > MOST_CHANNELS:
        raise UserError(f"it has {len(names)} columns, {MOST_CHANNELS} are possible; leave some out.")
    channels = tuple(channel_of(name) for name in names)
    places = [(one.element, one.field, one.axis) for one in channels]
    twice = next((k for k, place in enumerate(places) if places.index(place) < k), None)
    if twice is not None:
        first = channels[places.index(places[twice])].name
        raise UserError(f"the columns {first!r} and {channels[twice].name!r} say the same; keep one of them.")
    if len(values) < FEWEST:
        raise UserError(f"it has {len(values)} rows; spectra need at least {FEWEST}.")
    _require_finite(channels, values)
    step = time if isinstance(time, float) else _step_of(time)
    if not _SHORTEST <= step <= _LONGEST:
        raise UserError(
            f"its time step is {step:g} s; instants increase evenly, by {_SHORTEST:g} to {_LONGEST:g} s."
        )
    for channel, column in zip(channels, values.T, strict=True):
        _require_free(channel.name, column)
    return Record(step, channels, np.ascontiguousarray(values))


def _require_finite(channels: Sequence[Channel], values: Array) -> None:
    bad = ~np.isfinite(values)
    if bad.any():
        row, column = (int(one) for one in np.argwhere(bad)[0])
        raise UserError(
            f"row {row + 1} of {channels[column].name!r} is no finite number ({int(bad.sum())} in all); "
            "give a piece of the record without them: spectra need every sample."
        )


def _step_of(time: Array) -> float:
    if not np.isfinite(time).all():
        raise UserError(f"row {int(np.argmin(np.isfinite(time))) + 1} of 'time_s' is no finite number.")
    if np.abs(time).max() > _LATEST:
        raise UserError(f"'time_s' reaches {np.abs(time).max():g} s, which no clock shows.")
    steps = np.diff(time)
    step = float(np.median(steps))
    if not step > 0.0:
        raise UserError("time_s does not increase; sort the rows by time.")
    span = float(time[-1] - time[0]) / (len(time) - 1)
    worst = int(np.argmax(np.abs(steps - step)))
    # Times of few digits are rounded; what counts is that no sample is missing and none comes twice.
    if np.abs(steps[worst] - step) > 0.5 * step:
        after = f"after row {worst + 1} ({time[worst]:.9g} s)"
        if steps[worst] <= 0.0:
            raise UserError(f"time_s does not increase {after}; sort the rows by time, each instant once.")
        if steps[worst] < step:
            raise UserError(
                f"{after} the next comes {steps[worst]:.6g} s later, where the step is {step:.6g} s; "
                "resample it at even instants."
            )
        raise UserError(
            f"{after} there is a gap of {steps[worst]:.6g} s where the step is {step:.6g} s; give the "
            "longest piece without gaps."
        )
    drift = np.abs(time - time[0] - span * np.arange(len(time))).max()
    if drift > max(_DRIFT * len(time), 1.0) * step:
        raise UserError(
            f"its instants are up to {drift / step:.3g} steps off even spacing, which smears lines; resample "
            "it, or give a piece that was sampled evenly."
        )
    return span


def _require_free(name: str, column: Array) -> None:
    """Raise UserError if a column does not change, or piles up at an end of its range."""
    low, high = float(column.min()), float(column.max())
    if low == high:
        raise UserError(f"the column {name!r} is {low:g} throughout; leave it out.")
    if not _LEAST < high - low < _MOST:
        raise UserError(f"the column {name!r} runs from {low:g} to {high:g}, which no sensor measures.")
    if np.ptp(np.diff(column)) <= _ROUNDING * max(abs(low), abs(high)):
        raise UserError(f"the column {name!r} is a straight line but for rounding; leave it out.")
    for end in (low, high):
        at = column == end
        count = int(at.sum())
        if count < max(10, _PILED * len(column)) or int((at[1:] & at[:-1]).sum()) < 3:
            continue
        others = column[~at]
        beside = others.max() if end == high else others.min()
        if count > _MORE * int((column == beside).sum()) and beside not in (low, high):
            raise UserError(
                f"the column {name!r} is clipped: {count} of {len(column)} samples are exactly {end:g}; its "
                "spectrum is not that of the motion. Give a piece within the sensor's range."
            )


def _from_csv(path: Path) -> tuple[list[str], Array | float, Array]:
    text = read_text(path)
    lines = text.splitlines()
    first = next((k for k, line in enumerate(lines) if line.strip() and line.lstrip()[:1] != "#"), None)
    if first is None:
        raise UserError(f"it is empty; its first line names its columns: time_s, then such as {EXAMPLES}.")
    header = [cell.strip().strip('"') for cell in lines[first].split(",")]
    if header[0] != "time_s":
        raise UserError(
            f"it begins with {lines[first][:60]!r}, but its first line must name its columns, divided by "
            f"commas: time_s, then such as {EXAMPLES}."
        )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of no rows, which is told below
            table = np.loadtxt(StringIO(text), delimiter=",", skiprows=first + 1, ndmin=2, comments="#")
    except (ValueError, OverflowError):
        table = np.zeros((0, 0))
    if table.shape[1:] != (len(header),) or not len(table):
        _explain(lines, first, header)
    return header[1:], table[:, 0], table[:, 1:]


def _explain(lines: list[str], first: int, header: list[str]) -> None:
    """Say which line is no row of numbers."""
    rows = 0
    for number, line in enumerate(lines[first + 1 :], start=first + 2):
        cells = line.partition("#")[0].split(",")
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        rows += 1
        if len(cells) != len(header):
            raise UserError(f"line {number} has {len(cells)} cells, but there are {len(header)} columns.")
        for name, cell in zip(header, cells, strict=True):
            try:
                float(cell)
            except ValueError:
                what = f"{cell.strip()[:40]!r} is no number" if cell.strip() else "the cell is empty"
                raise UserError(f"line {number}, column {name!r}: {what}.") from None
    raise UserError(f"it has {rows} rows of numbers below the line that names the columns.")


def _from_npz(path: Path) -> tuple[list[str], Array | float, Array]:
    arrays = read_npz(read_bytes(path))
    rate = arrays.pop("rate_hz", None)
    time = arrays.pop("time_s", None)
    if (rate is None) == (time is None):
        raise UserError("it needs the array time_s, or the number rate_hz, and not both.")
    columns = {name: _column(name, values) for name, values in arrays.items()}
    if rate is not None:
        if rate.size != 1 or rate.dtype.kind not in "iuf" or not float(rate.ravel()[0]) > 0.0:
            raise UserError("rate_hz must be one positive number.")
        names, values = _together(columns, None)
        return names, 1.0 / float(rate.ravel()[0]), values
    assert time is not None
    return _with_time(columns, _column("time_s", time))


def _from_fits(path: Path) -> tuple[list[str], Array | float, Array]:
    try:
        from astropy.io import fits
    except ImportError:
        raise UserError("FITS files need astropy: pip install astropy.") from None
    data = BytesIO(read_bytes(path))
    try:
        with fits.open(data, memmap=False) as opened:
            table = next((one for one in opened if isinstance(one, fits.BinTableHDU)), None)
            if table is None:
                raise UserError("it has no binary table; write one with the columns time_s and others.")
            columns = {
                str(name): _column(str(name), np.asarray(table.data[name])) for name in table.columns.names
            }
    except UserError:
        raise
    except Exception as error:  # a library that may trip over anything in a damaged file
        raise UserError(f"it is no FITS file ({' '.join(str(error).split())[:200]}).") from None
    time = columns.pop("time_s", None)
    if time is None:
        raise UserError(f"its table has no column time_s; it has {', '.join(columns) or 'none'}.")
    return _with_time(columns, time)


def _column(name: str, values: NDArray[Any]) -> Array:
    if values.ndim != 1 or values.dtype.kind not in "iuf":
        raise UserError(
            f"{name!r} has the shape {values.shape} of {values.dtype}; a column is one of numbers."
        )
    return values.astype(np.float64)


def _with_time(columns: dict[str, Array], time: Array) -> tuple[list[str], Array | float, Array]:
    names, values = _together(columns, len(time))
    return names, time, values


def _together(columns: dict[str, Array], count: int | None) -> tuple[list[str], Array]:
    sizes = {name: len(values) for name, values in columns.items()}
    count = next(iter(sizes.values()), 0) if count is None else count
    short = next((name for name, size in sizes.items() if size != count), None)
    if short is not None:
        raise UserError(f"{short!r} has {sizes[short]} samples, but others have {count}.")
    return list(columns), np.stack(list(columns.values()), axis=1) if columns else np.zeros((count, 0))
