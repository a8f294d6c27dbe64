"""Pictures of one's own in studies: what files say, what is kept, what is refused."""

import json

import numpy as np
import pytest
from matplotlib.image import imsave

from wavequake.campaign.store.store import open_store
from wavequake.chain.images.extended import ObjectSection, object_picture
from wavequake.chain.images.picture import in_frame, picture_of, read_picture
from wavequake.errors import UserError
from wavequake.workflows.exposures.telescope_control import segment_text
from wavequake.workflows.run import run_study
from wavequake.workflows.study import load_study

ARROW = np.array([[0.0, 0.5, 0.0], [1.0, 1.0, 1.0], [0.0, 0.25, 0.0], [0.0, 1.0, 0.0]])
SMALL = {
    "optics.rays": 400,
    "wavefront.zernike_terms": 15,
    "imaging.pixels": 16,
    "disturbance.history.instants": 4,
    "campaign.cases": 1,
    "campaign.device": "numpy",
}


def test_files_say_the_same(tmp_path):
    np.save(tmp_path / "a.npy", ARROW)
    np.savetxt(tmp_path / "a.csv", ARROW, delimiter=",")
    imsave(tmp_path / "a.png", ARROW[::-1], cmap="gray", vmin=0.0, vmax=1.0)  # upright, and in color
    for name in ("a.npy", "a.csv"):
        np.testing.assert_array_equal(picture_of(read_picture(tmp_path / name)), ARROW)
    np.testing.assert_allclose(picture_of(read_picture(tmp_path / "a.png")), ARROW, rtol=0, atol=1 / 255)
    np.save(tmp_path / "mask.npy", ARROW > 0.4)
    np.testing.assert_array_equal(picture_of(read_picture(tmp_path / "mask.npy")), ARROW > 0.4)


def test_a_picture_lies_in_the_middle_of_its_frame():
    frame = in_frame(ARROW, 8)
    assert frame.sum() == ARROW.sum()
    np.testing.assert_array_equal(frame[2:6, 3:6], ARROW)
    with pytest.raises(UserError, match="4 x 3 pixels, more than the frame of 3 x 3"):
        in_frame(ARROW, 3)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.npy", np.array([[1.0, -0.5]]), "row 0, column 1 is negative"),
        ("a.npy", np.array([[1.0], [np.nan]]), "row 1, column 0 is not finite"),
        ("a.npy", np.full((2, 2), 1e300), "not finite"),
        ("a.npy", np.ones((2, 2, 3)), r"shape \(2, 2, 3\)"),
        ("a.npy", np.ones((0, 4)), r"shape \(0, 4\)"),
        ("a.npy", np.ones((2, 2), dtype=complex), "complex128, not real"),
        ("a.npy", np.array([["a"]]), "not real"),
        ("a.npy", b"", "it is no NumPy array"),
        ("a.npy", b"nothing", "it is no NumPy array"),
        ("a.csv", b"", "it is empty"),
        ("a.csv", b"1,2\n3\n", r"is no picture \(row 1 has 2 values, row 2 has 1\)"),
        ("a.csv", b"1,nan\n", "not finite"),
        ("a.csv", b"\xff\xfe\x00", "is no picture"),
        ("a.png", b"nothing", "a.png"),
        ("a.png", b"\x89PNG\r\n\x1a\n" + bytes(30), "a.png"),
        ("a.jpg", b"", "must be a .png, .npy or .csv file"),
        ("none.png", None, "cannot be read"),
    ],
)
def test_what_is_no_picture_is_refused(tmp_path, name, content, words):
    if isinstance(content, np.ndarray):
        np.save(tmp_path / name, content)
    elif content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(UserError, match=words) as caught:
        read_picture(tmp_path / name)
    assert str(caught.value).count("object.picture") == 1
    assert "\n" not in str(caught.value)


def test_text_that_is_no_picture_is_refused():
    for text in ("", "2x2:AAAA", "axb:", "2x2:????"):
        with pytest.raises(UserError, match="name a file there"):
            object_picture(ObjectSection(picture_data=text), 8, 0.25)


def test_a_picture_belongs_to_the_study(tmp_path):
    np.save(tmp_path / "a.npy", ARROW)
    study = load_study("tmt-exposure", SMALL | {"object.picture": str(tmp_path / "a.npy")})
    identity = study.identity()
    np.save(tmp_path / "a.npy", 2.0 * ARROW)
    assert (
        load_study("tmt-exposure", SMALL | {"object.picture": str(tmp_path / "a.npy")}).identity() != identity
    )
    (tmp_path / "a.npy").unlink()  # the store does not need it
    run_study(study, tmp_path / "store", on="serial")
    found = open_store(tmp_path / "store").load()["object_image"]
    assert found[0, 0].to_numpy().argmax() // 16 == pytest.approx(8, abs=1)
    with pytest.raises(UserError, match="exactly one"):
        load_study("tmt-exposure", {"object.picture_data": "1x1:AACAPw==", "object.slit": 1.0})


def test_a_picture_larger_than_the_frame_is_refused_before_anything_runs(tmp_path):
    np.save(tmp_path / "a.npy", np.ones((20, 16)))
    study = load_study("tmt-exposure", SMALL | {"object.picture": str(tmp_path / "a.npy")})
    with pytest.raises(UserError, match="20 x 16 pixels, more than the frame of 16 x 16"):
        run_study(study, tmp_path / "store", on="serial")


def test_sensitivities_of_a_study_know_nothing_of_its_object():
    plain = load_study("tmt-exposure", SMALL)
    lit = load_study("tmt-exposure", SMALL | {"object.slit": 1.0, "object.light": "coherent"})
    assert segment_text(lit.identity_text()) == segment_text(plain.identity_text())


def test_stores_of_before_there_were_objects_can_be_read():
    text = load_study("tmt-exposure", SMALL).identity_text()
    old = {key: value for key, value in json.loads(text).items() if key != "object"}
    assert segment_text(json.dumps(old)) == segment_text(text)
