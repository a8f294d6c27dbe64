"""Glasses of which only the index, the Abbe number and the partial dispersion are known."""

import numpy as np

from wavequake.errors import UserError
from wavequake.optics.media.glasses import Medium

_LINES = {"C": 0.6562725, "d": 0.5875618, "F": 0.4861327, "g": 0.4358343}  # um
_RANGE_NM = (365.0, 1100.0)


def model_glass(index: float, abbe: float, deviation: float = 0.0) -> Medium:
    """Return a glass with an index n_d, an Abbe number and a partial dispersion P_gF.

    The index follows Conrady's formula n = k0 + k1 / w + k2 / w^3.5, whose three numbers these three
    determine: n_d, (n_d - 1) / (n_F - n_C) and (n_g - n_F) / (n_F - n_C), which is by `deviation` beside the
    normal line of Schott through K7 and F2, 0.6438 - 0.001682 V. Catalogue glasses are met to some 1e-4 from
    405 to 707 nm, and to 4e-4 at 1064 nm. Beyond 365 to 1100 nm it is not known.

    Raises
    ------
    UserError
        If the numbers are those of no glass.
    """
    if not (1.0 < index < 5.0 and 5.0 < abbe < 200.0 and abs(deviation) < 0.5):
        raise UserError(
            f"A model glass has an index from 1 to 5, an Abbe number from 5 to 200 and a deviation of the "
            f"partial dispersion below 0.5, not {index:g}, {abbe:g} and {deviation:g}."
        )
    c, d, f, g = (np.array([1.0, 1.0 / w, w**-3.5]) for w in _LINES.values())
    spread = (index - 1.0) / abbe
    partial = (0.6438 - 0.001682 * abbe + deviation) * spread
    numbers = np.linalg.solve(np.array([d, f - c, g - f]), [index, spread, partial])
    name = f"n={index!r} V={abbe!r}" + (f" dP={deviation!r}" if deviation else "")
    return Medium(name, "conrady", tuple(float(k) for k in numbers), _RANGE_NM)
