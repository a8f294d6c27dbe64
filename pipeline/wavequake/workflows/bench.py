"""What a segment-disturbance study prepares once per process: telescope, rays, fit, PSF basis, LOS gains."""

import io
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from wavequake.imaging.segment_psf import SegmentBasis, ray_basis, segment_basis
from wavequake.kernels.devices import choose_device
from wavequake.kernels.tiles import TILE
from wavequake.mechanics.disturbances import Disturbance, Motion
from wavequake.mechanics.layout import SegmentLayout
from wavequake.optics.pupils import PupilRays, on_glass, segment_rays, sunflower
from wavequake.optics.states import SurfaceStates, rest
from wavequake.optics.systems import FirstOrder, OpticalSystem, first_order
from wavequake.optics.telescopes import telescope
from wavequake.optics.wavefront import PreparedTrace, Wavefront, measure, prepare
from wavequake.workflows.study import Study, study_from_identity

MM_PER_M = 1e3
MAS_PER_RAD = 180.0 / np.pi * 3600.0 * 1e3
_TRIANGLE_POINTS = {6: 1, 18: 3, 36: 6, 72: 12}
_ARCMIN = np.pi / 180.0 / 60.0


@dataclass(frozen=True)
class Bench:
    """Everything of a study that does not change from case to case.

    ``m2_tilt`` (2, 2) gives M2's rotations about x and y in rad per rad of line of sight on the sky;
    ``static`` is the wavefront of the reference configuration; ``basis`` turns segment phases into images.
    """

    study: Study
    system: OpticalSystem
    first_order: FirstOrder
    layout: SegmentLayout
    rays: PupilRays
    prepared: PreparedTrace
    static: Wavefront
    m2_tilt: NDArray[np.float64]
    figure_terms: int

    @property
    def wavelength(self) -> float:
        """Wavelength in mm."""
        return self.study.optics.wavelength_nm * 1e-6

    @property
    def monolithic(self) -> bool:
        """Whether M1 is one mirror without edges."""
        return self.system.segments.corners.shape[1] == 0


@lru_cache(maxsize=2)
def bench_of(study_text: str) -> Bench:
    """Prepare the study with this identity text.

    Raises
    ------
    UserError
        If no ray of the pupil meets glass, polygons overlap, or the study is otherwise impossible.
    """
    study = study_from_identity(study_text)
    system = build_telescope(study)
    rays = build_rays(study, system)
    terms = figure_terms(study.disturbance)
    prepared = prepare(system, rays, study.optics.wavelength_nm * 1e-6, study.wavefront.zernike_terms, figure_terms=terms)
    static, tilt = _reference(study, system, prepared)
    return Bench(study, system, first_order(system), layout_of(system), rays, prepared, static, tilt, terms)
