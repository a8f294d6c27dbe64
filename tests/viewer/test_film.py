"""What the viewer shows of stores: motions, wavefronts and images against what else knows them; the page."""

import json
import re
import zlib
from base64 import b64decode, b64encode
from hashlib import sha256

import numpy as np
import pytest
from scipy.interpolate import LinearNDInterpolator

import wavequake as wq
from wavequake.errors import UserError
from wavequake.optics.segments.kinematics import segment_poses
from wavequake.viewer import encode as encoding
from wavequake.viewer import segments
from wavequake.viewer.encode import LIMIT, Blocks, encode
from wavequake.viewer.film import Film, Stage, Take, displacements, principal
from wavequake.viewer.page import render_film
from wavequake.workflows.segments.bench import bench_of
from wavequake.workflows.segments.disturbance import draw

STUDY = """
[study]
name = "tiny"
workflow = "segment-disturbance"
title = "Eighteen segments </script> shaken"
[telescope]
name = "tmt-18"
[imaging]
pixels = 24
[campaign]
cases = 4
[[disturbance]]
name = "shaken"
model = "segment-wind"
mean_speed_m_s = 0.2
instants = 3
[[disturbance]]
name = "pointing"
model = "line-of-sight"
rms_mas = 5.0
instants = 3
"""


@pytest.fixture(scope="session")
def store(tmp_path_factory):
    folder = tmp_path_factory.mktemp("view")
    (folder / "tiny.toml").write_text(STUDY)
    wq.run(folder / "tiny.toml", store=folder / "store")
    return folder / "store"


@pytest.fixture(scope="session")
def bench(store):
    return bench_of(json.loads((store / "manifest.json").read_text())["study"])


def unpacked(page, block):
    """Decode an array of a page by another way than the page's."""
    text = re.search(rf'<script type="text/plain" id="{block["id"]}">([^<]*)</script>', page)[1]
    raw = zlib.decompress(b64decode(text))
    assert zlib.crc32(raw) == block["crc32"]
    values = np.frombuffer(raw, dtype="<" + np.dtype(block["dtype"]).str[1:]).reshape(block["shape"])
    return values * (np.array(block["scale"]) if block["dtype"] == "int16" else 1.0)


def record_of(page):
    return json.loads(re.search(r'id="film">(.*?)</script>', page, flags=re.S)[1])


def test_segments_move_as_the_optics_move_them(bench):
    """Corners by the exact poses of the trace, in the sky's frame: small rotations leave 1e-6 of it."""
    stage, take = segments.stage_of_telescope(bench), segments.take_of(bench, 0, "numpy")
    moved = displacements(stage, take)
    telescope = bench.system.segments
    motion = np.zeros((16, 18, 6))
    motion[:3] = draw(bench, 0).motion.segment_motion
    motion[..., :3] *= 1e3
    poses = np.moveaxis(segment_poses(telescope, motion)[0], 2, 0)[:3]  # they undo the motion
    turn, shift = poses[..., :9].reshape(3, 18, 3, 3), poses[..., 9:]
    flip, count = np.array([1.0, 1.0, -1.0]), 18 * telescope.corners.shape[1]
    corners = (stage.points[:count] * flip * 1e3).reshape(18, -1, 3)
    there = np.einsum("tsji,tsvj->tsvi", turn, corners[None] - shift[:, :, None])
    wanted = ((there - corners) * flip / 1e3).reshape(3, count, 3)
    assert np.abs(wanted).max() > 1e-8
    np.testing.assert_allclose(moved[:, :count], wanted, rtol=0, atol=2e-6 * np.abs(wanted).max())
    assert not moved[:, count:].any()  # M2, M3 and the image stand still


def test_wavefront_and_image_are_those_of_the_store(bench, store):
    """Mean of the images = the stored exposure; the wavefront's planes have its rms, to what planes leave."""
    ds = wq.open_store(store).load()
    take = segments.take_of(bench, 0, "numpy")
    np.testing.assert_allclose(take.images.mean(axis=0), ds.exposure.sel(case=0), rtol=0, atol=1e-6)
    unit, los = take.series["line of sight"]
    assert unit == "mas"
    np.testing.assert_allclose(los, ds.los.sel(case=0), rtol=0, atol=1e-6)
    planes = take.planes[:, :18]
    pistons = planes[..., 0]
    assert np.abs(pistons.mean(axis=1)).max() < 1e-6 * np.abs(pistons).max()
    # A piston of 20 nm of a segment is a wavefront of twice that, along the axis.
    motion = draw(bench, 0).motion.segment_motion[..., 2] * 1e9
    x, y = bench.system.segments.centers[:, :2].T
    plane = np.stack([np.ones(18), x, y], axis=1)
    left = motion - (plane @ np.linalg.lstsq(plane, motion.T, rcond=None)[0]).T
    share = np.abs(np.sum(left * pistons) / np.sum(left * left))
    assert share == pytest.approx(2.0, rel=0.05)
    still = segments.take_of(bench, 1, "numpy")
    assert "No segment moves" in still.note


def test_the_page_holds_what_was_computed_and_asks_for_nothing(store, tmp_path):
    file = wq.view(store, file=tmp_path / "view.html")
    page = file.read_text()
    assert wq.view(store, file=tmp_path / "again.html").read_bytes() == file.read_bytes()
    record = record_of(page)
    assert [take["label"].split(",")[0] for take in record["takes"]] == ["shaken", "pointing"]
    case = int(record["takes"][0]["label"].rpartition(" ")[2])
    bench = bench_of(json.loads((store / "manifest.json").read_text())["study"])
    take = segments.take_of(bench, case, "numpy")
    poses = unpacked(page, record["takes"][0]["poses"])
    used = record["takes"][0]["dofs"]
    wanted = take.poses[..., used]
    assert np.abs(poses - wanted).max(axis=(0, 1)) == pytest.approx(0.0, abs=2e-5 * np.abs(wanted).max())
    levels = unpacked(page, record["takes"][0]["images"]) / 255.0
    irradiance = take.images.max() * 10.0 ** (4.0 * (levels - 1.0))
    bright = levels > 0.0
    assert np.abs(np.log10(irradiance[bright] / take.images[bright])).max() < 0.51 * 4.0 / 255.0
    assert not re.findall(r'(?:src|href)="(?!data:)', page)
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', page)[1]
    for tag, kind in (("script", "script"), ("style", "style")):
        text = re.findall(rf"<{tag}>(.*?)</{tag}>", page, flags=re.S)[0]
        assert f"{kind}-src 'sha256-{b64encode(sha256(text.encode()).digest()).decode()}'" in policy
        assert len(text) < 30_000
    assert "unsafe" not in policy
    assert "<title>Eighteen segments &lt;/script&gt; shaken</title>" in page


@pytest.mark.parametrize("key", ["store.reduce=summary", "imaging.enabled=false"])
def test_stores_of_summaries_or_without_images_are_shown(store, tmp_path, key):
    wq.run(wq.load_study(store.parent / "tiny.toml", [key]), store=tmp_path / "s")
    record = record_of(wq.view(tmp_path / "s").read_text())
    worst = int(record["takes"][0]["label"].rpartition(" ")[2])
    ds = wq.open_store(store).load()
    error = (ds.wfe_rms_raw[ds.disturbance == "shaken"] ** 2).mean("time")
    assert worst == int(error.case[int(np.argmax(error.to_numpy()))])


def test_what_is_too_large_is_left_out_and_said():
    stage = Stage(
        np.eye(3),
        np.array([[0, 1, 2]]),
        np.zeros(3, dtype=int),
        ("red",),
        ("a",),
        np.zeros((1, 3)),
        np.eye(3)[None],
    )
    noise = np.random.default_rng(3).uniform(1e-4, 1.0, (4, 40, 256, 256))
    takes = tuple(Take(f"case {k}", np.arange(40.0), images=one) for k, one in enumerate(noise))
    text, blocks = encode(Film("large", "store", (stage,), takes))
    assert blocks.size < LIMIT
    assert json.loads(text)["notes"][0].startswith("1 of ")
    assert len(render_film(Film("large", "store", (stage,), takes[:1]))) < LIMIT


def test_the_first_cases_that_fit_are_shown_and_each_is_packed_once(monkeypatch):
    bodies = 4500  # 1.44 MB each: six fit
    stage = Stage(
        np.eye(3),
        np.array([[0, 1, 2]]),
        np.zeros(3, dtype=int),
        ("red",),
        tuple(map(str, range(bodies))),
        np.zeros((bodies, 3)),
        np.broadcast_to(np.eye(3), (bodies, 3, 3)),
    )
    noise = np.random.default_rng(3).uniform(-1.0, 1.0, (9, 20, bodies, 6))
    takes = tuple(Take(f"case {k}", np.arange(20.0), poses=one) for k, one in enumerate(noise))
    packed, pack = [], encoding._take
    monkeypatch.setattr(encoding, "_take", lambda *given: packed.append(given[1]) or pack(*given))
    record = json.loads(encode(Film("long", "store", (stage,), takes))[0])
    shown = len(record["takes"])
    assert [one["label"] for one in record["takes"]] == [f"case {k}" for k in range(shown)]
    assert 0.96 * LIMIT / (shown + 1) < 20 * bodies * 6 * 2 * 4 / 3 < LIMIT / shown
    assert record["notes"] == [f"{9 - shown} of 9 cases did not fit into 10 MB"]
    assert len(packed) == shown + 1


def test_names_are_shown_and_not_obeyed():
    evil, shown = "a\x1b[2J\x00\u202eb", r"a\x1b[2J\x00\u202eb"
    points, faces = np.eye(3), np.array([[0, 1, 2]])
    stage = Stage(points, faces, np.zeros(3, int), ("#000000",), (evil,), np.zeros((1, 3)), np.eye(3)[None])
    take = Take(evil, np.zeros(2), note=evil, poses=np.zeros((2, 1, 6)))
    text = render_film(Film(evil, evil, (stage,), (take,)))
    assert text.count(shown) == 4  # title, heading, row and its note
    assert text.count(json.dumps(shown)[1:-1]) == 5  # title, source, name, label and note of the film
    assert "\\u001b" not in text
    assert not re.search("[\x00\x1b\u202e]", text)


def test_shapes_give_the_displacements_again():
    rng = np.random.default_rng(5)
    moved = np.tensordot(rng.normal(size=(30, 3)), rng.normal(size=(3, 7, 3)), 1)
    shapes, weights = principal(moved, 1e-9)
    assert len(shapes) == 3
    np.testing.assert_allclose(np.tensordot(weights, shapes, 1), moved, atol=1e-12)
    shapes, weights = principal(np.zeros((4, 7, 3)))
    assert not np.tensordot(weights, shapes, 1).any()


def test_mirrors_are_shown_beside_their_reduced_models(tmp_path):
    """Reference and craigb36 agree to the reduction's error; frequencies are in the label."""
    study = wq.load_study(
        "mirror-mor",
        {
            "model.rings": 2,
            "model.shapes": ["circular"],
            "reduction.variants": ["craigb36"],
            "reduction.frequencies": 4,
            "time.duration_s": 0.004,
            "optics.zernike_terms": 11,
            "imaging.pupil_samples": 32,
        },
    )
    wq.run(study, store=tmp_path / "m")
    record = record_of(wq.view(tmp_path / "m").read_text())
    labels = [take["label"] for take in record["takes"]]
    assert labels[0].startswith("case 1, circular craigb36: mode 1, ")
    reference, reduced = map(float, re.search(r"mode 1, ([\d.]+) and ([\d.]+) Hz", labels[0]).groups())
    assert reduced == pytest.approx(reference, rel=1e-3)
    assert reduced >= reference * (1.0 - 1e-4)  # Rayleigh and Ritz: from above
    excited = next(take for take in record["takes"] if "excited" in take["label"])
    both, apart = (np.array(series["values"]) for series in excited["series"])
    assert apart.max() < 0.02 * both.max()
    with pytest.raises(UserError, match="there is no case 7"):
        wq.view(tmp_path / "m", case=7)


def test_systems_move_their_surfaces(tmp_path):
    wq.run("euv", cases=3, store=tmp_path / "e", optics__rays=60, wavefront__zernike_terms=11)
    page = wq.view(tmp_path / "e").read_text()
    record = record_of(page)
    assert [take["label"].split(",")[0] for take in record["takes"]] == ["drift", "vibration", "heating"]
    poses = unpacked(page, record["takes"][1]["poses"])
    assert poses.shape[1] == 7  # M1 to M6, and the wafer, which stands still
    assert np.abs(poses[:, :6]).max() < 1e-8
    assert not poses[:, 6].any()
    assert {series["unit"] for series in record["takes"][1]["series"]} == {"nm", "mm"}


def test_what_cannot_be_viewed_says_so(wavequake, tmp_path, store):
    code, _, err = wavequake("view", tmp_path / "nothing")
    assert code == 2
    assert "nothing" in err
    code, out, _ = wavequake("view", store, "--case", 0, "--case", 2, "-o", tmp_path / "v.html")
    assert code == 0
    assert "shaken, case 0" in out
    assert "case 0: shaken" not in out  # it is said once
    assert wavequake("draw", "euv", "--3d", "-o", tmp_path / "euv.html")[0] == 0
    assert "M6" in (tmp_path / "euv.html").read_text()


def test_equal_arrays_are_kept_once():
    blocks = Blocks()
    one = np.arange(6.0).reshape(2, 3)
    first, again, other = (blocks.add_scaled(values)["id"] for values in (one, one.copy(), one[::-1]))
    assert first == again != other
    assert len(blocks.texts) == 2


BENT = """
[study]
name = "bent"
workflow = "segment-disturbance"
[telescope]
name = "tmt-18"
[optics]
rays_per_segment = 72
[imaging]
enabled = false
[campaign]
cases = 1
device = "numpy"
[[disturbance]]
name = "polished"
model = "static-random"

figure_nm = { 5 = 20.0, 8 = 10.0 }
"""


def test_segments_bend_by_the_figures_that_the_trace_meets(tmp_path):
    """Heights of the drawn triangles, looked up where rays are, are half the change of their paths."""
    (tmp_path / "bent.toml").write_text(BENT)
    bench = bench_of(wq.load_study(tmp_path / "bent.toml").identity_text())
    stage, take = segments.stage_of_telescope(bench), segments.take_of(bench, 0, "numpy")
    bent = displacements(stage, take)[0]
    rays, glass = bench.prepared.rays, take.maps[0]
    change = (glass.weights @ glass.shapes)[0]
    cosine = bench.system.segments.axes[:, 2, 2]
    agreeing = []
    for one in range(18):
        mine, corners = rays.segment == one, stage.body == one
        points, heights = stage.points[corners, :2] * 1e3, bent[corners, 2] * 1e9
        inside = LinearNDInterpolator(points, heights)(rays.x[mine], rays.y[mine])
        both = np.isfinite(inside)
        agreeing.append(np.stack([inside[both] * np.abs(cosine[one]), change[mine][both]]))
    height, path = np.concatenate(agreeing, axis=1)
    flat = np.stack([np.ones_like(height), height], axis=1)
    (_, factor), left = np.linalg.lstsq(flat, path)[:2]
    assert abs(factor) == pytest.approx(2.0, rel=0.1)  # straight between corners: lower than the polynomial
    assert left[0] < 0.1 * np.sum((path - path.mean()) ** 2)
