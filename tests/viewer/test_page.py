"""The viewer's page in headless Chromium: it moves, answers to hands and keys, and fits a phone."""

import json
import re

import numpy as np
import pytest
from browser import MISSING, PROGRAM, Browser
from test_film import bench, store  # noqa: F401

import wavequake as wq
from wavequake.viewer import segments
from wavequake.viewer.film import Film, Map, Stage, Take, displacements
from wavequake.viewer.page import render_film

pytestmark = pytest.mark.skipif(PROGRAM is None, reason=MISSING)

SUM = """(() => {
  const c = document.getElementById('scene');
  const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;
  let sum = 0;
  for (let k = 0; k < d.length; k += 4) sum = (sum * 31 + d[k] + 2 * d[k + 1] + 3 * d[k + 2]) % 1000003;
  return sum;
})()"""
FRAMES = "Number(document.body.dataset.frames || 0)"


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    opened = Browser(tmp_path_factory.mktemp("profile"))
    yield opened
    opened.close()


@pytest.fixture(scope="module")
def page(store):  # noqa: F811
    return wq.view(store)


def opened(browser, page, width=1400):
    browser.open(page, width)
    browser.wait("document.body.dataset.ready === '0' && " + FRAMES + " > 0")
    return browser


def after(browser, code):
    """Do something and return the sum of the pixels of the scene when it is drawn again."""
    before = browser.ask(FRAMES)
    browser.ask(code)
    browser.wait(f"{FRAMES} > {before}")
    return browser.ask(SUM)


def put(name, value, event="input"):
    """Return what sets a slider or chooser as a hand does."""
    change = f"e.value = {json.dumps(value)}; e.dispatchEvent(new Event('{event}'))"
    return f"(() => {{ const e = document.getElementById('{name}'); {change}; }})()"


def test_sliders_keys_and_choosers_change_the_picture(browser, page):
    opened(browser, page)
    sums = [browser.ask(SUM)]
    sums.append(after(browser, put("time", 2)))
    sums.append(after(browser, put("factor", 90)))
    sums.append(after(browser, put("factor", -1)))
    assert browser.ask("document.getElementById('scale').textContent") == "none"
    sums.append(after(browser, put("color", "displacement", "change")))
    browser.ask("document.getElementById('scene').focus()")
    before = browser.ask(FRAMES)
    browser.press("ArrowRight")
    browser.wait(f"{FRAMES} > {before}")
    sums.append(browser.ask(SUM))
    browser.ask(put("case", 1, "change"))
    browser.wait("document.body.dataset.ready === '1'")
    assert "No segment moves" in browser.ask("document.getElementById('note').textContent")
    assert len(set(sums)) == len(sums), sums
    assert browser.said == []
    assert [url for url in browser.asked if url != page.as_uri()] == []


def test_play_moves_and_stops(browser, page):
    opened(browser, page)
    assert browser.ask("document.getElementById('play').textContent") == "Play"  # reduced motion is asked for
    first = browser.ask(FRAMES)
    browser.ask("document.getElementById('play').click()")
    browser.wait(f"{FRAMES} > {first} + 5 && document.getElementById('time').value !== '0'")
    browser.ask("document.getElementById('play').click()")
    assert browser.ask("document.getElementById('status').textContent").startswith("Stopped at")


def test_the_page_moves_corners_as_python_does(browser, page, bench):  # noqa: F811
    """16-bit numbers, another language: 2e-5 of the largest motion."""
    opened(browser, page)
    label = browser.ask("document.getElementById('case').selectedOptions[0].textContent")
    case = int(label.rpartition(" ")[2])
    stage, take = segments.stage_of_telescope(bench), segments.take_of(bench, case, "numpy")
    moved = displacements(stage, take)
    by = 0.1 / np.abs(moved).max()
    for instant in (0, 2):
        found = browser.ask(f"(viewer.move({instant}, {by}), Array.from(viewer.state.moved))")
        shown = (np.array(found).reshape(-1, 3) - stage.points) / by
        assert np.abs(shown - moved[instant]).max() < 4e-5 * np.abs(moved).max()


@pytest.mark.parametrize("width", [1400, 400, 375])
def test_it_fits_the_window(browser, page, width, tmp_path):
    opened(browser, page, width)
    assert browser.ask("document.documentElement.scrollWidth <= innerWidth")
    for tag in ("button", "select", "input"):
        heights = browser.ask(
            f"[...document.querySelectorAll('{tag}')].filter(e => e.offsetParent).map(e => e.offsetHeight)"
        )
        assert min(heights) >= 44
    assert browser.ask("document.getElementById('scene').getBoundingClientRect().top < innerHeight / 2")
    assert browser.picture()[:4] == b"\x89PNG"


def test_without_scripts_there_is_a_still_and_a_table(browser, page):
    browser.call("Emulation.setScriptExecutionDisabled", value=True)
    try:
        browser.open(page)
        assert browser.ask("document.querySelector('noscript img').naturalWidth > 100")
        assert browser.ask("document.querySelectorAll('noscript tr').length") == 3
    finally:
        browser.call("Emulation.setScriptExecutionDisabled", value=False)


def test_a_damaged_page_says_so(browser, page, tmp_path):
    text = page.read_text()
    block = json.loads(re.search(r'id="film">(.*?)</script>', text, flags=re.S)[1])["takes"][0]["poses"]["id"]
    at = text.index(f'id="{block}">') + len(block) + 45
    damaged = text[:at] + ("A" if text[at] != "A" else "B") + text[at + 1 :]
    (tmp_path / "damaged.html").write_text(damaged)
    browser.open(tmp_path / "damaged.html")
    browser.wait("document.getElementById('status').textContent.includes('damaged')")
    assert block in browser.ask("document.getElementById('status').textContent")


def test_a_drawing_in_space_can_be_turned(browser, tmp_path):
    from wavequake.viewer.view import write_scene

    opened(browser, write_scene("euv", tmp_path / "euv.html"))
    before = browser.ask(SUM)
    up = "new KeyboardEvent('keydown', {key: 'ArrowUp'})"
    assert after(browser, f"document.getElementById('scene').dispatchEvent({up})") != before
    assert browser.said == []


def test_reports_fit_the_window_with_text_that_can_be_read(browser, store):  # noqa: F811
    """No page wider than the screen; the text of figures has at least 9 pixels; no card is empty."""
    report = wq.report(store)
    for width in (1400, 400):
        browser.open(report, width)
        assert browser.ask("document.documentElement.scrollWidth <= innerWidth"), width
        sizes = browser.ask(
            "[...document.querySelectorAll('figure svg')].map(s => s.getBoundingClientRect().width /"
            " s.viewBox.baseVal.width * 9)"
        )
        assert min(sizes) >= 8.95, (width, min(sizes))
        full = "every(f => f.querySelector('svg').children.length > 0)"
        assert browser.ask(f"[...document.querySelectorAll('figure')].{full}")
        assert browser.ask("document.querySelector('figure').id") == "layout"
    assert browser.said == []


def test_maps_and_the_track_of_the_line_of_sight_are_drawn(browser, tmp_path):
    """A map whose numbers are 1 left and -1 right is red left and blue right, and turns over in time."""
    points, faces = np.eye(3), np.array([[0, 1, 2]])
    stage = Stage(points, faces, np.zeros(3, int), ("#888888",), ("a",), np.zeros((1, 3)), np.eye(3)[None])
    cells = np.tile(np.repeat([0, 1], 8), (16, 1))
    cells[:2] = -1
    shown = Map("wavefront", "nm", cells, np.array([[2.0, -2.0]]), np.array([[1.0], [-1.0]]), 2.0)
    image = np.full((2, 16, 16), 1e-9)
    image[0, 8, 8] = image[1, 8, 12] = 1.0
    track = np.array([[0.0, 0.0], [2.0, 0.0]])
    nothing = np.array([[1.0], [np.nan]])
    take = Take(
        *("moves", np.arange(2.0)),
        images=image,
        pixel=0.5,
        track=track,
        maps=(shown,),
        series={"known in part": ("nm", nothing)},
    )
    (tmp_path / "map.html").write_text(render_film(Film("map", "store", (stage,), (take,))))
    opened(browser, tmp_path / "map.html")
    at = """(() => {{ const c = document.querySelector('{}');
      return [...c.getContext('2d').getImageData({} * c.width, {} * c.height, 1, 1).data]; }})()"""
    left, right = (browser.ask(at.format(".map", x, 0.5)) for x in (0.3, 0.7))
    assert left[0] > left[2] + 50
    assert right[2] > right[0] + 20
    assert browser.ask(at.format(".image", 0.5 + 0.5 / 16, 0.5 - 0.5 / 16))[2] > 200  # the dot of the track
    after(browser, put("time", 1))
    left, right = (browser.ask(at.format(".map", x, 0.5)) for x in (0.3, 0.7))
    assert left[2] > left[0] + 20
    assert right[0] > right[2] + 50
    assert browser.ask(at.format(".image", 0.5 + 4.5 / 16, 0.5 - 0.5 / 16))[2] > 200
    assert browser.said == []


def test_figures_bend_what_is_drawn(browser, tmp_path):
    """A flat square whose figure lifts its middle stands still flat, and is colored by its displacement."""
    points = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0], [0, 0, 0]], dtype=float)
    faces = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    stage = Stage(
        *(points, faces, np.zeros(5, int), ("#888888",) * 4, ("a",), np.zeros((1, 3)), np.eye(3)[None]),
        terms=np.array([[0.0, 0.0], [0.0, 0.0], [0.0, 0.0], [0.0, 0.0], [0.5, 2.0]]),
    )
    take = Take("bends", np.arange(2.0), figures=np.array([[[0.0, 0.0]], [[2e-6, 1e-6]]]))
    moved = displacements(stage, take)
    np.testing.assert_allclose(moved[1], [[0, 0, 0]] * 4 + [[0, 0, 3e-6]], atol=1e-18)
    (tmp_path / "bent.html").write_text(render_film(Film("bent", "store", (stage,), (take,))))
    opened(browser, tmp_path / "bent.html")
    flat = browser.ask(SUM)
    bent = after(browser, put("time", 1))
    assert bent != flat
    assert after(browser, put("factor", -1)) != bent  # without exaggeration it is flat, and still colored
    assert browser.said == []
