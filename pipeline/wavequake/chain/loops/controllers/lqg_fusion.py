"""LQG of all channels and several sensors together."""

from collections.abc import Sequence
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from wavequake.chain.loops.block import register
from wavequake.chain.loops.controllers.lqg import NO_MODES, Expecting
from wavequake.chain.loops.design import Array, Design, decoupling
from wavequake.control.frames.disturbance import Shaped, oscillator
from wavequake.control.sampled.fusion import Known, Seen, fused
from wavequake.control.sampled.regulator import Regulator, whole
from wavequake.errors import UserError

# Frequencies that a sentence names.
_NAMED = 4


def _hertz(expected: Sequence[Shaped]) -> str:
    """Name the frequencies of what is expected."""
    poles = np.concatenate([np.linalg.eigvals(one.a) for one in expected])
    found = list(dict.fromkeys(f"{abs(pole) / (2 * np.pi):.3g} Hz" for pole in poles))
    more = f" and {len(found) - _NAMED} more" if len(found) > _NAMED else ""
    return ", ".join(found[:_NAMED]) + more


@register
class LqgFusion(Expecting):
    """A Kalman predictor of what the first sensor sees, from the readings of all.

    What is expected besides the structure moves as the actuator does. With `structure`, every sensor sees
    modes in its own way, and the filter knows how they answer the actuator, too.
    """

    fuses: ClassVar[bool] = True

    model: Literal["lqg-fusion"] = "lqg-fusion"

    def design(self, asked: Design) -> Regulator:
        """Return one controller of all readings.

        Raises
        ------
        UserError
            If there is no structure that is asked for, or no such filter.
        """
        channels = decoupling(asked, self.modes, rates=True)
        parts = self._told(asked, np.linalg.norm(channels, axis=1))
        structure, drives = (asked.answering, asked.drives) if self.structure else ((), asked.drives[:0])
        if self.structure:
            parts += self._structure(asked)
        seen = []
        for place, watch in enumerate(asked.watched):
            rows = np.hstack([columns[place] * one.c for one, columns in parts])
            if not rows.any():
                raise UserError(
                    f"controller.{self.name}: the sensor {watch.sensor!r} sees nothing of what it expects "
                    f"({_hertz([one for one, _ in parts])}); leave it out, or expect what that sensor sees."
                )
            noise = self.noise_of(asked) if place == 0 else watch.noise
            answers = watch.answers[:, : len(structure)]
            seen.append(Seen(rows, watch.sees, answers, watch.shows, noise))
        a, g = (block_diag(*(getattr(one, name) for one, _ in parts)) for name in ("a", "g"))
        known = Known(a, g, channels @ seen[0].disturbance)
        try:
            return whole(fused(known, seen, asked.follows, asked.timing, structure, drives))
        except UserError as error:
            raise UserError(f"controller.{self.name}: {error}") from None

    def sizes(self, asked: Design) -> Array:
        """Return the rms of each mode in the reading that shows most of it, per the reading's noise."""
        shown = [np.abs(one.shaken) / (one.noise or 1.0) for one in asked.watched]
        return np.asarray(np.vstack(shown).max(axis=0))

    def expects(self, sizes: Array) -> NDArray[np.bool_]:
        """Return of which modes that much is enough: all that any sensor sees."""
        return sizes > 0

    def _told(self, asked: Design, sizes: Array) -> list[tuple[Shaped, list[Array]]]:
        """Return lines and drift of every channel in its unit, and how each sensor sees them."""
        unit = np.eye(len(sizes)) * sizes
        return [
            (one, [watch.sees @ unit[:, [channel]] for watch in asked.watched])
            for channel in range(len(sizes))
            for one in self.told()
        ]

    def _structure(self, asked: Design) -> list[tuple[Shaped, list[Array]]]:
        """Return the modes that are shaken, and how each sensor sees them."""
        where = f"controller.{self.name}.structure"
        if asked.shaken is None:
            raise UserError(f"{where}: {NO_MODES}")
        found = []
        for k in np.flatnonzero(self.expects(self.sizes(asked))):
            hertz, zeta = float(asked.shaken.hertz[k]), float(asked.shaken.zeta[k])
            columns = [watch.shaken[:, [k]] for watch in asked.watched]
            found.append((oscillator(hertz, 4 * np.pi * zeta * hertz, 1.0), columns))
        if not found:
            raise UserError(
                f"{where}: no sensor sees a mode of the structure shaken; set rms_nm of [[mode]] blocks, or "
                "let a disturbance act on bodies."
            )
        return found
