"""Labelled Zernike coefficients by other indices and over other annuli, and the key that stores them."""

import numpy as np
import pytest
import xarray as xr

import wavequake as wq
from wavequake.errors import UserError
from wavequake.kernels.device.devices import NUMPY
from wavequake.optics.polynomials.zernike import annular_zernike
from wavequake.optics.systems.kinematics import rest_states
from wavequake.optics.wavefronts.wavefront import trace_system
from wavequake.workflows.study import load_study
from wavequake.workflows.systems.bench import system_bench
from wavequake.workflows.systems.disturbance import KIND

KEYS = ["optics.rays=200", "wavefront.zernike_terms=21", "campaign.device=numpy"]


def array(values, **attrs):
    values = np.atleast_2d(values)
    noll = np.arange(1, values.shape[1] + 1)
    return xr.DataArray(values, {"noll": noll}, ("case", "noll"), attrs=attrs, name="zernike")


def unit(j, count, size=1.0):
    return size * np.eye(count)[j - 1]


def test_single_aberrations_have_their_ansi_and_fringe_places():
    """Defocus is Noll 4, ANSI 4, Fringe 4; coma along x Noll 8, ANSI 8, Fringe 7; spherical 11, 12, 9."""
    for noll, ansi, fringe, peak in ((4, 4, 4, np.sqrt(3)), (8, 8, 7, np.sqrt(8)), (11, 12, 9, np.sqrt(5))):
        one = array(unit(noll, 15, 2.0), obscuration="0.0")
        by_ansi, by_fringe = wq.convert_zernike(one, "ansi"), wq.convert_zernike(one, "fringe")
        assert by_ansi.dims == ("case", "ansi")
        assert by_ansi.sel(ansi=ansi).item() == pytest.approx(2.0)
        assert by_fringe.sel(fringe=fringe).item() == pytest.approx(2.0 * peak)
        assert np.count_nonzero(by_ansi) == np.count_nonzero(by_fringe) == 1
    assert by_ansi["ansi"].values[0] == 0
    assert by_fringe["fringe"].values[0] == 1


def test_another_annulus_holds_the_same_wavefront():
    x, y = np.random.default_rng(1).uniform(-0.7, 0.7, (2, 50))
    values = np.random.default_rng(2).normal(size=(3, 21))
    given = array(values, obscuration="0.3", units="nm")
    circular = wq.convert_zernike(given, target=0.0)
    wave = annular_zernike(x, y, 21, 0.3) @ values.T
    np.testing.assert_allclose(annular_zernike(x, y, 21, 0.0) @ circular.values.T, wave, rtol=0, atol=1e-12)
    assert circular.attrs == {"obscuration": "0.0", "units": "nm"}
    back = wq.convert_zernike(circular, target=0.3)
    np.testing.assert_allclose(back, given, rtol=0, atol=1e-12)
    # Fringe polynomials are those of the circle, of unit peak: written out, Fringe 4 is 2 r^2 - 1.
    fringe = wq.convert_zernike(array(unit(4, 4), obscuration="0.3"), "fringe")
    at = np.array([0.3, 1.0])
    truth = annular_zernike(at, 0 * at, 4, 0.3)[:, 3]
    np.testing.assert_allclose(
        fringe.sel(fringe=1).item() + fringe.sel(fringe=4).item() * (2 * at**2 - 1), truth
    )


def test_an_unknown_piston_stays_unknown():
    values = unit(11, 15)
    values[0] = np.nan
    found = wq.convert_zernike(array(values, obscuration="0.2"), "ansi", target=0.0)
    assert np.isnan(found.sel(ansi=0)).all()
    assert np.isfinite(found.sel(ansi=slice(1, None))).all()


@pytest.mark.parametrize(
    ("coefficients", "index", "more", "match"),
    [
        (array(unit(4, 6)), "noll", {}, "does not say over which annulus"),
        (array(unit(4, 6)), "zemax", {"source": 0.0}, "'zemax' is unknown; choose one of noll, ansi, fringe"),
        (array(unit(4, 6)).sel(noll=4), "ansi", {"source": 0.0}, "no dimension 'noll', only case"),
        (array(unit(4, 6)).sel(noll=[4, 5]), "ansi", {"source": 0.0}, "must count 1, 2"),
        (array(unit(4, 6)), "fringe", {"source": 0.2, "target": 0.2}, "full circle"),
        (array(unit(4, 6)), "noll", {"source": 1.0, "target": 0.0}, "ratio .* is 1.0"),
        (array(unit(4, 6)), "noll", {"source": 0.1, "target": np.nan}, "ratio .* is nan"),
        (array(unit(4, 6)), "noll", {"source": "wide"}, "ratio .* is 'wide'"),
        (array(unit(4, 6)), "noll", {"source": [0.1]}, r"ratio .* is \[0.1\]"),
        (array(unit(4, 6)), ["noll"], {"source": 0.0}, "is unknown; choose one of"),
        (array(unit(4, 6)).astype(str), "ansi", {"source": 0.0}, "coefficients must be an array of numbers"),
    ],
)
def test_what_cannot_be_converted_is_refused(coefficients, index, more, match):
    with pytest.raises(UserError, match=match):
        wq.convert_zernike(coefficients, index, **more)


STUDY = """
[study]
name = "ring"
workflow = "system-disturbance"
[system]
name = "herschel"
[[disturbance]]
name = "askew"
model = "surface-random"
of = ["M2"]
rms = { dx_um = 100.0, rx_urad = 20.0 }
"""


def test_the_study_key_stores_what_a_direct_fit_of_circular_polynomials_finds(tmp_path):
    (tmp_path / "ring.toml").write_text(STUDY)
    texts = [
        load_study(tmp_path / "ring.toml", [*KEYS, f'wavefront.basis="{basis}"']).identity_text()
        for basis in ("annular", "circular")
    ]
    bench = system_bench(texts[1])
    prepared = bench.prepared[1][0]
    opd = trace_system(prepared, rest_states(bench.system), NUMPY)[0][0]
    root, to_nm = np.sqrt(prepared.fit.weight), 1e6 * prepared.wavelength
    polynomials = annular_zernike(*prepared.pupil.T, 21, 0.0)
    expected = np.linalg.lstsq(root[:, None] * polynomials, root * opd * to_nm, rcond=None)[0]
    fixed = KIND.template(texts[1]).fixed["zernike_static"]
    np.testing.assert_allclose(fixed[1][1, 0], expected, rtol=0, atol=1e-6 * np.abs(expected).max())
    assert fixed[2]["obscuration"] == "0.0"
    annular = KIND.template(texts[0])
    assert float(annular.fixed["zernike_static"][2]["obscuration"]) == bench.system.pupil.obscuration
    assert (
        annular.per_case["zernike"].attrs["obscuration"] == annular.fixed["zernike_static"][2]["obscuration"]
    )
    one, other = (KIND.compute(text, np.array([0]), "numpy").arrays for text in texts)
    assert np.abs(one["zernike"] - other["zernike"]).max() > 1.0
    for name in ("wfe_rms", "wfe_change", "los_mm", "strehl"):
        np.testing.assert_array_equal(one[name], other[name], err_msg=name)


def test_sensitivities_say_over_which_annulus_they_are(tmp_path):
    (tmp_path / "ring.toml").write_text(STUDY)
    found = wq.sensitivity(
        tmp_path / "ring.toml", store=tmp_path / "store", optics__rays=100, wavefront__zernike_terms=11
    )
    fringe = wq.convert_zernike(found.sensitivity_zernike_surface, "fringe")
    assert fringe.dims == ("field", "surface", "dof", "fringe")
    assert fringe.attrs["units"] == "nm per m or rad"


def test_a_store_of_segments_tells_its_annulus(tmp_path):
    keys = {"telescope.name": "tmt-18", "optics.rays_per_segment": 18, "wavefront.zernike_terms": 21}
    keys |= {"imaging.enabled": False, "campaign.device": "numpy"}
    overrides = {key.replace(".", "__"): value for key, value in keys.items()}
    made = wq.run("tmt-segments", cases=1, store=tmp_path / "store", on="serial", **overrides)
    circular = wq.convert_zernike(made.zernike, target=0.0)
    assert float(made.zernike.attrs["obscuration"]) > 0.05
    assert circular.attrs["obscuration"] == "0.0"
    back = wq.convert_zernike(circular, target=float(made.zernike.attrs["obscuration"]))
    np.testing.assert_allclose(back.transpose(*made.zernike.dims), made.zernike, rtol=0, atol=1e-9)
