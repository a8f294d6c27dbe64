"""Wind, loads from files and temperatures on bodies, against closed forms and dense sums."""

import re

import numpy as np
import pytest
import scipy.special
from small_bodies import FEET, OPTICS, RIGID, drawn, shaken, study_of

from wavequake.errors import UserError
from wavequake.mechanics.disturbances.sources.body_wind import BodyWind, coherence, drawn_coherent

OWN = np.sqrt(4 * 4e5 / 10.0)  # 10 kg on four springs


def test_a_force_that_steps_swings_a_body_in_as_an_oscillator_does(tmp_path):
    """x = F / k (1 - exp(-z w t) (cos + z / sqrt(1 - z²) sin)), from a CSV and from an .npz."""
    (tmp_path / "push.csv").write_text("time_s, cell.fz_n\n0.01, 2.0\n0.5, 2.0\n")
    np.savez(tmp_path / "push.npz", **{"time_s": [0.01, 0.5], "cell.fz_n": [2.0, 2.0]})
    for name in ("push.csv", "push.npz"):
        study = study_of(tmp_path, OPTICS, RIGID, shaken(f'model = "load-history"\nfile = "{name}"'))
        assert study.cases == 1
        time, motion = drawn(study)
        since, damped = np.maximum(time - 0.01, 0.0), OWN * np.sqrt(1.0 - 0.02**2)
        fade = np.exp(-0.02 * OWN * since)
        swing = np.cos(damped * since) + 0.02 / np.sqrt(1.0 - 0.02**2) * np.sin(damped * since)
        expected = 2.0 / 1.6e6 * (1.0 - fade * swing)
        np.testing.assert_allclose(motion.rigid["cell"][:, 2], expected, rtol=1e-9, atol=1e-17)


def test_a_slow_lift_of_the_floor_lifts_all(tmp_path):
    (tmp_path / "lift.csv").write_text("time_s,ground.dz_um,cell.mx_n_m\n0,0,0\n2000,50,0.3\n")
    keys = 'model = "load-history"\nfile = "lift.csv"\nduration_s = 2000.0\ninstants = 16\nname = "one"'
    time, motion = drawn(study_of(tmp_path, OPTICS, RIGID, f"[[disturbance]]\n{keys}\n"))
    share = time[-1] / 2000.0
    assert motion.rigid["camera"][-1, 2] == pytest.approx(50e-6 * share, rel=1e-6)
    turned = 0.3 * share / (4e5 * 2 * 0.3**2)  # springs along z at y = +-0.3 m
    assert motion.rigid["cell"][-1, 3] == pytest.approx(turned, rel=1e-5)


def test_a_combination_does_not_outlast_the_loads_that_it_holds(tmp_path):
    (tmp_path / "lift.csv").write_text("time_s,ground.dz_um\n0,0\n0.2,5\n")
    keys = 'model = "load-history"\nfile = "lift.csv"\nname = "one"\nduration_s = 0.2'
    shift = 'model = "surface-random"\nof = ["camera"]\nrms = { dz_um = 1.0 }\nname = "two"'
    both = 'model = "combine"\nof = ["one", "two"]\nname = "all"\nduration_s = '
    given = "".join(f"[[disturbance]]\n{text}\n" for text in (keys, shift, both + "0.2"))
    study_of(tmp_path, OPTICS, RIGID, given)
    with pytest.raises(UserError, match=r"'one' end at 0\.2 s, but cases of 'all' last 1 s"):
        study_of(tmp_path, OPTICS, RIGID, given.replace(both + "0.2", both + "1.0"))


WIND = (
    'model = "body-wind"\nareas_m2 = { "cell.a" = 0.2, "cell.b" = 0.3 }\ndirection = [0.0, 0.0, 2.0]\n'
    "mean_speed_m_s = 9.0\nturbulence_intensity = 0.25\nlength_scale_m = 3.0\n"
)


def test_wind_shakes_with_the_variance_of_the_coherent_forces_times_the_response(tmp_path):
    """Summed densely by hand: von Karman gusts, two areas 0.6 m apart, through the resonance at 64 Hz."""
    study = study_of(tmp_path, OPTICS, RIGID, shaken(WIND), campaign__cases=240)
    values = np.array([drawn(study, case)[1].rigid["cell"][:, 2] for case in range(240)])
    f = np.geomspace(1e-3 * 3.0, 3e4, 400_001)
    sigma, turn = 0.25 * 9.0, 3.0 / 9.0
    gusts = 4.0 * sigma**2 * turn / (1.0 + 70.7 * (f * turn) ** 2) ** (5.0 / 6.0)
    first, second = (
        1.2 * 1.2 * 9.0 * area / (1.0 + (2.0 * f * np.sqrt(area) / 9.0) ** (4.0 / 3.0)) for area in (0.2, 0.3)
    )
    both = first**2 + second**2 + 2.0 * first * second * np.exp(-10.0 * f * 0.6 / 9.0)
    omega = 2.0 * np.pi * f
    response = 0.1 / (OWN**2 - omega**2 + 2j * 0.02 * OWN * omega)
    expected = np.trapezoid(gusts * both * np.abs(response) ** 2, f)
    of_cases = np.mean(values**2, axis=1)
    error = of_cases.std(ddof=1) / np.sqrt(len(of_cases))
    assert abs(of_cases.mean() - expected) < 3.0 * error
    assert error < 0.12 * expected


def test_gusts_have_their_coherence_at_every_frequency():
    """What mixes independent amplitudes is a root of the matrix of coherences, also of nodes at one place."""
    wind = BodyWind(name="w", areas_m2={"a": 1.0}, mean_speed_m_s=4.0, coherence_decay=7.0)
    points = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.3, 0.4, 0.0]])
    wanted = coherence(wind, points, np.array([0.1, 3.0]))
    np.testing.assert_allclose(wanted[:, 0, 2], np.exp(-7.0 * np.array([0.1, 3.0]) * 0.5 / 4.0), rtol=1e-12)
    roots = np.stack([drawn_coherent(np.tile(one, (2, 1)), wanted) for one in np.eye(3)], axis=2)
    np.testing.assert_allclose(roots @ roots.swapaxes(1, 2), wanted, atol=1e-12)
    np.testing.assert_allclose(roots[:, 0], roots[:, 1], atol=1e-7)


TABLE = "temperature_c,cell.dz_um,M1.z4_nm\n-10,-30,5\n10,10,5\n30,30,25\n"


def of_temperature(keys):
    return shaken(f'model = "temperature-table"\nfile = "hot.csv"\naligned_c = 0.0\n{keys}')


def test_temperature_moves_and_bends_by_its_table(tmp_path):
    (tmp_path / "hot.csv").write_text(TABLE)
    study = study_of(tmp_path, OPTICS, RIGID + FEET[:0], of_temperature("temperature_c = [-10.0, 20.0]"))
    _, motion = drawn(study)
    at = np.linspace(-10.0, 20.0, 16)
    lift = np.where(at < 10.0, 2.0 * at, at + 10.0)  # um, less that at 0, which is -10
    np.testing.assert_allclose(motion.rigid["cell"][:, 2], 1e-6 * lift, atol=1e-17)
    np.testing.assert_allclose(motion.figure["M1"][:, 3], 1e-9 * np.maximum(at - 10.0, 0.0), atol=1e-18)


def test_every_case_has_a_temperature_of_its_own(tmp_path):
    (tmp_path / "hot.csv").write_text(TABLE)
    keys = "temperature_c = [20.0, 20.0]\nspread_c = 5.0"
    study = study_of(tmp_path, OPTICS, RIGID, of_temperature(keys), campaign__cases=300)
    lifts = np.array([drawn(study, case)[1].rigid["cell"][:, 2] for case in range(300)])
    assert (lifts == lifts[:, :1]).all()
    offsets = np.sort(lifts[:, 0] * 1e6 - 30.0)
    assert offsets[0] >= -5.0
    assert offsets[-1] <= 5.0
    apart = np.abs((offsets + 5.0) / 10.0 - (np.arange(300) + 0.5) / 300).max()
    assert scipy.special.kolmogorov(apart * np.sqrt(300)) > 1e-3


@pytest.mark.parametrize(
    ("table", "keys", "words"),
    [
        (TABLE, of_temperature("temperature_c = [0.0, 40.0]"), "goes from -10 to 30 degrees Celsius, but 40"),
        ("time_s,M1.z4_nm\n1,2\n", of_temperature("temperature_c = [0.0, 1.0]"), "temperature_c, then"),
        (
            "temperature_c,M1.z4_nm\n2,2\n1,2\n",
            of_temperature("temperature_c = [1, 2]"),
            "sort the rows by temp",
        ),
        ("time_s,cell.fz_um\n0,1\n1,2\n", shaken('model = "load-history"\nfile = "hot.csv"'), "is no load"),
        (
            "time_s,cell.fz_n\n0,1\n0.1,2\n",
            shaken('model = "load-history"\nfile = "hot.csv"'),
            "end at 0.1 s",
        ),
        (
            "time_s,no.fz_n\n0,1\n1,2\n",
            shaken('model = "load-history"\nfile = "hot.csv"'),
            "'no', which is no node",
        ),
        ("", shaken(WIND.replace("cell.b", "cell.z")), "'cell.z', which is no node"),
    ],
)
def test_bad_loads_are_said(tmp_path, table, keys, words):
    (tmp_path / "hot.csv").write_text(table)
    with pytest.raises(UserError, match=re.escape(words)):
        drawn(study_of(tmp_path, OPTICS, RIGID, keys))
