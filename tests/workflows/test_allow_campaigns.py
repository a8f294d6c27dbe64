"""Allowances as a user would check them: ordinary campaigns of a study that has the sizes of the file.

No line of what allows takes part: every element gets a disturbance of its own with the rms of its rows, their
sum is run, and cases beyond the limit are counted.
"""

import csv
from collections import defaultdict

import numpy as np
import pytest
from scipy.stats import binom

import wavequake as wq
from wavequake.report.answers.allow import write_allowances
from wavequake.workflows.allow import allowances
from wavequake.workflows.study import load_study

CASES, PROBABILITY, COMMON = 800, 0.1, 0.4

LENS = """
[study]
name = "lens"
workflow = "system-disturbance"
[system]
name = "double-gauss"
f_number = 8.0
fields_deg = [[0.0, 0.0], [0.0, 5.0]]
wavelengths_nm = [587.6]
[optics]
rays = 60
[wavefront]
zernike_terms = 15
[[body]]
name = "L1"
surfaces = ["surface 1", "surface 2"]
[[body]]
name = "L4"
surfaces = ["surface 10", "surface 11"]
"""
LENS_MOVES = """
[[disturbance]]
name = "asked"
model = "surface-random"
of = ["L1", "surface 7", "L4"]
rms = { dx_um = 1.0, dy_um = 1.0, dz_um = 1.0, rx_urad = 1.0, ry_urad = 1.0 }
"""
EUV = """
[study]
name = "mirrors"
workflow = "system-disturbance"
[system]
name = "euv"
fields_mm = [[0.0, 117.0], [0.0, 123.0]]
[optics]
rays = 60
[wavefront]
zernike_terms = 15
"""
EUV_MOVES = """
[[disturbance]]
name = "moved"
model = "surface-random"
of = ["M*"]
rms = { dx_um = 1.0, dy_um = 1.0, dz_um = 1.0, rx_urad = 1.0, ry_urad = 1.0 }
share = 0
[[disturbance]]
name = "bent"
model = "surface-deformation"
of = ["M*"]
rms_nm = { 5 = 1.0, 7 = 1.0, 11 = 1.0 }
share = 0
[[disturbance]]
name = "asked"
model = "combine"
of = ["moved", "bent"]
"""
TELESCOPE = """
[study]
name = "telescope"
workflow = "segment-disturbance"
[telescope]
name = "tmt-18"
gap_mm = 20.0
[optics]
rays_per_segment = 6
[wavefront]
zernike_terms = 21
[imaging]
enabled = false
"""
TELESCOPE_MOVES = """
[[disturbance]]
name = "asked"
model = "static-random"
piston_nm = 1.0
tip_nrad = 1.0
tilt_nrad = 1.0
"""


def written(rows):
    """Return disturbances (TOML) that move every element by what its rows allow, and their sum."""
    elements = defaultdict(dict)
    for row in rows:
        elements[row["element"]][row["axis"]] = float(row["rms"])
    text, names = "", []
    for number, (element, sizes) in enumerate(elements.items()):
        rigid = {axis: rms for axis, rms in sizes.items() if not axis.startswith("figure")}
        bent = {axis.split()[1]: 1e9 * rms for axis, rms in sizes.items() if axis.startswith("figure")}
        keys = {f"{axis}_um" if axis[0] == "d" else f"{axis}_urad": 1e6 * rms for axis, rms in rigid.items()}
        for model, key, values in (("random", "rms", keys), ("deformation", "rms_nm", bent)):
            if values:
                names.append(f"{model}-{number}")
                inside = ", ".join(f"{name} = {value!r}" for name, value in values.items())
                text += f'[[disturbance]]\nname = "{names[-1]}"\nmodel = "surface-{model}"\n'
                text += f'of = ["{element}"]\n{key} = {{ {inside} }}\nshare = 0\n'
    return text + f'[[disturbance]]\nname = "sum"\nmodel = "combine"\nof = {names}\n'.replace("'", '"')


@pytest.mark.parametrize(
    ("base", "moves", "limit", "by"),
    [
        (LENS, LENS_MOVES, 20.0, "shares"),
        (EUV, EUV_MOVES, 0.3, "cost"),
        (TELESCOPE, TELESCOPE_MOVES, 60.0, "shares"),
    ],
    ids=["lens", "euv", "segments"],
)
def test_a_study_of_the_sizes_in_the_file_exceeds_the_limit_as_often(base, moves, limit, by, tmp_path):
    measure = "wfe_rms" if base is TELESCOPE else "wfe_change"
    cost = "\n[allow]\nlimit = '0.3 nm'\n[allow.cost]\nM6 = 3.0\n'M1 dz' = 5.0\n" if by == "cost" else ""
    asked, held, table = tmp_path / "asked.toml", tmp_path / "held.toml", tmp_path / "a.csv"
    asked.write_text(base + moves + cost)
    found, even = (
        allowances(load_study(asked), measure, share, limit, by, "asked", cases=100)
        for share in (PROBABILITY, COMMON)
    )
    write_allowances(found, table)
    with table.open() as opened:
        held.write_text(base + written(csv.DictReader(opened)))
    values = wq.run(load_study(held), cases=CASES, store=tmp_path / "s")[measure]
    if base is not TELESCOPE:
        values = values.isel(wavelength=values.sizes["wavelength"] // 2)
    rms = np.sqrt((values**2).mean([name for name in values.dims if name != "case"]))
    # Sizes of which 40 % exceed the limit are all larger by one factor: of these, 40 % exceed what is as much
    # smaller. Where the distribution is dense, few cases tell sizes apart.
    allowed = np.isfinite(found.rms)
    factors = even.rms[allowed] / found.rms[allowed]
    np.testing.assert_allclose(factors, factors[0], rtol=1e-6)
    for most, share in ((limit, PROBABILITY), (limit / factors[0], COMMON)):
        above = int((rms > most).sum())
        print(share, above)
        assert binom.ppf(1e-3, CASES, share) <= above <= binom.isf(1e-3, CASES, share)
