"""How many rays per segment the wavefront error needs.

Independent random pistons (20 nm), tips, tilts (20 nrad) or figures (20 nm of one Noll term) of all
segments at 16 instants: the rms over them of the raw WFE (on glass, piston removed) and of the fitted one
(45 polynomials from j = 4 on), by rays per segment, relative to those of a dense square grid of rays. The
grid itself is good to 0.1 % of the raw WFE and, as it cuts edges in steps, to 0.05 nm of the fitted one.

``python -m benchmarks.convergence``
"""

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from wavequake.kernels.device.devices import choose_device
from wavequake.kernels.device.tiles import TILE
from wavequake.optics.rays.pupils import PupilRays, grid_rays, on_glass, segment_rays
from wavequake.optics.segments.catalog import telescope
from wavequake.optics.segments.prepared import prepare
from wavequake.optics.segments.wavefront import measure
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.systems.system import OpticalSystem, States

WAVELENGTH = 550e-6  # mm
SPACING = 60.0  # of the dense grid, mm
POINTS = {6: 1, 18: 3, 36: 6, 72: 12}  # rays per hexagon: per triangle
RIGID = {"piston": 2, "tip": 3, "tilt": 4}
FIGURES = range(4, 12)


def states(system: OpticalSystem, kind: str) -> States:
    """One random motion or figure per instant and segment."""
    drawn = rest_states(system, TILE)
    values = np.random.default_rng(7).standard_normal((TILE, len(system.segments)))
    if kind in RIGID:
        drawn.segment_motion[:, :, RIGID[kind]] = values * (20e-6 if kind == "piston" else 20e-9)
    else:
        drawn.segment_figure[:, :, int(kind[1:]) - 1] = values * 20e-6
    return drawn


def errors(system: OpticalSystem, rays: PupilRays, kinds: list[str]) -> NDArray[np.float64]:
    """Raw and fitted WFE (kind, 2) in nm, rms over the instants."""
    prepared = prepare(system, rays, WAVELENGTH, 45, figure_terms=FIGURES[-1])
    device = choose_device("auto")
    found = []
    for kind in kinds:
        wavefront = measure(prepared, states(prepared.system, kind), device)
        found.append(
            [np.sqrt(np.mean(rms**2)) * WAVELENGTH * 1e6 for rms in (wavefront.rms_raw, wavefront.rms)]
        )
    return np.array(found)


def main() -> None:
    kinds = [*RIGID, *(f"j{noll}" for noll in FIGURES)]
    for name in ("tmt", "tmt-18"):
        system = telescope(name)
        extent = float(np.hypot(*system.segments.corners.reshape(-1, 2).T).max())
        dense = errors(system, on_glass(system, grid_rays(extent, SPACING)), kinds)
        table = Table(title=f"{name}: WFE by rays per segment, difference from a dense grid in percent")
        for heading in (
            "case",
            "raw nm",
            *(f"raw {n}" for n in POINTS),
            "fit nm",
            *(f"fit {n}" for n in POINTS),
        ):
            table.add_column(heading, justify="right")
        sampled = np.array([errors(system, segment_rays(system.segments, n), kinds) for n in POINTS.values()])
        percent = 100 * (sampled / dense - 1)
        for row, kind in enumerate(kinds):
            cells = []
            for which in (0, 1):
                cells += [f"{dense[row, which]:.2f}", *(f"{value:+.2f}" for value in percent[:, row, which])]
            table.add_row(kind, *cells)
        Console(width=140).print(table)


if __name__ == "__main__":
    main()
