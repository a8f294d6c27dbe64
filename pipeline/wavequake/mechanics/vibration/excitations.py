"""What shakes a body at its interfaces, as sections of a study: sinusoid, blow, random, measured. SI units.

An excitation acts at all or some interface nodes in one direction, as a prescribed displacement (all other
interface directions are then held, unless they are left free) or as a force. `drive_of` turns it into the
inputs of `wavequake.mechanics.vibration.response.respond`.
"""

import csv
import io
import math
from collections.abc import Sequence
from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from wavequake.errors import UserError
from wavequake.mechanics.disturbances.motion import generator
from wavequake.mechanics.disturbances.spectra import (
    Bands,
    Spectrum,
    resonance,
    scaled,
    split,
    synthesize,
    tabulated,
    variance,
)
from wavequake.mechanics.model import Array, Integers
from wavequake.mechanics.vibration.drive import Drive, Impulse, ramped_sine
from wavequake.mechanics.vibration.response import time_step
from wavequake.prepared import prepared

_HARMONICS = 256


class Excitation(BaseModel):
    """What all excitations have in common: where they act and in which direction."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False, defer_build=True)

    name: str = Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$", description="also names its random numbers")
    acts: Literal["displacement", "force"] = Field(
        default="displacement", description="what is given at the interfaces: motion in m or force in N"
    )
    direction: Literal["x", "y", "z", "rx", "ry", "rz"] = Field(
        default="z",
        description="of the motion or force; rx, ry, rz: a rotation (rad) or moment (N m) of pads",
    )
    interfaces: tuple[int, ...] | None = Field(
        default=None, strict=False, description="which interface nodes, from 0; all of them if left out"
    )
    others: Literal["held", "free"] = Field(
        default="held", description="interface directions that a displacement leaves out"
    )

    @model_validator(mode="after")
    def _interfaces_are_a_set(self) -> Self:
        chosen = self.interfaces
        if chosen is not None and (not chosen or len(set(chosen)) < len(chosen) or min(chosen) < 0):
            raise ValueError("interfaces has to list different nodes, counted from 0, at least one")
        return self


class Sinusoid(Excitation):
    """amplitude * sin(2 pi f t) from t = 0, abrupt or swung in by a sin^2 ramp.

    The defaults are those of Störkle 2018, §4.3.2: 10 um at 100 Hz, abrupt.
    """

    kind: Literal["sinusoid"] = "sinusoid"
    amplitude: float = Field(default=10e-6, gt=0, description="m or N")
    frequency_hz: float = Field(
        default=100.0, gt=0, le=1e6, description="of the sinusoid; default: 100 Hz, as in the reference text"
    )
    ramp_s: float = Field(default=0.0, ge=0, description="0: an abrupt start, a jump of velocity")


class ForceImpulse(Excitation):
    """A blow: momentum given to each chosen interface node at one instant."""

    kind: Literal["impulse"] = "impulse"
    acts: Literal["force"] = Field(  # type: ignore[assignment,unused-ignore]
        default="force", description="always a force: a blow gives momentum"
    )
    momentum_n_s: float = Field(default=1.0, description="N s at each node")
    at_s: float = Field(default=0.0, ge=0, description="instant of the blow; 0: the first one")

    @model_validator(mode="after")
    def _is_a_blow(self) -> Self:
        if self.momentum_n_s == 0.0:
            raise ValueError("momentum_n_s is 0, which excites nothing")
        return self


class RandomVibration(Excitation):
    """Gaussian vibration with a power spectral density, swung in from rest.

    ``flat``: constant from `low_hz` to `high_hz`; ``resonance``: an oscillator at `center_hz`, `fwhm_hz`
    wide, shaken by white noise; ``file``: a CSV of frequency_hz,psd in m^2/Hz or N^2/Hz. `rms` scales any of
    them; only a file may do without.
    """

    kind: Literal["psd"] = "psd"
    spectrum: Literal["flat", "resonance", "file"] = Field(
        default="flat", description="shape of the power spectral density over frequency"
    )
    rms: float | None = Field(default=None, gt=0, le=1e12, description="m or N, once swung in")
    low_hz: float = Field(default=10.0, ge=1e-6, le=1e9, description="of the flat spectrum")
    high_hz: float = Field(default=400.0, ge=1e-6, le=1e9, description="of the flat spectrum")
    center_hz: float = Field(default=100.0, ge=1e-6, le=1e9, description="of the resonance")
    fwhm_hz: float = Field(
        default=5.0, ge=1e-6, le=1e9, description="of the resonance: full width at half maximum"
    )
    file: str | None = Field(
        default=None, exclude=True, description="CSV of frequency_hz,psd (read when the study is loaded)"
    )
    file_csv: str | None = Field(default=None, description="the text of that file")
    alike: bool = Field(
        default=True, description="the same vibration at all nodes, or one of its own at each"
    )
    ramp_s: float = Field(default=0.005, ge=0, description="time in which it swings in")

    @model_validator(mode="after")
    def _spectrum_is_complete(self) -> Self:
        if (self.spectrum == "file") != (self.file_csv is not None):
            need = "needs a file, a CSV of frequency_hz,psd" if self.file_csv is None else "takes no file"
            raise ValueError(f"the spectrum {self.spectrum!r} {need}")
        if self.spectrum != "file" and self.rms is None:
            raise ValueError(f"the spectrum {self.spectrum!r} gives the shape only; state its rms in m or N")
        if self.low_hz >= self.high_hz:
            raise ValueError(f"low_hz {self.low_hz:g} has to be below high_hz {self.high_hz:g}")
        if self.fwhm_hz > self.center_hz:
            raise ValueError(f"a resonance at {self.center_hz:g} Hz cannot be {self.fwhm_hz:g} Hz wide")
        if self.acts == "displacement" and self.ramp_s == 0.0:
            raise ValueError("a random displacement needs a ramp_s above 0: at t = 0 the body is at rest")
        try:
            vibration_spectrum(self)
        except UserError as error:
            raise ValueError(str(error)) from None
        return self


class Recorded(Excitation):
    """A record: a CSV of time_s and one column for all chosen nodes, or one per node; joined by lines."""

    kind: Literal["file"] = "file"
    file: str | None = Field(
        default=None, exclude=True, description="CSV of time_s,value... (read when the study is loaded)"
    )
    file_csv: str = Field(description="the text of that file")
    factor: float = Field(default=1.0, description="turns the file's unit into m or N")

    @model_validator(mode="after")
    def _record_is_readable(self) -> Self:
        try:
            read_record(self.file_csv, self.file or "file_csv")
        except UserError as error:
            raise ValueError(str(error)) from None
        return self


AnyExcitation = Annotated[Sinusoid | ForceImpulse | RandomVibration | Recorded, Field(discriminator="kind")]


def vibration_spectrum(excitation: RandomVibration) -> Spectrum:
    """Return the power spectral density, m^2/Hz or N^2/Hz."""
    if excitation.file_csv is not None:
        shape = tabulated(excitation.file_csv, excitation.file or "file_csv")
    elif excitation.spectrum == "resonance":
        shape = resonance(excitation.center_hz, excitation.fwhm_hz, 1.0)
    else:
        shape = Spectrum(np.ones_like, excitation.low_hz, excitation.high_hz)
    return shape if excitation.rms is None else scaled(shape, excitation.rms**2 / variance(shape))


def drive_of(
    excitation: AnyExcitation,
    interfaces: int,
    time: Array,
    seed: int = 0,
    realization: int = 0,
    turns: Sequence[int] | Integers = (),
) -> Drive:
    """Return the inputs that an excitation is, for a body with so many interface nodes.

    Sinusoids and impulses are exact; random and recorded ones are sampled at `time` and joined linearly. One
    realization of a name is one draw, whatever model it drives.

    Parameters
    ----------
    interfaces : int
        Number k of interfaces of the model.
    time : ndarray, shape (t,)
        Evenly spaced instants from 0, s.
    turns : sequence of int
        Which interface is the rotation of each node, see `wavequake.mechanics.model.rotations`; -1: none.

    Raises
    ------
    UserError
        If it names a node that the body has not, or turns one that cannot, is faster than the instants
        resolve, or its record is too short or has the wrong number of columns.
    """
    turned = np.asarray(turns, dtype=np.int64)
    moves = np.setdiff1d(np.arange(interfaces), turned)
    count = len(moves)
    nodes = list(range(count)) if excitation.interfaces is None else list(excitation.interfaces)
    if max(nodes, default=-1) >= count or not nodes:
        raise UserError(
            f"the excitation {excitation.name!r} acts at interface node {max(nodes, default=0)}, but the "
            f"body has {count}, counted from 0"
        )
    chosen = moves[nodes]
    if excitation.direction.startswith("r"):
        if not turned.size or (turned[nodes] < 0).any():
            raise UserError(
                f"the excitation {excitation.name!r} turns interfaces (direction = "
                f"{excitation.direction!r}), but the body gives them no rotations; pads with pad_dofs = 6 do"
            )
        chosen = turned[nodes]
    places = 3 * chosen + "xyz".index(excitation.direction[-1])
    pattern = np.zeros(3 * interfaces)
    pattern[places] = 1.0
    prescribed = _prescribed(excitation, pattern)
    if isinstance(excitation, Sinusoid):
        omega = 2 * np.pi * excitation.frequency_hz
        return Drive(prescribed, ramped_sine(omega, excitation.amplitude * pattern, excitation.ramp_s))
    if isinstance(excitation, ForceImpulse):
        blow = Impulse(excitation.at_s, excitation.momentum_n_s * pattern)
        return Drive(prescribed, impulses=(blow,))
    samples = np.zeros((len(time), 3 * interfaces))
    if isinstance(excitation, RandomVibration):
        samples[:, places] = _vibration(
            excitation, len(nodes), time, generator(seed, excitation.name, realization)
        )
    else:
        samples[:, places] = _record(excitation, len(nodes), time)
    return Drive(prescribed, samples=samples)


def _prescribed(excitation: Excitation, pattern: Array) -> NDArray[np.bool_]:
    if excitation.acts == "force":
        return np.zeros(len(pattern), dtype=bool)
    chosen: NDArray[np.bool_] = pattern != 0.0
    return chosen if excitation.others == "free" else np.ones(len(pattern), dtype=bool)


def _vibration(excitation: RandomVibration, nodes: int, time: Array, random: np.random.Generator) -> Array:
    spectrum, nyquist = vibration_spectrum(excitation), 0.5 / time_step(time)
    if excitation.spectrum != "resonance" and spectrum.high_hz > nyquist:
        raise UserError(
            f"the excitation {excitation.name!r} has frequencies up to {spectrum.high_hz:g} Hz, but instants "
            f"every {0.5 / nyquist:g} s resolve {nyquist:g} Hz; take a smaller time step or end the spectrum"
        )
    if excitation.spectrum == "resonance" and 2 * excitation.center_hz > nyquist:
        raise UserError(
            f"the excitation {excitation.name!r} at {excitation.center_hz:g} Hz needs a time step of at most "
            f"{0.25 / excitation.center_hz:.3g} s"
        )
    series = synthesize(_bands(excitation), time, random, 1 if excitation.alike else nodes)
    if excitation.ramp_s > 0.0:
        series *= np.sin(0.5 * np.pi * np.minimum(time / excitation.ramp_s, 1.0))[:, None] ** 2
    return series


@prepared(maxsize=64)
def _bands(excitation: RandomVibration) -> Bands:
    return split(vibration_spectrum(excitation), _HARMONICS)


def _record(excitation: Recorded, nodes: int, time: Array) -> Array:
    instants, columns = read_record(excitation.file_csv, excitation.file or "file_csv")
    if columns.shape[1] not in (1, nodes):
        raise UserError(
            f"the record of {excitation.name!r} has {columns.shape[1]} columns beside time_s; it needs 1, or "
            f"{nodes}, one for each node it acts at"
        )
    if instants[0] > 0.0 or instants[-1] < time[-1]:
        raise UserError(
            f"the record of {excitation.name!r} covers {instants[0]:g} to {instants[-1]:g} s, but the "
            f"response lasts from 0 to {time[-1]:g} s"
        )
    sampled = [np.interp(time, instants, column) for column in columns.T]
    return excitation.factor * np.stack(sampled, axis=1)


def read_record(text: str, name: str) -> tuple[Array, Array]:
    """Read CSV text with time_s and at least one column of values (and perhaps a header).

    Returns
    -------
    time : ndarray, shape (t,)
    values : ndarray, shape (t, columns)

    Raises
    ------
    UserError
        If a row is not as many finite numbers as the first one, the instants do not increase, or there are
        fewer than two rows; names the file and the line.
    """
    try:
        return _parsed(text, name)
    except csv.Error as error:
        raise UserError(f"{name} is no table in CSV: {error}.") from None


def _parsed(text: str, name: str) -> tuple[Array, Array]:
    rows: list[list[float]] = []
    reader = csv.reader(io.StringIO(text))
    for cells in reader:
        if not cells or cells[0].lstrip().startswith("#"):
            continue
        where = f"{name}, line {reader.line_num}"
        try:
            numbers = [float(cell) for cell in cells]
        except ValueError:
            if not rows and cells[0].strip() == "time_s":
                continue
            raise UserError(
                f"{where}: {','.join(cells)!r} is not a row of numbers, time_s,value..."
            ) from None
        if len(numbers) < 2 or (rows and len(numbers) != len(rows[0])):
            raise UserError(f"{where} has {len(numbers)} numbers; every row needs time_s and the same values")
        if not all(math.isfinite(number) for number in numbers):
            raise UserError(
                f"{where}: {','.join(cells)!r} has a value that is not finite; leave such rows out"
            )
        if rows and numbers[0] <= rows[-1][0]:
            raise UserError(f"{where}: time_s {numbers[0]:g} does not increase; sort the rows by time")
        rows.append(numbers)
    if len(rows) < 2:
        raise UserError(f"{name} has {len(rows)} rows of time_s,value...; a record needs at least 2")
    table = np.array(rows)
    return table[:, 0], table[:, 1:]
