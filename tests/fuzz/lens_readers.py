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

# Behind coordinates that turn: with and without a bend, back again, and for what follows alone.
FOLDED = (
    "RDM;LEN\nEPD 8\nDIM M\nWL 550\nYIM 0.0 2.0\nVUX 0.0 0.1\nSO 0.0 0.1e14\nS 0.0 20.0\n"
    "S 90.0 4.0 1.517:64.2\n  STO\n  CIR OBS 0.5\nS 0.0 -30.0 REFL\n"
    "  ADE 45.0; BEN\nS 0.0 -5.0\n  XDE 0.1; ZDE 0.2; CDE 10.0; BDE -2.0\n"
    "S 0.0 -3.0\n  BDE 2.0; REV\nSI 0.0 0.0\nGO\n"
)
HEADER = "UNIT MM X W\nENPD 4\nWAVM 1 0.55 1\nFTYP 0 0 1 1 0 0 0\nYFLN 0\nGCAT SCHOTT\n"
# The object is a slit that stands twice; surfaces are tilted by themselves, and openings of every form.
SPECTROGRAPH = (
    HEADER.replace("ENPD 4", "OBNA 0.02 0"),
    "DISZ 0; SQAP 5 2",
    "COMM slit; DISZ 80",
    "CURV 0.01; GLAS N-BK7 0 0 1.5 40; CLAP 0 9 0; DISZ 4",
    "CURV -0.01; SCBD 1 0 0 0.1 0.2 1 2 3; SCBD 2 1 2 -0.1 -0.2 -1 -2 -3; ELAP 8 7; OBDC 0.1 0.2; DISZ 20",
    "TYPE COORDBRK; PARM 1 0.1; PARM 3 2.0; PARM 6 1; DISZ 1",
    "STOP; SPID 0.2 3; DISZ 5",
    "TYPE DGRATING; SCBD 1 0 0 0 0 5 0 0; SCBD 2 0 1 0 0 5 0 0; PARM 1 0.1; PARM 2 1; SQAP 8 8; DISZ 10",
    "GLAS MIRROR 0 0; SCBD 1 0 0 0 0 45 0 0; SCBD 2 0 1 0 0 45 0 0; OBSC 0 0.1; DISZ -60",
    "DISZ 0",
)
# A lens of three distances, saved in the second.
ZOOM = (
    HEADER,
    "DISZ INFINITY",
    "STOP; CURV 0.02; GLAS N-BK7 0 0 1.5 40; DISZ 4",
    "CURV -0.02; DISZ 6; MAZH 0 0",
    "DISZ 0\nMNUM 3 2\n"
    "THIC 1 1 2\nTHIC 1 2 4\nTHIC 1 3 6\nCRVT 2 1 -0.01\nCRVT 2 2 -0.02\nCRVT 2 3 -0.03\n"
    "YFIE 1 1 0\nYFIE 1 2 0\nYFIE 1 3 1",
)
SHAPES = (  # of a surface of each type
    "TYPE XPOLYNOM; CURV 0.01; XDAT 1 5; XDAT 2 10; XDAT 5 1e-4; XDAT 7 2e-4",
    "TYPE SZERNSAG; CURV 0.01; PARM 2 1e-7; XDAT 1 11; XDAT 2 10; XDAT 13 1e-4",
    "TYPE FZERNSAG; CURV 0.01; XDAT 1 9; XDAT 2 10; XDAT 11 1e-4",
    "TYPE BICONICX; CURV 0.01; CONI -0.5; PARM 1 120; PARM 2 0.1",
    "TYPE ODDASPHE; CURV 0.01; PARM 1 1e-6; PARM 3 1e-5",
    "TYPE BINARY_1; CURV 0.01; PARM 0 1; PARM 2 1e-7; XDAT 1 5; XDAT 2 10; XDAT 5 -20; XDAT 7 -20",
    "TYPE BINARY_2; CURV 0.01; PARM 0 1; XDAT 1 2; XDAT 2 10; XDAT 3 -30; XDAT 4 1",
    "TYPE GRINSUR1; PARM 1 0.5; PARM 2 1.6; PARM 3 -0.002",
    "TYPE GRINSUR3; PARM 1 0.5; PARM 2 1.6; PARM 6 0.002; PARM 7 -1e-5",
    "TYPE XASPHERE; CURV 0.01; XDAT 1 2; XDAT 2 10; XDAT 3 1e-6; XDAT 4 1e-4",
    "TYPE XOSPHERE; CURV 0.01; XDAT 1 3; XDAT 2 10; XDAT 3 1e-6; XDAT 5 1e-4",
    "TYPE IRREGULA; CURV 0.01; PARM 3 0.5; PARM 4 0.2; PARM 6 0.1",
    "TYPE TILTSURF; PARM 1 0.01; PARM 2 0.02",
    "TYPE FZERNPHA; CURV 0.01; PARM 0 1; XDAT 1 5; XDAT 2 10; XDAT 5 0.5; XDAT 7 0.2",
    "TYPE TOROGRAT; CURV 0.01; PARM 1 100; PARM 2 0.01; PARM 3 1; SQOB 1 1",
    "CURV 0.01; ELOB 1 2; OBDC 0.1 0.2",
    "TYPE GRINSUR5; PARM 1 0.5; PARM 2 1.6; PARM 3 -0.001; PARM 4 1e-7",
    "TYPE HOLOGRM2; PARM 3 -200; PARM 6 150; PARM 7 0.55; PARM 8 1",
    "CURV 0.01; USAP 0 0 0; OBDC 0 0; UDAD 0 a 1; UDAD 1 -3 -3 0; UDAD 2 -3 3 0; UDAD 3 3 3 0; UDAD 4 3 -3 0",
    "CURV 0.01; USOB 0 0 0; OBDC 1 0; UDAD 0 a 1; UDAD 1 -1 -1 0; UDAD 2 -1 1 0; UDAD 3 1 1 0; UDAD 4 0 0 0",
)


def written(header: str, *rows: str) -> str:
    """Return a lens file of rows whose lines are parted by semicolons."""
    lines = (f"SURF {k}\n  " + row.replace("; ", "\n  ") for k, row in enumerate(rows))
    return header + "\n".join(lines) + "\n"


def of_shape(row: str) -> str:
    """Return a lens whose first surface is of a type."""
    glass = "" if "GRIN" in row else "; GLAS N-BK7 0 0 1.5 40"
    return written(HEADER, "DISZ INFINITY", f"{row}; STOP; DIAM 4{glass}; DISZ 5", "DISZ 90", "DISZ 0")


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
    from wavequake.workflows.systems.source import described

    return described(str(path), [])


def zoomed(path: Path) -> object:
    """Read a lens file in a configuration other than that in which it was saved."""
    from wavequake.workflows.systems.source import described

    return described(str(path), ["configuration=3"])


def glasses(path: Path) -> object:
    from wavequake.optics.media.agf import read_agf

    return read_agf(path)


def lens_files() -> tuple[Callable[[], bytes], ...]:
    """Lenses, mirrors behind coordinate breaks, a spectrograph, heights and vignetting factors.

    And a surface of every type that can be read.
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
    made = (ROD, grid(), written(*SPECTROGRAPH), *(of_shape(row) for row in SHAPES))
    return (*((DATA / f"{name}.zmx").read_bytes for name in names), *(one.encode for one in made))


def archives() -> tuple[Callable[[], bytes], ...]:
    """Archives of both kinds, with a lens among other files."""
    lens = (DATA / "lenses" / "pyzdde_doublet.zmx").read_bytes
    return tuple(lambda recent=recent: zar_file.archive(lens(), recent) for recent in (True, False))
