"""Declared systems of units: ``"m,kg,s,N"``, ``"mm,t,s,N"``, ... into SI."""

from wavequake.errors import UserError

LENGTH = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": 0.0254, "ft": 0.3048}
MASS = {
    "kg": 1.0,
    "g": 1e-3,
    "t": 1e3,
    "lb": 0.45359237,
    "slug": 14.593902937206364,
    "slinch": 175.12683524647637,
}
TIME = {"s": 1.0, "ms": 1e-3}
FORCE = {"N": 1.0, "mN": 1e-3, "kN": 1e3, "uN": 1e-6, "dyn": 1e-5, "lbf": 4.4482216152605}


def si_factors(units: str) -> tuple[float, float, float]:
    """Return what coordinates, mass and stiffness are multiplied by.

    Parameters
    ----------
    units : str
        Length, mass, time and force, separated by commas.

    Raises
    ------
    UserError
        If a unit is unknown, or the force is not mass times length over time squared.
    """
    words = [word.strip() for word in units.split(",")]
    tables = {"length": LENGTH, "mass": MASS, "time": TIME, "force": FORCE}
    if len(words) != 4:
        raise UserError(
            f"units = {units!r}: length, mass, time and force are needed, such as 'm,kg,s,N' or 'mm,t,s,N'"
        )
    factors = []
    for (what, table), word in zip(tables.items(), words, strict=True):
        if word not in table:
            raise UserError(f"units = {units!r}: {word!r} is no unit of {what}, known are {', '.join(table)}")
        factors.append(table[word])
    length, mass, time, force = factors
    coherent = mass * length / time**2
    if abs(coherent - force) > 1e-6 * force:
        raise UserError(
            f"units = {units!r} do not fit together: {words[1]} {words[0]}/{words[2]}^2 is {coherent:.6g} N, "
            f"and {words[3]} is {force:.6g} N; solvers work in coherent units such as 'mm,t,s,N'"
        )
    return length, mass, force / length
