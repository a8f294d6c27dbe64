"""LQG with a model of the vibration."""

from abc import abstractmethod
from collections.abc import Iterator
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from wavequake.campaign.schema import Section
from wavequake.chain.loops.block import Controller, register
from wavequake.chain.loops.design import Design, decoupling
from wavequake.control.frames.disturbance import Shaped, joined, line, oscillator
from wavequake.control.linear import LinearModel
from wavequake.control.sampled.filters import drift, lqg
from wavequake.control.sampled.regulator import Regulator, shared_filter
from wavequake.errors import UserError

Array = NDArray[np.float64]
# Narrower lines, as a share of their frequency, are lost in rounding.
_SHARPEST = 1e-4
# Modes that are seen less than this share of the largest one are not expected.
_SEEN = 1e-6
# Modes that are named one by one.
_SAID = 4


NO_MODES = "there is neither a [[mode]] block nor a [[body]] with mass."


class LineSection(Section):
    """A vibration that the controller expects."""

    hz: float = Field(ge=0.1, le=1e3, description="middle of the line")
    fwhm_hz: float = Field(default=0.5, ge=1e-5, le=1e3, description="full width at half maximum")
    rms: float = Field(ge=1e-15, le=1e15, description="in the sensor's unit; of accelerometers in m or rad")

    @model_validator(mode="after")
    def _is_a_line(self) -> "LineSection":
        if not 0.999 * _SHARPEST * self.hz <= self.fwhm_hz <= self.hz:
            raise ValueError(
                f"a line at {self.hz:g} Hz cannot be {self.fwhm_hz:g} Hz wide; fwhm_hz must be between "
                f"{_SHARPEST * self.hz:g} and {self.hz:g}"
            )
        return self


class Expecting(Controller):
    """What a controller expects: in every channel a drift and vibration lines, beside noise of the sensor.

    Only ratios of rms count. All channels expect the same. Accelerometers see no drifts; what they
    read twice derived is expected in m or rad.
    """

    lines: tuple[LineSection, ...] = Field(default=(), strict=False)
    structure: bool = Field(
        default=False,
        description="modes of [[mode]] blocks and of bodies are expected, too, as they are shaken",
    )
    drift_rms: float = Field(default=0.0, ge=0, le=1e15, description="of first-order noise, in that unit")
    drift_hz: float = Field(default=0.1, ge=1e-6, le=1e4, description="its corner")
    noise: float | None = Field(
        default=None, gt=0, description="of a command's reading that it believes; default: the sensor's"
    )
    modes: int | None = Field(
        default=None, ge=1, description="so many best-seen motions are corrected; default: all"
    )

    @model_validator(mode="after")
    def _something_is_expected(self) -> "Expecting":
        if not (self.lines or self.drift_rms or self.structure):
            raise ValueError(f"{self.name!r} expects no disturbance; give lines, drift_rms or structure")
        return self

    @property
    def asks_modes(self) -> bool:
        """Whether it expects those of the structure."""
        return self.structure

    def told(self) -> list[Shaped]:
        """Return lines and drift."""
        parts = [line(one.hz, one.fwhm_hz, one.rms) for one in self.lines]
        return [*parts, drift(self.drift_hz, self.drift_rms)] if self.drift_rms else parts

    def notices(self, asked: Design) -> Iterator[str]:
        """Yield which modes of the structure it leaves out, as its sensors hardly see them."""
        if not self.structure or asked.shaken is None:
            return
        sizes = self.sizes(asked)
        most = sizes.max(initial=0.0)
        names = " and ".join(repr(one.sensor) for one in (asked.watched if self.fuses else asked.watched[:1]))
        hidden = np.flatnonzero(~self.expects(sizes))
        where = f"controller.{self.name}.structure"
        for k in hidden[:_SAID]:
            mode = f"{asked.shaken.names[k]!r} ({asked.shaken.hertz[k]:.4g} Hz)"
            how = f"{sizes[k] / most:.0e} of what it sees most" if sizes[k] else "not at all"
            yield f"{where}: the sensor {names} sees the mode {mode} {how}; it is not expected."
        if len(hidden) > _SAID:
            yield f"{where}: so it is with {len(hidden) - _SAID} more modes."

    @abstractmethod
    def sizes(self, asked: Design) -> Array:
        """Return how much is seen of each mode of the structure that is shaken, (K,)."""

    def expects(self, sizes: Array) -> NDArray[np.bool_]:
        """Return of which modes that much is enough."""
        return np.asarray(sizes > _SEEN * sizes.max(initial=0.0))

    def noise_of(self, asked: Design) -> float:
        """Return the noise of a reading of the first sensor, as it is believed to be."""
        return asked.noise if self.noise is None else self.noise


class Filtering(Expecting):
    """A controller with a filter for every channel."""

    def sizes(self, asked: Design) -> Array:
        """Return the rms of each mode as channels see it on average, in the sensor's unit."""
        channels = decoupling(asked, self.modes, rates=True)
        # What of a channel's reading is noise of the sensor, per noise of a reading.
        sizes = np.linalg.norm(channels, axis=1)
        kept = sizes > 0
        seen = channels[kept] @ asked.watched[0].shaken / sizes[kept, None]
        return np.asarray(np.sqrt(np.mean(seen**2, axis=0)))

    def _shaken(self, asked: Design) -> list[Shaped]:
        """Return the modes of the structure as channels see them.

        Raises
        ------
        UserError
            If there is no structure, or no channel sees any of its modes shaken.
        """
        where = f"controller.{self.name}.structure"
        if asked.shaken is None:
            raise UserError(f"{where}: {NO_MODES}")
        rms = self.sizes(asked)
        seen = self.expects(rms)
        if not seen.any():
            raise UserError(
                f"{where}: the sensor {asked.sensor!r} sees no mode of the structure shaken; set rms_nm of "
                "[[mode]] blocks, or let a disturbance act on bodies."
            )
        return [
            oscillator(hertz, 4 * np.pi * zeta * hertz, size)
            for hertz, zeta, size in zip(
                asked.shaken.hertz[seen], asked.shaken.zeta[seen], rms[seen], strict=True
            )
        ]

    def expected(self, asked: Design) -> tuple[Shaped, float]:
        """Return the disturbance of a channel and the noise of its reading."""
        parts = self.told() + (self._shaken(asked) if self.structure else [])
        return joined(parts), self.noise_of(asked)

    @abstractmethod
    def filtered(self, asked: Design, known: Shaped, noise: float) -> LinearModel:
        """Return the filter of a channel, of what is expected."""

    def design(self, asked: Design) -> Regulator:
        """Return a filter for every channel."""
        expected = self.expected(asked)
        try:
            model = self.filtered(asked, *expected)
        except UserError as error:
            raise UserError(f"controller.{self.name}: {error}") from None
        return shared_filter(decoupling(asked, self.modes, rates=True), model)


@register
class Lqg(Filtering):
    """A Kalman predictor of what is expected; how an actuator follows is known, but not made up for."""

    model: Literal["lqg"] = "lqg"

    def filtered(self, asked: Design, known: Shaped, noise: float) -> LinearModel:
        """Return the predictor."""
        return lqg(known, noise, asked.follows, asked.timing, asked.shows)
