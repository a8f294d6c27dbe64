"""A disturbed case as a lens file, traced anew, against what the store holds of it."""

from dataclasses import replace

import numpy as np
import pytest

import wavequake as wq
from wavequake.campaign.store.store import read_manifest
from wavequake.errors import UserError
from wavequake.kernels.trace.sequential_numpy import trace_sequence_numpy
from wavequake.kernels.trace.status import OK
from wavequake.optics.rays.aiming import pupil_rays
from wavequake.optics.rays.packing import bundle_rotation, moving, pack
from wavequake.optics.rays.pupils import sunflower
from wavequake.optics.systems.kinematics import at_instant, rest_states
from wavequake.report.exports.displacements import displacements, export_displacements
from wavequake.report.exports.lens_file import export_case
from wavequake.workflows.systems.bench import system_bench, system_states
from wavequake.workflows.systems.disturbance import draw

STUDY = """
[study]
name = "shaken"
workflow = "system-disturbance"

[system]
name = "custom"
entrance_diameter_mm = 10.0
fields_deg = [[0.0, 0.0], [0.0, 2.0]]
wavelengths_nm = [550.0]

[[system.surface]]
name = "front"
radius_mm = 60.0
glass = "HOYA:BAF2"
deformation_terms = 15
semi_diameter_mm = 8.0

[[system.surface]]
name = "back"
distance_mm = 5.0
radius_mm = -50.0
glass = "air"

[[system.surface]]
name = "stop"
distance_mm = 2.0
stop = true

[[system.surface]]
name = "image"
distance_mm = 44.0

[[body]]
name = "lens"
surfaces = ["front", "back"]

[[disturbance]]
name = "assembly"
model = "surface-random"
of = ["lens", "image"]
rms = { dx_um = 8.0, dz_um = 5.0, ry_urad = 90.0 }
share = 0

[[disturbance]]
name = "polishing"
model = "surface-deformation"
of = ["front"]
rms_nm = { 5 = 200.0, 8 = 100.0 }
share = 0

[[disturbance]]
name = "shake"
model = "surface-vibration"
of = ["stop", "lens"]
instants = 4
lines = [{ frequency_hz = 85.0, amplitude = { dy_um = 3.0, dx_um = 2.0 } }]
share = 0

[[disturbance]]
name = "sky"
model = "line-of-sight"
rms_mas = 5000.0
share = 0

[[disturbance]]
name = "all"
model = "combine"
of = ["assembly", "polishing", "shake", "sky"]
"""


ASPHERE = 'name = "front"\nconic = -0.6\neven_asphere = [1e-5, 3e-6, -2e-8, 1e-10]\n'


@pytest.mark.parametrize(
    "front",
    ['name = "front"\n', ASPHERE, ASPHERE + "zernike_obscuration = 0.2\n"],
    ids=["conic", "asphere", "annular asphere"],
)
def test_a_case_as_a_lens_file_has_the_surfaces_and_light_of_the_case(tmp_path, front):
    """The same rays through the file's system at rest and through the study's as it moves and deforms."""
    (tmp_path / "study.toml").write_text(STUDY.replace('name = "front"\n', front))
    store = tmp_path / "store"
    wq.run(tmp_path / "study.toml", store=store, cases=3, optics__rays=200, wavefront__zernike_terms=28)
    bench = system_bench(read_manifest(store).study)
    wavelength = float(bench.system.wavelengths[0])
    rays = sunflower(0.0, 1.0, 50)
    for case, instant in ((0, 0), (2, 3)):
        (path,) = export_case(store, tmp_path / "case.zmx", case, instant, overwrite=True)
        again = wq.load_system(path)
        assert again.surfaces[0].medium == bench.system.surfaces[0].medium
        states = at_instant(system_states(bench, draw(bench, case)[1]), instant)
        assert states.line_of_sight.any()
        for field in range(2):
            light = pupil_rays(again, again.fields[field], wavelength, rays.x, rays.y)
            theirs = traced(again, wavelength, light, rest_states(again))
            # The file begins at its first surface, the study's system where that stood at rest.
            first = np.array([[0.0], [0.0], [states.surface_motion[0, 0, 2]]])
            still = replace(states, line_of_sight=np.zeros((1, 2)))
            light = replace(light, position=light.position + first)
            ours = traced(bench.system, wavelength, light, still)
            for one, other in zip(ours, theirs, strict=True):
                np.testing.assert_allclose(one, other, rtol=0, atol=1e-12)
            turn, _ = bundle_rotation(bench.system, states.line_of_sight)
            toward = turn[0] @ [*np.tan(bench.system.fields[field]), 1.0]
            np.testing.assert_allclose(
                light.direction[:, 0], toward / np.linalg.norm(toward), rtol=0, atol=1e-14
            )
    with pytest.raises(UserError, match="exists already"):
        export_case(store, tmp_path / "case.zmx", 0)
    with pytest.raises(UserError, match="cases 0 to 2"):
        export_case(store, tmp_path / "new.zmx", 99)
    with pytest.raises(UserError, match="no instant 99"):
        export_case(store, tmp_path / "new.zmx", 0, instant=99)


def traced(system, wavelength, light, states):
    found = trace_sequence_numpy(pack(system, wavelength), light, moving(system, states), True)
    assert (found.status == OK).all()
    return found.x, found.y, found.path


def test_the_displacements_of_a_case_are_read_back_as_its_motion_and_figure(tmp_path):
    """By the fit to nodes, which knows nothing of how they were made."""
    (tmp_path / "study.toml").write_text(STUDY)
    store = tmp_path / "store"
    wq.run(tmp_path / "study.toml", store=store, cases=1, optics__rays=200, wavefront__zernike_terms=28)
    bench = system_bench(read_manifest(store).study)
    case = system_states(bench, draw(bench, 0)[1])
    written = export_displacements(store, tmp_path / "case.txt", 0, 3)
    files = {path.name: path for path in tmp_path.glob("case-*.txt")}
    assert set(files) == {"case-1-front.txt", "case-2-back.txt", "case-3-stop.txt", "case-4-image.txt"}
    assert set(written) == {path.resolve() for path in files.values()}
    head = STUDY.partition("[[disturbance]]")[0]
    for index, name in enumerate(("front", "back")):
        keys = f'surface = "{name}"\nfile = "case-{index + 1}-{name}.txt"\nunit = "mm"\nterms = 15\n'
        text = f'{head}[[disturbance]]\nname = "nodes"\nmodel = "nodal-displacements"\n{keys}'
        (tmp_path / "again.toml").write_text(text)
        again = system_bench(wq.load_study(tmp_path / "again.toml").identity_text())
        states = system_states(again, draw(again, 0)[1])
        found, expected = states.surface_motion[0, index], case.surface_motion[3, index]
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-11)
        if name == "front":
            figure = case.deformations[index][3][:15]
            assert np.abs(figure).max() > 1e-5
            np.testing.assert_allclose(states.deformations[index][0][3:15], figure[3:], rtol=0, atol=1e-11)
    with pytest.raises(UserError, match="exists already"):
        export_displacements(store, tmp_path / "case.txt", 0, 3)
    with pytest.raises(UserError, match="no instant 9999"):
        export_displacements(store, tmp_path / "new.txt", 0, 9999)


def test_displacements_are_of_points_on_the_surface_that_turn_about_its_vertex():
    system = wq.load_system("double-gauss")
    states = rest_states(system, 1)
    assert not list(displacements(system, states, 0))
    states.surface_motion[0, 2] = [0.0, 0.0, 0.0, 0.0, 0.0, 0.1]  # about its own axis
    ((index, table),) = displacements(system, states, 0)
    x, y, z, dx, dy, dz = table.T
    assert index == 2
    np.testing.assert_allclose(z, system.surfaces[2].shape.sag(x, y)[0], atol=1e-12)
    np.testing.assert_allclose(x + dx, x * np.cos(0.1) - y * np.sin(0.1), atol=1e-12)
    np.testing.assert_allclose(y + dy, x * np.sin(0.1) + y * np.cos(0.1), atol=1e-12)
    np.testing.assert_allclose(dz, 0.0, atol=1e-12)
