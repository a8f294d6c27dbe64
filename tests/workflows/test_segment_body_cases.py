"""Cases of studies whose segments and mirrors stand on bodies: reduced, uncertain, imaged, refused."""

from dataclasses import replace

import numpy as np
import pytest
from small_bodies import floor, shaken
from small_carried import CELL, M2_ELASTIC, SPIDER, STUDY, TOP, numbers, text_of

from wavequake.errors import UserError
from wavequake.workflows.bodies.uncertain import uncertain_plant
from wavequake.workflows.segments.bench import bench_of
from wavequake.workflows.segments.disturbance import KIND, draw, trace_draws

VARIANTS = '[reduction]\nvariants = ["guyan", "craigb15", "craigb36"]\n'


def test_reduced_models_of_m2_are_judged_beside_the_full_one(tmp_path):
    """More modes, less error; all draws alike; the full one has none."""
    how = shaken('model = "base-motion"\nspectrum = { rms = 1e-4, low_hz = 5.0, high_hz = 200.0 }')
    text = text_of(tmp_path, STUDY, M2_ELASTIC, VARIANTS, how, campaign__cases=8)
    table = KIND.case_table(text, 0, 8)
    assert table["reduction"].tolist() == ["full", "guyan", "craigb15", "craigb36"] * 2
    found = KIND.compute(text, np.arange(8), "numpy").arrays
    errors = np.sqrt((found["model_error"].reshape(2, 4) ** 2).mean(axis=0))
    assert errors[0] == 0.0
    assert errors[1] > errors[2] > errors[3] > 0.0
    assert errors[3] < 0.05
    one = numbers(text_of(tmp_path, STUDY, M2_ELASTIC.replace("rings", 'reduced = "craigb36"\nrings'), how))
    # What is taken alone is what is compared but for the resonances about which it is shaken.
    assert np.sqrt((one["los"][0] ** 2).mean()) == pytest.approx(
        np.sqrt((found["los"][3] ** 2).mean()), rel=0.5
    )


def test_segments_and_bodies_are_reduced_apart(tmp_path):
    """`of` chooses; elastic segments stand on their own cell beside an elastic M2."""
    segment = "[segment]\nthickness_m = 0.5\nspring_n_m = [5e8, 5e8, 5e8]\ndivisions = 3\nfigure_terms = 11\n"
    line = "lines = [{ frequency_hz = 31.0, amplitude = { dz_um = 0.05 } }]"
    how = shaken(f'model = "segment-shaking"\n{line}', 4) + floor("dz_um = 0.05", 31.0).replace(
        '"one"', '"two"'
    )
    parts = STUDY.replace("rays_per_segment = 6", "rays_per_segment = 36"), segment, M2_ELASTIC, how
    of = {"campaign__cases": 4}
    names = {"segment": ("segment", "one"), "secondary": ("secondary", "two")}
    for name, (pattern, moved) in names.items():
        text = text_of(tmp_path, *parts, f'[reduction]\nvariants = ["guyan"]\nof = ["{pattern}"]\n', **of)
        bench = bench_of(text)
        assert (len(bench.plants), len(bench.bodies.plants)) == ((2, 1) if name == "segment" else (1, 2))
        found = KIND.compute(text, np.arange(4), "numpy").arrays["model_error"]
        table = KIND.case_table(text, 0, 4)
        off = (table["reduction"] == "guyan") & (table["disturbance"] == moved)
        assert (found[off] > 0.0).all()
        assert (found[~off] == 0.0).all()


def test_cases_share_models_of_bodies_that_are_not_known(tmp_path):
    uncertain = "[structure.uncertain]\nfrequency = 0.05\nshapes = 0.1\n"
    bench = bench_of(text_of(tmp_path, STUDY, TOP, SPIDER, uncertain, floor("dx_um = 0.5", 15.0)))
    found = [draw(bench, case).motion.rigid["M2"] for case in range(4)]
    omegas = [
        uncertain_plant(bench.bodies.plants, bench.study.structure, 3, k, "full").omega for k in range(4)
    ]
    np.testing.assert_array_equal(omegas[0], omegas[1])
    assert not np.allclose(omegas[0], omegas[2])
    assert np.abs(found[2]).max() != np.abs(found[0]).max()


def test_a_body_is_moved_by_name_as_what_it_carries(tmp_path):
    """Vibration of a body is that of both its mirrors, M3 at the end of an arm; it needs no mass."""
    pair = '[[body]]\nname = "pair"\nsurfaces = ["M2", "M3"]\nabout_mm = [0.0, 0.0, -27093.75]\n'
    how = shaken('model = "surface-random"\nof = ["pair"]\nrms = { rx_urad = 1.0, dx_um = 1.0 }')
    motion = draw(bench_of(text_of(tmp_path, STUDY, pair, how)), 0).motion
    m2, m3 = motion.rigid["M2"], motion.rigid["M3"]
    arm = bench_of(text_of(tmp_path, STUDY, pair, how)).system.after_primary[1].position[2] * 1e-3 + 27.09375
    rotation = bench_of(text_of(tmp_path, STUDY, pair, how)).system.after_primary[1].rotation
    shift = np.column_stack([m2[:, 0], -arm * m2[:, 3], 0 * arm * m2[:, 3]])
    np.testing.assert_allclose(m3[:, :3] @ rotation.T, shift, atol=1e-18)
    np.testing.assert_allclose(m3[:, 3:] @ rotation.T, m2[:, 3:], atol=1e-18)
    assert np.abs(m2[:, 3]).max() > 0


def test_few_instants_of_a_shaken_body_leave_the_streak_of_many(tmp_path):
    """M1's cell tilts by some lambda/D: 6 instants are followed between each other, 240 hardly need it."""
    images = STUDY.replace("enabled = false", "pixels = 48").replace(
        "rays_per_segment = 6", "rays_per_segment = 18"
    )
    found, texts, cases = {}, {}, {}
    for instants in (6, 240):
        line = "lines = [{ frequency_hz = 5.0, amplitude = { rx_urad = 0.02, ry_urad = 0.01 } }]"
        how = shaken(f'model = "base-motion"\n{line}', instants)
        text = texts[instants] = text_of(tmp_path, images, CELL, how)
        found[instants] = numbers(text)
        drawn = cases[instants] = draw(bench_of(text), 0)
        sight = np.deg2rad(found[instants]["los"][0] / 3.6e6)
        assert np.abs(sight).max() > 3e-8
        np.testing.assert_allclose(drawn.way[:, 0], sight, atol=1e-5 * np.abs(sight).max())
    few, many = found[6]["exposure"][0], found[240]["exposure"][0]
    assert many.max() < 0.5
    assert np.abs(few - many).max() < 0.01 * many.max()
    alone = replace(cases[6], way=None)
    dots = trace_draws(texts[6], [alone], "numpy").arrays["exposure"][0]
    assert np.abs(dots - many).max() > 0.05 * many.max()


def test_a_case_has_the_bits_alone_that_it_has_among_others(tmp_path):
    """With models and draws of its own, images and their streaks."""
    images = STUDY.replace("enabled = false", "pixels = 16").replace("segment = 6", "segment = 18")
    noise = shaken('model = "base-motion"\nspectrum = { rms = 1e-4, low_hz = 5.0, high_hz = 60.0 }', 5)
    uncertain = "[structure.uncertain]\nfrequency = 0.05\nshapes = 0.1\n"
    text = text_of(tmp_path, images, CELL, TOP, SPIDER, uncertain, noise, campaign__cases=4)
    together = KIND.compute(text, np.arange(4), "numpy").arrays
    alone = KIND.compute(text, np.array([2]), "numpy").arrays
    assert np.abs(together["exposure"][2] - together["exposure"][0]).max() > 1e-3
    for name, values in alone.items():
        np.testing.assert_array_equal(together[name][2], values[0], err_msg=name)


FLOOR = floor("dx_um = 1.0")
PUMP = shaken('model = "body-force"\nat = ["top.a"]\nlines = [{ frequency_hz = 9.0, force_n = 1.0 }]')
FEET = CELL[CELL.index("[[link]]") :]
BENT = CELL[: CELL.index("[body.rigid]")] + "[body.mirror]\nthickness_m = 0.5\nrings = 3\n" + FEET
FRAME = """
[[body]]
name = "cell"
[body.beams]
diameter_mm = 300.0
wall_mm = 20.0
nodes_mm = { a = [0.0, 0.0, 0.0], c = [500.0, 0.0, 0.0], d = [900.0, 0.0, 0.0] }
members = [["a", "c"], ["c", "d"]]
carries = { "A?" = "b" }
"""


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            'surfaces = ["M1"]',
            'surfaces = ["Q*"]',
            "The body 'cell' carries 'Q*', but the telescope tmt-18 has",
        ),
        ('surfaces = ["M1"]', 'surfaces = ["M22"]', "has no such segment or surface; did you mean 'M2'?"),
        ('surfaces = ["M2"]', 'surfaces = ["M2", "1?"]', "'10' is carried by the body 'cell' and by 'top'"),
        (
            'name = "top"\nsurfaces',
            'name = "M3"\nsurfaces',
            "The body 'M3' is called as a part of the telescope",
        ),
        ('"top.d", "ground"', '"top.e", "ground"', "the link 'spider' leads to the node 'e' of 'top'"),
        ('"top.d", "ground"', '"tip.d", "ground"', "leads to 'tip', which is no body; did you mean 'top'?"),
        (FLOOR, PUMP.replace("top.a", "top.q"), "'one' acts at 'top.q', which is no node; there are"),
        (FEET, "", "the body 'cell' of the structure of carried has no support, while others stand on"),
        (CELL, BENT, "The body 'cell' would bend M1 behind its segments; carry them by nodes of beams,"),
        (CELL, FRAME, "The body 'cell' carries 'A?', but the telescope tmt-18 has no such segment"),
        (
            CELL,
            FRAME.replace("A?", "[1-3]"),
            "carries parts at 'b', which is no node of it; choose among a, c, d",
        ),
        (
            CELL,
            FRAME.replace("A?", "3").replace('"b"', '["a", "c", "d"]'),
            "at nodes on one line; name three",
        ),
        (CELL + TOP, "", "the section link is of bodies with mass, but there are none; give a [[body]]"),
        ("[[disturbance]]", VARIANTS + "[[disturbance]]", "reduction compares models of elastic segments"),
        ("surfaces", "carries", "body.cell.carries"),
    ],
)
def test_bodies_that_cannot_be_are_said_in_a_sentence(old, new, words, tmp_path):
    parts = "".join((STUDY, CELL, TOP, SPIDER, FLOOR))
    assert old in parts
    with pytest.raises(UserError) as caught:
        KIND.check(text_of(tmp_path, parts.replace(old, new, 1)))
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
