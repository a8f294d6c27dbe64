"""Telescopes that tests of their wavefronts share."""

import pytest
from wavefront_cases import TERMS, WAVELENGTH, quadrature_rays, sunflower_rays

from wavequake.optics.segments.catalog import telescope
from wavequake.optics.segments.prepared import prepare


@pytest.fixture(scope="module")
def thesis():
    system = telescope("tmt-thesis")
    return prepare(system, quadrature_rays(system.annulus.inner, system.annulus.outer), WAVELENGTH, TERMS)


@pytest.fixture(scope="module")
def tmt18():
    system = telescope("tmt-18")
    return prepare(system, sunflower_rays(system), WAVELENGTH, TERMS)
