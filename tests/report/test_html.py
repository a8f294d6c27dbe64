"""The report is one well-formed file that loads nothing and believes nothing."""

import re
import unicodedata
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

from wavequake.errors import UserError
from wavequake.report.page import _marked, render_page, write_page
from wavequake.report.populations import populations
from wavequake.report.segments.page import page_of

LIMITS = {"shake": (5.1, "mas")}
VOID = {"meta", "br", "img", "link", "input", "hr"}


def render_report(dataset, details, limits=None):
    return render_page(dataset, page_of(populations(dataset, limits), dataset, details))


def write_report(dataset, details, path):
    return write_page(render_report(dataset, details), path)


class Reader(HTMLParser):
    """Collects tags, text, ids and everything that a browser would fetch; checks that tags nest."""

    def __init__(self):
        super().__init__()
        self.open, self.tags, self.ids, self.targets, self.text = [], [], [], [], []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        if tag not in VOID:
            self.open.append(tag)
        self.note(attrs)

    def handle_startendtag(self, tag, attrs):
        self.tags.append(tag)
        self.note(attrs)

    def note(self, attrs):
        for name, value in attrs:
            assert not name.startswith("on")
            if name == "id":
                self.ids.append(value)
            if name in ("src", "href", "xlink:href", "srcset", "data", "action", "poster"):
                self.targets.append(value)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text.append(data)


def read(html):
    reader = Reader()
    reader.feed(html)
    reader.close()
    assert not reader.open
    return reader


@pytest.fixture(scope="module")
def html(pristine, detail):
    return render_report(pristine, [detail], LIMITS)


def test_it_is_one_well_formed_file_that_loads_nothing(html):
    reader = read(html)
    assert all(target.startswith(("#", "data:image/png;base64,")) for target in reader.targets)
    assert not re.search(r"url\((?!#)", html)
    assert "@import" not in html
    assert not {"script", "link", "iframe", "object", "embed", "base", "form"} & set(reader.tags)


def test_every_id_is_unique_and_every_reference_is_met(html):
    reader = read(html)
    assert len(set(reader.ids)) == len(reader.ids)
    referred = {target[1:] for target in reader.targets if target.startswith("#")}
    referred |= set(re.findall(r"url\(#([^)]+)\)", html))
    assert referred - {"all"} <= set(reader.ids)


def test_nothing_from_the_study_or_the_store_is_believed(html):
    reader = read(html)  # a hostile name would have added a script, an image or a handler
    assert "<script" not in html
    assert "<cpu>" not in html
    assert "&lt;cpu&gt;" in html
    assert '</title><script>alert("x")</script>' in "".join(reader.text)
    assert "a <title> of a study" in reader.text


def test_hostile_disturbances_messages_and_segments_are_text(campaign, detail):
    evil = "<script>alert(1)</script>--><svg onload=x> $\\frac{ ]]>"
    names = np.where(campaign["disturbance"] == "wind", evil, campaign["disturbance"])
    messages = np.where(campaign["message"] == "", "", evil)
    hostile = campaign.assign_coords(disturbance=("case", names)).assign(message=("case", messages))
    case = replace(detail, disturbance=evil, segment_names=(evil,) * 7)
    html = render_report(hostile, [case])
    read(html)
    assert "<script" not in html
    assert "<svg onload" not in html


def test_nothing_that_is_obeyed_is_written(campaign, detail, tmp_path):
    """Titles, names and reasons may hold what terminals and browsers obey; editors of lenses write them."""
    evil = "a\x1b]0;t\x07\x1b[2J\x9b31m\r\x00b\u202ec\u2066d\u2028\ufeff"
    shown = r"a\x1b]0;t\x07\x1b[2J\x9b31m\r\x00b\u202ec\u2066d\u2028\ufeff"
    names = np.where(campaign["disturbance"] == "wind", evil, campaign["disturbance"])
    messages = np.where(campaign["message"] == "", "", evil)
    hostile = campaign.assign_coords(disturbance=("case", names)).assign(message=("case", messages))
    hostile = hostile.assign_attrs(study_title=evil, device=evil)
    case = replace(detail, disturbance=evil, segment_names=(evil,) * 7)
    text = write_report(hostile, [case], tmp_path / "report.html").read_text(encoding="utf-8")
    assert text.count(shown) > 20
    assert not [one for one in text if unicodedata.category(one) in ("Cc", "Cs", "Zl", "Zp") and one != "\n"]
    assert not re.search("[\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069\ufeff]", text)
    read(text)


def test_what_stands_between_backticks_is_code_and_nothing_else_is_html():
    assert _marked("`rerun <STORE>` & <b>") == "<code>rerun &lt;STORE&gt;</code> &amp; &lt;b&gt;"
    assert _marked("a ` alone") == "a ` alone"


def test_it_says_everything_that_it_should(html):
    text = " ".join("".join(read(html).text).split())
    assert (
        "shake costs the most: the dimmest of its 2 exposures has a peak of 0.200 of the" in text
    )  # it moves
    assert "wind: at most 30.0 nm rms in 3 cases" in text  # few cases have no percentiles
    assert "The largest wavefront error is that of wind" in text
    assert "29.0" in text  # P95 of wind
    assert "> 1, the frame" in text
    assert "segment S1 lost all its rays" in text
    assert "timed out" in text
    assert "No case of this disturbance is done." in text
    assert "Störkle 2018, Eq. (3.39)" in text or "Eq. 3.39" in text or "2 c λ / NA" in text
    assert "Strehl ratio <in some direction>" in text  # the store's own definition
    assert '"telescope"' in text
    assert "numpy 2.1" in text


def test_one_disturbance_is_not_the_most_of_anything(campaign):
    one = campaign.isel(case=(campaign["disturbance"] == "wind").to_numpy())
    text = " ".join("".join(read(render_report(one, [])).text).split())
    assert "Its wavefront error is at most" in text  # of so few cases no percentile is known
    assert not re.search("costs the most|largest wavefront error is that of|, the most, under", text)


def test_figures_of_the_detail_or_else_the_stored_image(campaign, detail):
    assert {"d0c3-m1", "d0c3-opd", "d0c3-psf", "d0-time", "wfe", "strehl"} <= set(
        read(render_report(campaign, [detail])).ids
    )
    assert {"d0-psf", "d0-time", "d1-psf"} <= set(read(render_report(campaign, [])).ids)


def test_the_same_data_give_the_same_bytes(html, campaign, detail):
    assert render_report(campaign, [detail], LIMITS) == html


def test_a_campaign_of_which_nothing_is_done(campaign):
    campaign["status"][:] = 0
    html = render_report(campaign, [])
    assert "No case is done yet." in "".join(read(html).text)


def test_a_campaign_of_which_everything_failed(campaign):
    campaign["status"][:] = 2
    assert "No case is done: all 10 that were computed failed." in "".join(
        read(render_report(campaign, [])).text
    )


def test_a_store_without_a_study_is_reported_all_the_same(campaign):
    campaign.attrs = {"study": "not json"}
    assert "Campaign" in "".join(read(render_report(campaign, [])).text)


def test_writing_replaces_the_file_and_leaves_nothing_else(campaign, tmp_path):
    path = tmp_path / "new" / "report.html"
    for _ in range(2):
        assert write_report(campaign, [], path) == path.resolve()
    assert [entry.name for entry in path.parent.iterdir()] == ["report.html"]
    assert path.read_text(encoding="utf-8").startswith("<!DOCTYPE html>")


def test_a_place_that_cannot_be_written_is_named(campaign, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match=r"report.html cannot be written"):
        write_report(campaign, [], tmp_path / "file" / "report.html")


def test_a_failed_write_keeps_the_old_report(campaign, tmp_path, monkeypatch):
    path = tmp_path / "report.html"
    path.write_text("old")

    def no_space(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", no_space)
    with pytest.raises(UserError, match="No space left"):
        write_report(campaign, [], path)
    assert [entry.name for entry in tmp_path.iterdir()] == ["report.html"]
    assert path.read_text() == "old"


def test_a_detail_of_another_campaign_is_refused(campaign, detail):
    with pytest.raises(UserError, match="'quake'"):
        render_report(campaign, [replace(detail, disturbance="quake")])
