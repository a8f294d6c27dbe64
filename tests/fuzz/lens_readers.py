"""Readers of lens files and of catalogues of glasses, each with small valid files."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import zar_file

DATA = Path(__file__).parents[1] / "data"

ROD = (
    "UNIT MM X W\nENPD 0.1\nWAVM 1 0.55 1\nFTYP 0 0 1 1 0 0 0\nYFLN 0\nSURF 0\n  DISZ INFINITY\nSURF 1\n"
    "  TYPE GRINSUR2\n  PARM 1 0.1\n  PARM 2 1.6\n  PARM 3 -0.004\n  STOP\n  DISZ 20.0\nSURF 2\n  DISZ 5\n"
    "SURF 3\n  DISZ 0\n"
)
SEQUENCE = (
    "RDM;LEN ! radii\nTITLE 'A doublet; with a stop'\nEPD 10.0\nDIM M\nWL 656.3 587.6 &\n   486.1\nREF 2\n"
    "XAN 0.0 0.0\nYAN 0.0 3.0\nVUY 0.0 0.2\nVLY 0.0 0.4\nSO 0.0 0.1e14\nS 61.5 6.0 NBK7_SCHOTT\n  CIR 8.0\n"
    "S -43.5 2.5 'SF5_SCHOTT'\n  CCY 0; THC 0\nS -124.0 3.0\n  CON\n  K -0.5\nS 0.0 1.5 517.642\n  ASP\n"
    "  A 1.0e-6; B 2e-9\nS 0.0 80.0\n  STO\n  DAR\n  YDE 0.1; ADE -0.5\n  REX 9.0; REY 9.0; ADY 0.1\n"
    "SI 0.0 -0.1\nGO\n"
)
GLASSES = (
    "CC two glasses\nNM N-BK7 2 517642.251 1.5168 64.17 0 1\nED 7.1 8.3 2.51 -0.0009 0\n"
    "CD 1.03961212 6.00069867E-3 2.31792344E-1 2.00179144E-2 1.01046945 1.03560653E2 0 0 0 0\n"
    "TD 1.86E-6 1.31E-8 -1.37E-11 4.34E-7 6.27E-10 0.17 20\nLD 0.31 2.325\nIT 0.31 0.25 25\n"
    "NM OLD 1 0 1.6 50\nCD 2.5 -0.01 0.012 0.0002 0 0\nLD 0.4 0.7\n"
)


def grid() -> str:
    """A mirror whose surface is a grid of heights."""
    x = np.arange(9) - 4.0
    heights = -(x**2 + x[:, None] ** 2) / 400
    nodes = "".join(f"  GARR {k} {z:.6f} 0 0 0 0\n" for k, z in enumerate(heights.ravel(), start=1))
    return (
        "UNIT MM X W\nENPD 5\nWAVM 1 0.55 1\nFTYP 0 0 1 1 0 0 0\nYFLN 0\nSURF 0\n  DISZ INFINITY\nSURF 1\n"
        f"  TYPE GRID_SAG\n  STOP\n  GLAS MIRROR 0 0\n  GDAT 9 9 1 1\n{nodes}  DISZ -100\nSURF 2\n  DISZ 0\n"
    )


def lens(path: Path) -> object:
    """Read a lens file and say what `wavequake info` says of it: it is traced."""
    from wavequake.workflows.systems.system_source import described

    return described(str(path), [])


def glasses(path: Path) -> object:
    from wavequake.optics.media.agf import read_agf

    return read_agf(path)


def lens_files() -> tuple[Callable[[], bytes], ...]:
    """Lenses, mirrors behind coordinate breaks, a varying index, a grid, heights and vignetting factors.

    And a toroid, a grating, a perfect lens and an asphere of Forbes'.
    """
    names = (
        "cooke_triplet",
        "lenses/pyzdde_doublet",
        "lenses/optiland_one_mirror_up_45deg",
        "lenses/pyzdde_tessar_lens_using_vignetting_factors",
        "lenses/otk_aspheric_telecentric_lens",
        "lenses/ray_optics_asl5040_uv_zemax_zmx",
        "lenses/ray_optics_hoo_v2c18ex46",
        "lenses/optiland_curved_transmission_grating",
        "lenses/deeplens_zemax_double_gaussian",
    )
    return (*((DATA / f"{name}.zmx").read_bytes for name in names), ROD.encode, lambda: grid().encode())


def archives() -> tuple[Callable[[], bytes], ...]:
    """Archives of both kinds, with a lens among other files."""
    lens = (DATA / "lenses" / "pyzdde_doublet.zmx").read_bytes
    return tuple(lambda recent=recent: zar_file.archive(lens(), recent) for recent in (True, False))
