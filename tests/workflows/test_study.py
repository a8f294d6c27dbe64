import json
import re
import tomllib

import pytest

from wavequake.campaign.schema import study_from_identity
from wavequake.errors import UserError
from wavequake.files import folder
from wavequake.workflows.segments.study import SegmentStudy
from wavequake.workflows.study import bundled_studies, load_study, study_with

MINIMAL = """
[study]
name = "mine"
workflow = "segment-disturbance"
[telescope]
name = "tmt-18"
[[disturbance]]
name = "still"
model = "static-random"
"""


@pytest.fixture
def minimal(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(MINIMAL)
    return path


@pytest.mark.parametrize("name", bundled_studies())
def test_bundled_studies_load_and_come_back_from_their_identity(name):
    study = load_study(name)
    again = study_from_identity(type(study), study.identity_text())
    assert again.identity() == study.identity()
    assert study.study.title


def test_overrides_reach_sections_and_named_disturbances(minimal):
    study = load_study(
        minimal, ["campaign.cases=7", "disturbance.still.piston_nm=3.5", "telescope.gap_mm=2.5"]
    )
    assert study.campaign.cases == 7
    assert study.disturbance[0].piston_nm == 3.5
    assert study.telescope.gap_mm == 2.5
    assert study_with(study, {"optics.rays": 500}).optics.rays == 500


def test_how_much_and_where_are_not_part_of_the_identity(minimal):
    base = load_study(minimal)
    same = load_study(
        minimal, ["campaign.cases=3", "campaign.device=numpy", "store.path=x", "store.chunk_cases=7"]
    )
    assert same.identity() == base.identity()


@pytest.mark.parametrize(
    "override",
    ["study.seed=1", "optics.rays_per_segment=36", "disturbance.still.instants=4", "imaging.pixels=32"],
)
def test_what_changes_numbers_changes_the_identity(minimal, override):
    assert load_study(minimal, [override]).identity() != load_study(minimal).identity()


def test_the_identity_is_canonical_json(minimal):
    text = load_study(minimal).identity_text()
    assert json.dumps(json.loads(text), sort_keys=True, separators=(",", ":")) == text
    assert tomllib.loads(MINIMAL)["telescope"]["name"] in text


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("campaign.casse=4", ["campaign.casse", "unknown", "'cases'"]),
        ("telescop.name=tmt", ["telescop", "unknown", "'telescope'"]),
        ("disturbance.still.piston_n=1.0", ["disturbance.still.piston_n", "'piston_nm'"]),
        ("disturbance.stil.piston_nm=1.0", ["'stil'", "'still'"]),
        ("campaign.cases=many", ["campaign.cases", "integer", "'many'"]),
        ("campaign.cases=-3", ["campaign.cases", "greater than or equal to 1", "-3"]),
        ("campaign.cases=1.5", ["campaign.cases", "integer"]),
        ("optics.wavelength_nm=0.0", ["optics.wavelength_nm", "greater than 0"]),
        ("optics.wavelength_nm=nan", ["optics.wavelength_nm", "finite"]),
        ("optics.rays_per_segment=17", ["optics.rays_per_segment", "6, 18, 36 or 72"]),
        ("telescope.name=tnt", ["telescope.name", "'tnt'"]),
        ("telescope.polygons=x.csv", ["telescope.polygons", "x.csv"]),
        ("disturbance.still.share=0", ["share"]),
        ("cases=4", ["no section", "campaign.cases"]),
        ("campaign.cases.more=4", ["campaign.cases", "integer"]),
        ("nonsense", ["section.key=value"]),
        ("disturbance.still.model=wind", ["disturbance.still.model", "no model 'wind'", "segment-wind"]),
        ("study.name=../x", ["study.name", "'../x'", "letters, digits"]),
    ],
)
def test_bad_input_is_one_sentence_that_says_what_is_right(minimal, override, words):
    with pytest.raises(UserError) as caught:
        load_study(minimal, [override])
    message = str(caught.value)
    assert "\n" not in message
    for word in words:
        assert word in message


def test_unknown_study_names_the_nearest():
    with pytest.raises(UserError, match="did you mean 'tmt-segments'"):
        load_study("tmt-segment")


def test_a_file_that_is_no_toml_says_where(tmp_path):
    path = tmp_path / "bad.toml"
    path.write_text("[study\n")
    with pytest.raises(UserError, match=r"bad.toml is not a TOML file.*line 1"):
        load_study(path)


def test_a_matrix_of_finite_elements_says_what_it_is_for(tmp_path):
    (tmp_path / "plate.sti").write_text("1 1 2.0\n")
    with pytest.raises(UserError, match=r"stiffness matrix of CalculiX.*`wavequake new .*plate\.sti`"):
        load_study(tmp_path / "plate.sti")


def test_a_title_names_the_first_values_of_a_long_list_whole():
    study = load_study("mirror-mor", {"reduction.variants": [f"craigb{order}" for order in range(20, 36, 2)]})
    assert "'craigb20', 'craigb22' and 6 more" in study.study.title
    assert "..." not in study.study.title


def test_a_lens_file_is_no_study(tmp_path):
    path = tmp_path / "lens.zmx"
    path.write_bytes("MODE SEQ\n".encode("utf-16"))
    with pytest.raises(UserError, match=r"lens.zmx is a lens file, not a study: .* `file` of its \[system\]"):
        load_study(path)


def test_missing_section_and_missing_disturbance(tmp_path, minimal):
    path = tmp_path / "short.toml"
    path.write_text(MINIMAL.replace('[telescope]\nname = "tmt-18"', ""))
    with pytest.raises(UserError, match="'telescope' is missing"):
        load_study(path)
    path.write_text(MINIMAL.split("[[")[0])
    with pytest.raises(UserError, match="'disturbance' is missing"):
        load_study(path)


def test_two_disturbances_of_one_name_and_a_dangling_combination(minimal, tmp_path):
    twice = tmp_path / "twice.toml"
    twice.write_text(MINIMAL + MINIMAL[MINIMAL.index("[[") :])
    with pytest.raises(UserError, match="two disturbances are called 'still'"):
        load_study(twice)
    dangling = tmp_path / "dangling.toml"
    dangling.write_text(
        MINIMAL + '[[disturbance]]\nname = "all"\nmodel = "combine"\nof = ["still", "wind"]\n'
    )
    with pytest.raises(UserError, match="'all' combines 'wind'"):
        load_study(dangling)
    with pytest.raises(UserError, match=r"'all' names '.*' twice; name it once"):
        load_study(dangling, ['disturbance.all.of=["still", "still"]'])
    with pytest.raises(UserError, match=r"disturbance.all.of: it needs at least 2 entries, not 1\.$"):
        load_study(dangling, ['disturbance.all.of=["still"]'])


GLASS = "id,x1_m,y1_m,x2_m,y2_m,x3_m,y3_m\nA,1,0,2,0,1.5,1\n"


@pytest.fixture
def own(tmp_path):
    """A study of a custom telescope with glass.csv."""
    (tmp_path / "glass.csv").write_text(GLASS)
    path = tmp_path / "own.toml"
    path.write_text(
        MINIMAL.replace(
            'name = "tmt-18"',
            'name = "custom"\npolygons = "glass.csv"\nprimary_radius_mm = -20000.0\n'
            'surfaces = [{name = "image", distance_mm = 10000.0}]',
        )
    )
    return path


def test_a_wrong_table_of_polygons_is_named_with_its_line(tmp_path, own):
    (tmp_path / "glass.csv").write_text(GLASS + "B,3,0,4,nan,3.5,1\n")
    with pytest.raises(UserError, match=r"glass\.csv, line 3, column 5: 'nan' is not a number"):
        load_study(own)


def test_byte_order_marks_and_line_ends_make_no_other_study(tmp_path, own):
    expected = load_study(own).identity()
    for path in (own, tmp_path / "glass.csv"):
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
    assert load_study(own).identity() == expected


def test_a_wrong_spectrum_is_the_only_complaint(tmp_path, minimal):
    (tmp_path / "psd.csv").write_text("frequency_hz,psd\n1,1\n2,-1\n")
    words = ["model=line-of-sight", "spectrum=file", "file=psd.csv", "rms_mas=1.0"]
    with pytest.raises(UserError, match=r"psd\.csv, line 3: the psd -1 is negative[^()]*at least 0\.$"):
        load_study(minimal, [f"disturbance.still.{word}" for word in words])


def test_a_custom_telescope_carries_its_polygons(tmp_path, own):
    study = load_study(own)
    (tmp_path / "glass.csv").unlink()
    assert "A,1,0" in study_from_identity(SegmentStudy, study.identity_text()).telescope.polygons_csv
    with pytest.raises(UserError, match=r"telescope.polygons: the file .* cannot be read"):
        load_study(own)


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("foo.bar=1", "the key 'foo' is unknown; valid keys are study, campaign, store, "),
        ("case=8", "The key 'case' has no section; did you mean campaign.cases?"),
        ("wonder=8", "The key 'wonder' has no section; write section.key=value."),
        ("foo.wavelength_nm=1", "The key 'foo.wavelength_nm' is unknown; did you mean optics.wavelength_nm?"),
        ("optic.wavelength_nm=1", "the key 'optic' is unknown; the nearest valid key is 'optics'"),
        ("optics.wavelenth_nm=1", "the nearest valid key is 'wavelength_nm'"),
        ("optics.colour=1", "the key 'optics.colour' is unknown; valid keys are wavelength_nm, sampling"),
    ],
)
def test_an_override_of_no_key_says_what_would_be_one(override, words):
    with pytest.raises(UserError, match=re.escape(words)):
        load_study("tmt-segments", [override])


@pytest.mark.parametrize("key", ["optics.wavelength_nm", "disturbance.wind.mean_speed_m_s"])
def test_the_sentence_blames_the_override_and_not_the_file(key, tmp_path):
    with pytest.raises(UserError, match=rf"^tmt-segments.toml, overridden by {key}=\.\.\.: .*{key}.* -1"):
        load_study("tmt-segments", ["campaign.cases=8", f"{key}=-1"])
    wrong = tmp_path / "wrong.toml"
    wrong.write_text((folder("workflows") / "tmt-segments.toml").read_text() + "rays = -2\n")
    with pytest.raises(UserError, match=r"^wrong.toml: "):
        load_study(wrong, ["campaign.cases=8"])
