import shutil
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

import wavequake as wq
from wavequake.campaign.store import arrays
from wavequake.chain import sensitivities as sensitivities_kept
from wavequake.chain.sensitivities import open_sensitivity
from wavequake.errors import StoreDamageError, UserError
from wavequake.kernels.device.devices import NUMPY
from wavequake.optics.segments.sensitivity import sensitivities
from wavequake.workflows import sensitivity as module
from wavequake.workflows.segments.bench import bench_of
from wavequake.workflows.sensitivity import stored_sensitivity
from wavequake.workflows.study import study_with

STUDY = """
[study]
name = "small"
workflow = "segment-disturbance"
[telescope]
name = "tmt-18"
[optics]
rays_per_segment = 6
[wavefront]
zernike_terms = 11
[imaging]
pixels = 16
[campaign]
device = "numpy"
cases = 2
[store]
chunk_cases = 2
[[disturbance]]
name = "pistons"
model = "static-random"
piston_nm = 20.0
instants = 2
"""


def stored_dataset(*words, **terms):
    found, kept = stored_sensitivity(*words, **terms)
    return found.dataset(), kept


@pytest.fixture
def study(tmp_path_factory):
    path = tmp_path_factory.mktemp("study") / "small.toml"
    path.write_text(STUDY)
    return wq.load_study(path)


def test_figures_of_mirrors_are_stored_with_their_units(study, tmp_path):
    """A constant figure of M2 is its shift along z, 1 m per m; other terms ask for another computation."""
    ds = wq.sensitivity(study, store=tmp_path, mirror_terms=3)
    assert list(ds.mirror.values) == ["M2", "M3"]
    assert ds.sizes["mirror_term"] == 3
    one = ds.sensitivity_zernike_mirror.sel(mirror="M2", mirror_term=1)
    other = ds.sensitivity_zernike_surface.sel(surface="M2", dof="dz")
    assert one.attrs["units"] == "nm per m"
    np.testing.assert_allclose(one, other, rtol=0, atol=1e-5 * np.abs(other).max())
    assert ds.steps_agree
    _, kept = stored_sensitivity(study, tmp_path, mirror_terms=3)
    assert kept
    without, kept = stored_dataset(study, tmp_path, mirror_terms=0)
    assert not kept
    assert "mirror" not in without.coords


def test_figures_of_mirrors_are_there_without_being_asked_for(study, tmp_path):
    """Störkle 2018, Eq. 4.26, by default with 11 terms, the same numbers as if they were asked for."""
    ds = wq.sensitivity(study, store=tmp_path / "one")
    assert ds.mirror_term.values.tolist() == list(range(1, 12))
    assert stored_sensitivity(study, tmp_path / "one", mirror_terms=11)[1]
    # A figure on M2 is worth twice its height: the footprint of the axial beam is the pupil.
    found = ds.sensitivity_zernike_mirror.sel(mirror="M2", mirror_term=6, noll=6).item() * 1e-9
    assert abs(found) == pytest.approx(2.0, rel=0.1)


def test_a_telescope_without_further_mirrors_has_no_figures_of_them(study, tmp_path, monkeypatch):
    bench = bench_of(study.identity_text())
    lone = replace(bench.system, surfaces=(*bench.system.surfaces[:2], bench.system.surfaces[-1]))
    monkeypatch.setattr(module, "bench_of", lambda text: replace(bench, system=lone))
    monkeypatch.setattr(module, "kept_or_made", lambda study, path, terms, make: (terms, False))
    asked, _ = stored_sensitivity(study, tmp_path)
    assert asked["mirror_terms"] == 0
    with pytest.raises(UserError, match="no mirror after M1"):
        stored_sensitivity(study, tmp_path, mirror_terms=3)


def test_the_thesis_telescope_has_the_printed_tilt_of_m2(study, tmp_path):
    """Störkle 2018, Eq. 4.24, in mm/rad; and the independent trace's coma, in nm/rad."""
    keys = {"telescope__name": "tmt-thesis", "optics__sampling": "sunflower", "wavefront__zernike_terms": 45}
    m2 = wq.sensitivity(study, store=tmp_path / "store", **keys).sel(surface="M2")
    los = m2.sensitivity_los_surface
    assert los.attrs["units"] == "mm per m or rad"
    assert float(los.sel(dof="rx", axis="y")) == pytest.approx(-85460.0215, rel=1e-6)
    assert float(los.sel(dof="ry", axis="x")) == pytest.approx(85460.0215, rel=1e-6)
    zernike = m2.sensitivity_zernike_surface
    assert zernike.attrs["units"] == "nm per m or rad"
    assert float(zernike.sel(dof="rx", noll=7)) == pytest.approx(-18086.2146 * 550, rel=1e-6)
    assert float(zernike.sel(dof="dz", noll=4)) == pytest.approx(-61345.5440 * 550, rel=1e-6)


def test_units_and_labels(study, tmp_path):
    ds = wq.sensitivity(study, store=tmp_path / "store", mirror_terms=0)  # those of the bench
    found = sensitivities(bench_of(study.identity_text()).prepared, NUMPY)
    scale = np.repeat([1e3, 1.0], 3)
    for name, matrix in (("surface", found.all_surfaces), ("segment", found.segments)):
        rms = ds[f"sensitivity_wfe_rms_raw_{name}"]
        assert rms.dims == (name, "dof")
        assert rms[name].values.tolist() == list(matrix.elements)
        np.testing.assert_allclose(rms, matrix.rms_raw * scale * 550, rtol=1e-12)
        for quantity, last, unit in (
            ("zernike", "noll", 550.0),
            ("los", "axis", 1.0),
            ("centroid", "axis", 1.0),
        ):
            values = ds[f"sensitivity_{quantity}_{name}"]
            assert values.dims == (name, "dof", last)
            expected = getattr(matrix, quantity) * scale[:, None] * unit
            np.testing.assert_allclose(values, expected, rtol=0, atol=1e-9 * np.abs(expected).max())
    assert ds.dof.values.tolist() == ["dx", "dy", "dz", "rx", "ry", "rz"]
    assert ds.noll.values.tolist() == list(range(1, 12))
    np.testing.assert_allclose(ds.step_segment, np.full(6, 1e-6))
    assert ds.step_error_segment.max() < 1e-6
    assert ds.attrs["steps_agree"] == 1
    assert all("units" in ds[name].attrs and "long_name" in ds[name].attrs for name in ds.data_vars)


@pytest.mark.parametrize("workflow", ["telescope-exposure", "segment-disturbance"])
def test_other_kinds_of_studies_find_what_they_have_stored(tmp_path, workflow):
    """Their telescope is that of a study of segments, whose identity is another."""
    path = tmp_path / "small.toml"
    path.write_text(STUDY.replace("segment-disturbance", workflow))
    one = wq.load_study(path)
    first, kept = stored_dataset(one, tmp_path / "store", mirror_terms=0)
    again, found = stored_dataset(one, tmp_path / "store", mirror_terms=0)
    assert (kept, found) == (False, True)
    assert first.attrs["study"] == one.identity_text()
    xr.testing.assert_identical(first, again)


def test_what_was_stored_without_m1_as_a_whole_is_computed_again(study, tmp_path, monkeypatch):
    ds, _ = stored_dataset(study, tmp_path)
    assert ds.surface.values.tolist() == ["M1", "M2", "M3", "image"]
    assert ds.attrs["surfaces"] == 4
    write = sensitivities_kept.write_dataset

    def earlier(made, target):
        write(made.dataset().isel(surface=slice(1, None)).assign_attrs(surfaces=3), target)

    monkeypatch.setattr(sensitivities_kept, "write_dataset", earlier)
    stored_sensitivity(study, tmp_path, mirror_terms=0)
    without, kept = stored_dataset(study, tmp_path)
    assert (without.sizes["surface"], kept) == (3, False)
    monkeypatch.undo()
    again, kept = stored_dataset(study, tmp_path)
    assert (again.sizes["surface"], kept) == (4, False)


def test_a_meter_of_piston_figure_is_a_meter_along_the_normal(study, tmp_path):
    ds = wq.sensitivity(study, store=tmp_path / "store", figure_terms=3)
    figure, rigid = ds.sensitivity_wfe_rms_raw_figure, ds.sensitivity_wfe_rms_raw_segment
    assert figure.dims == ("segment", "term")
    assert figure.attrs["units"] == "nm per m"
    np.testing.assert_allclose(figure.sel(term=1), rigid.sel(dof="dz"), rtol=1e-3)


def test_it_is_written_with_its_provenance_and_opens_plainly(study, tmp_path):
    ds, kept = stored_dataset(study, tmp_path / "store")
    assert not kept
    plain = xr.open_zarr(tmp_path / "store" / "sensitivity.zarr")
    xr.testing.assert_equal(plain[list(ds.data_vars)].load(), ds)
    assert plain.attrs["study"] == study.identity_text()
    assert plain.attrs["study_sha256"] == study.identity()
    assert {"wavequake", "git_commit", "packages", "line_of_sight", "device"} <= set(plain.attrs)
    assert [path.name for path in (tmp_path / "store").iterdir()] == ["sensitivity.zarr"]


def test_what_is_there_is_not_computed_again(study, tmp_path, monkeypatch):
    first, _ = stored_dataset(study, tmp_path)
    more, kept = stored_dataset(study, tmp_path, figure_terms=1)
    assert not kept
    assert more.sizes["term"] == 1
    stored_sensitivity(study, tmp_path, figure_terms=0)
    monkeypatch.setattr(module, "sensitivities", None)
    again, kept = stored_dataset(study, tmp_path)
    assert kept
    xr.testing.assert_identical(again.drop_attrs(), first.drop_attrs())


def test_it_lives_beside_a_campaign(study, tmp_path):
    stored_sensitivity(study, tmp_path / "store")
    ds = wq.run(study, store=tmp_path / "store")
    assert (ds.status == 1).all()
    assert stored_sensitivity(study, tmp_path / "store")[1]
    other = study_with(study, {"study.seed": 1})
    with pytest.raises(UserError, match=r"belongs to another study: study\.seed"):
        stored_sensitivity(other, tmp_path / "store")


def test_another_study_is_refused(study, tmp_path):
    stored_sensitivity(study, tmp_path)
    with pytest.raises(UserError, match="another study"):
        stored_sensitivity(study_with(study, {"study.seed": 1}), tmp_path)


def test_a_write_that_fails_leaves_nothing(study, tmp_path, monkeypatch):
    def full(folder):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(arrays, "consolidate", full)
    with pytest.raises(UserError, match="disk"):
        stored_sensitivity(study, tmp_path / "store")
    assert not list((tmp_path / "store").iterdir())


def test_two_processes_may_write_the_same(study, tmp_path, monkeypatch):
    original = arrays.consolidate

    def another_is_faster(folder):
        original(folder)
        shutil.copytree(folder, folder.with_name("sensitivity.zarr"))

    monkeypatch.setattr(arrays, "consolidate", another_is_faster)
    ds, _ = stored_dataset(study, tmp_path / "store")
    assert ds.sizes["segment"] == 18
    assert [path.name for path in (tmp_path / "store").iterdir()] == ["sensitivity.zarr"]


@pytest.mark.parametrize("damage", ["flip", "empty", "delete"])
def test_damage_is_found(study, tmp_path, damage):
    stored_sensitivity(study, tmp_path)
    (file,) = (tmp_path / "sensitivity.zarr" / "sensitivity_los_segment").glob("c*")
    content = bytearray(file.read_bytes())
    content[100] ^= 1
    if damage == "delete":
        file.unlink()
    else:
        file.write_bytes(content if damage == "flip" else b"")
    with pytest.raises(StoreDamageError, match="Delete it"):
        open_sensitivity(tmp_path)


def test_bad_requests_are_refused(study, tmp_path):
    with pytest.raises(UserError, match="figure terms"):
        stored_sensitivity(study, tmp_path, figure_terms=-1)
    with pytest.raises(UserError, match="no sensitivities"):
        open_sensitivity(tmp_path)
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(UserError, match="not a store"):
        stored_sensitivity(study, tmp_path)
