"""Structures that are not known exactly, against closed forms of an oscillator and models built anew."""

from dataclasses import replace

import numpy as np
import pytest
from small_bodies import FEET, OPTICS, RIGID, WELD, Z_FORCE, floor, shaken, study_of

import wavequake as wq
from wavequake.campaign.statistics.parted import parted
from wavequake.errors import UserError
from wavequake.mechanics.assembly.answers import Shaking, steady
from wavequake.mechanics.assembly.plant import FLOOR
from wavequake.mechanics.assembly.uncertain import Measured, Spread, corrected, drawn
from wavequake.workflows.bodies.uncertain import uncertain_plant
from wavequake.workflows.systems.bench import system_bench
from wavequake.workflows.systems.disturbance import KIND, draw

OWN_HZ = np.sqrt(4 * 4e5 / 10.0) / (2.0 * np.pi)  # 63.7, along z, of 10 kg on springs; damping 2 %
NOISE = shaken('model = "body-force"\nat = ["cell"]\nspectrum = { rms = 0.5, low_hz = 5.0, high_hz = 800.0 }')


def uncertain(keys):
    return f"[structure.uncertain]\n{keys}\n"


def plant_of(folder, *parts):
    return system_bench(study_of(folder, OPTICS, *parts).identity_text()).plants["full"]


def moved_by_floor_and_force(plant, hz):
    """Return the amplitudes of all outputs under unit floor motion along z, and a unit force on the cell."""
    patterns = np.zeros((2, plant.modal.inputs.shape[1]), dtype=complex)
    patterns[0, FLOOR.start + 2] = 1.0
    patterns[1, plant.places["cell"][0].start + 2] = 1.0
    return steady(plant, Shaking(np.full(2, 2.0 * np.pi * hz), patterns))


def test_all_modes_corrected_alike_are_a_structure_of_stiffer_springs(tmp_path):
    plant = plant_of(tmp_path, RIGID, Z_FORCE)
    stiffer = FEET.replace("[2e5, 3e5, 4e5]", "[2.42e5, 3.63e5, 4.84e5]")  # 1.1 squared
    built = plant_of(tmp_path, RIGID.replace(FEET, stiffer).replace("0.02", "0.03"), Z_FORCE)
    every = [
        Measured(k + 1, 1.1 * omega / (2.0 * np.pi), 0.03) for k, omega in enumerate(plant.omega.tolist())
    ]
    for hz in (0.01, 20.0, 70.0, 300.0):
        mine, theirs = (
            moved_by_floor_and_force(corrected(plant, every), hz),
            moved_by_floor_and_force(built, hz),
        )
        np.testing.assert_allclose(mine, theirs, rtol=1e-9, atol=1e-12 * np.abs(theirs).max())


def test_what_is_drawn_keeps_masses_and_follows_a_slow_floor(tmp_path):
    plant = plant_of(tmp_path, RIGID, Z_FORCE)
    one = drawn(plant, Spread(0.1, 0.3, 0.2), (), np.random.default_rng(0))
    assert not np.allclose(one.shapes, plant.shapes)
    forces = ~plant.modal.prescribed
    mobility = [made.modal.inputs[:, forces].T @ made.modal.inputs[:, forces] for made in (one, plant)]
    np.testing.assert_allclose(*mobility, atol=1e-12)  # of the modal masses: that of the bodies
    np.testing.assert_allclose(one.shapes @ one.shapes.T, plant.shapes @ plant.shapes.T, atol=1e-12)
    slow = [moved_by_floor_and_force(made, 1e-4)[0] for made in (one, plant)]
    np.testing.assert_allclose(*slow, atol=1e-9)  # all moves as the floor does
    # What a force there moves here, the same force here moves there: no model without it is one.
    place = one.places["cell"][0]
    patterns = np.zeros((3, one.modal.inputs.shape[1]), dtype=complex)
    patterns[:, place] = np.eye(3)
    rigid = one.outputs["rigid", "cell"]
    found = steady(one, Shaking(np.full(3, 300.0), patterns))[:, rigid][:, :3]
    np.testing.assert_allclose(found, found.T, atol=1e-15)
    assert np.abs(found - np.diag(np.diag(found))).max() > 1e-3 * np.abs(found).max()


def test_frequencies_and_damping_are_log_normal_and_their_response_the_closed_form(tmp_path):
    plant = plant_of(tmp_path, RIGID, Z_FORCE)
    made = [drawn(plant, Spread(0.05, 0.2), (), np.random.default_rng(k)) for k in range(3000)]
    off = np.array([np.log(one.omega / plant.omega) for one in made])
    ratios = np.array([0.5 * np.diag(one.modal.damping) / one.omega for one in made])
    np.testing.assert_allclose(off.std(axis=0), 0.05, rtol=0.06)
    np.testing.assert_allclose(off.mean(axis=0), 0.0, atol=0.004)
    np.testing.assert_allclose(np.log(ratios / 0.02).std(axis=0), 0.2, rtol=0.06)
    assert np.abs(np.corrcoef(off.T)[0, 1:]).max() < 0.07
    one, vertical = made[0], int(np.argmax(np.abs(plant.modal.inputs[:, plant.places["cell"][0].start + 2])))
    own, damping, omega = one.omega[vertical], ratios[0, vertical], 2.0 * np.pi * 50.0
    expected = 0.1 / (own**2 - omega**2 + 2j * damping * own * omega)
    row = one.outputs["rigid", "cell"].start + 2
    assert moved_by_floor_and_force(one, 50.0)[1, row] == pytest.approx(expected, rel=1e-9)
    np.testing.assert_allclose(one.resonances, [one.omega, ratios[0]], rtol=1e-12)


def test_measured_modes_have_their_own_errors_and_shapes(tmp_path):
    plant = plant_of(tmp_path, RIGID, Z_FORCE)
    known = Measured(2, 50.0, 0.01, frequency_error=1e-3, damping_error=0.0)
    fixed = corrected(plant, [known])
    assert fixed.omega[1] == pytest.approx(2.0 * np.pi * 50.0)
    made = [drawn(fixed, Spread(0.1, 0.3, 0.2), [known], np.random.default_rng(k)) for k in range(400)]
    second = np.log([one.omega[1] for one in made]) - np.log(2.0 * np.pi * 50.0)
    assert second.std() == pytest.approx(1e-3, rel=0.1)
    assert all(0.5 * one.modal.damping[1, 1] / one.omega[1] == pytest.approx(0.01) for one in made)
    np.testing.assert_allclose(made[0].shapes[:, 1], plant.shapes[:, 1])
    with pytest.raises(UserError, match="There is no mode 99; the structure has"):
        corrected(plant, [replace(known, number=99)])


def test_the_variance_is_parted_as_in_the_closed_form_of_an_oscillator():
    """Displacement x of an oscillator under white noise: its variance v = c / (D w^3) is log-normal.

    Of x^2 the excitation makes 2 E v^2 and the model Var v. Intervals hold in 95 of 100, and so on.
    """
    spread, damping, held = 0.2, 0.5, 0
    size = 9.0 * spread**2 + damping**2
    excitation = 2.0 * np.exp(2.0 * size)
    model = np.exp(2.0 * size) - np.exp(size)
    for seed in range(100):
        random = np.random.default_rng(seed)
        logs = random.standard_normal((400, 2)) @ [-3.0 * spread, -damping]
        # Mean squares of 16 independent instants: the excitation is a sixteenth.
        squares = np.exp(logs)[:, None] * random.chisquare(16, (400, 2)) / 16.0
        found = parted(squares.ravel(), np.repeat(np.arange(400), 2))
        share = model / (model + excitation / 16.0)
        held += found.low <= share <= found.high
    assert 85 <= held <= 99, held
    random = np.random.default_rng(1)
    logs = random.standard_normal((200_000, 2)) @ [-0.3, -0.2]  # milder, for sharp moments
    values = np.exp(logs)[:, None] * random.standard_normal((200_000, 2)) ** 2
    found, size = parted(values.ravel(), np.repeat(np.arange(200_000), 2)), 0.13
    assert found.excitation == pytest.approx(2.0 * np.exp(2.0 * size), rel=0.03)
    assert found.model == pytest.approx(np.exp(2.0 * size) - np.exp(size), rel=0.1)
    assert parted(np.ones(8), np.repeat(np.arange(4), 2)) is None


def test_cases_share_models_by_twos_and_models_do_not_touch_the_draws(tmp_path):
    study = study_of(tmp_path, OPTICS, RIGID, uncertain("frequency = 0.05"), NOISE, campaign__cases=6)
    bench = system_bench(study.identity_text())
    of = bench.plants, bench.study.structure, bench.study.study.seed
    omegas = [uncertain_plant(*of, realization, "full").omega for realization in range(4)]
    np.testing.assert_array_equal(omegas[0], omegas[1])
    assert not np.allclose(omegas[0], omegas[2])
    table = KIND.case_table(study.identity_text(), 0, 6)
    assert table["replicate"].tolist() == [0, 0, 1, 1, 2, 2]
    together = KIND.compute(study.identity_text(), np.arange(6), "numpy").arrays["zernike"]
    alone = KIND.compute(study.identity_text(), np.array([3]), "numpy").arrays["zernike"]
    np.testing.assert_array_equal(together[3], alone[0])
    # Nothing unknown: the same bits as without the section.
    known = study_of(tmp_path, OPTICS, RIGID, uncertain("frequency = 0.0"), NOISE)
    plain = study_of(tmp_path, OPTICS, RIGID, NOISE)
    motions = [draw(system_bench(one.identity_text()), 1)[1].rigid["cell"] for one in (known, plain)]
    np.testing.assert_array_equal(*motions)


def test_probabilities_hold_what_is_not_known(tmp_path):
    """A sinusoid above the resonance: with other frequencies its response is drawn from the closed form."""
    keys = floor("dz_um = 5.0", 72.0)
    study = study_of(tmp_path, OPTICS, RIGID, uncertain("frequency = 0.04\nrepeats = 1"), keys)
    assert "replicate" not in KIND.case_table(study.identity_text(), 0, 2)
    bench = system_bench(study.identity_text())
    sizes = np.array([np.sqrt(2.0) * draw(bench, case)[1].rigid["cell"][:, 2].std() for case in range(400)])
    random = np.random.default_rng(0)
    own, omega = 2.0 * np.pi * OWN_HZ * np.exp(0.04 * random.standard_normal(100_000)), 2.0 * np.pi * 72.0
    drag = own**2 + 2j * 0.02 * own * omega
    expected = 5e-6 * np.abs(drag / (drag - omega**2))
    for level in (0.25, 0.5, 0.75, 0.95):
        limit = np.quantile(expected, level)
        share = np.mean(sizes <= limit * (1.0 + 0.02))
        assert abs(share - level) < 3.5 * np.sqrt(level * (1.0 - level) / 400) + 0.02, level


def test_reports_part_the_variance(tmp_path):
    keys = uncertain("frequency = 0.1\ndamping = 0.5")
    study = study_of(tmp_path, OPTICS, RIGID, keys, NOISE, campaign__cases=40, campaign__device="numpy")
    wq.run(study, store=tmp_path / "s")
    page = wq.report(tmp_path / "s").read_text()
    assert "What is not known of the structure makes up at most" in page
    assert "Variance between cases: excitation and model" in page


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('[structure.uncertain]\nfrequency = 0.1\n[campaign]\nsampling = "sobol"', "are no independent sets"),
        ("[structure.uncertain]\nfrequency = -1.0", "frequency"),
        ("[[structure.mode]]\nnumber = 1\nfrequency_hz = 5.0\ndamping_ratio = 1.5", "damping_ratio"),
        (
            2 * "[[structure.mode]]\nnumber = 1\nfrequency_hz = 5.0\ndamping_ratio = 0.01\n",
            "mode 1 is given twice",
        ),
    ],
)
def test_wrong_keys_are_a_sentence(tmp_path, text, said):
    with pytest.raises(UserError, match=said):
        study_of(tmp_path, OPTICS.replace("[campaign]\ncases = 4\n", ""), RIGID, NOISE, text)


def test_more_modes_than_there_are_is_a_sentence(tmp_path):
    text = "[[structure.mode]]\nnumber = 1000\nfrequency_hz = 5.0\ndamping_ratio = 0.01\n"
    study = study_of(tmp_path, OPTICS, RIGID, NOISE, text)
    with pytest.raises(UserError, match="There is no mode 1000"):
        system_bench(study.identity_text())


def test_the_section_is_part_of_the_identity_only_where_it_is_given(tmp_path):
    plain = study_of(tmp_path, OPTICS, RIGID, NOISE).identity_text()
    assert "uncertain" not in plain
    assert '"mode"' not in plain
    assert WELD in RIGID
