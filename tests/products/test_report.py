"""The report: self-contained, safe against what users call their data, and complete with whatever facts there are."""

import html.parser
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from browsers import browser_or_skip, check_accessible

from lvba.products import report
from lvba.products.pictures import Picture, Pictures
from lvba.products.report import charts, formats
from service.cli import result_table

EVIL = '</script><script>alert(1)</script>"<img src=http://example.org/x.png onerror=alert(2)>&'


def scores(shift):
    keys = [kind.key for kind in formats.MEASURES]
    values = [*(np.random.default_rng(0).random(5) + shift), float("nan")]
    per_image = {key: values for key in ("psnr_leave_one_out", "ssim_leave_one_out")}
    return dict.fromkeys(keys, 20.0 + shift) | {"images": list(range(6)), "per_image": per_image}


def facts(name="courtyard"):
    path = np.random.default_rng(1).normal(size=(50, 3)).cumsum(0)
    return {
        "schema": 1,
        "dataset": {"path": f"/data/{name}", "name": name, "scans": 50, "images": 6, "duration_s": 5.0},
        "config": {"visual": {"levels": 3, "note": name}},
        "versions": {"lvba": "1", name: "2"},
        "stages": [{"name": name, "seconds": 1.5, "peak_memory_mb": 300.0, "tasks": 1, "reused": True}],
        "lidar": {"accepted": False, "reason": f"kept {name}", "planes": 12, "cost_initial": 3.0, "cost_final": 2.0,
                  "history": [{"cost_before": 3.0, "cost_after": 2.0, "sigma": 0.01},
                              {"cost_before": 4.0, "cost_after": 3.0}]},
        "visual": {"accepted": True, "observations": 1234, "extrinsic": {"change_m": 0.01, "change_deg": [0.1, 0, 0]},
                   "time_offset": {"seconds": 0.004, "sigma": 0.0002}, "degenerate_directions": [f"image 3: {name}"],
                   "history": [{"level": level, "cost": 10.0 / (k + 1)} for level in (1, 0) for k in range(4)]},
        "evaluation": {"rough": scores(0.0), "refined": scores(1.0)},
        "reference": {"lidar": {"ate_m": 0.001, "rotation_deg": 0.01, "rpe_m": 0.002},
                      "rough": {"lidar": {"ate_m": 0.08, "rotation_deg": 0.2, "rpe_m": 0.02}},
                      "exposure": {"rms_percent": 0.3}},
        "trajectory": {"scans": {"times": np.arange(50.0), "rough": path, "refined": path + 0.1}},
        "exposure": {"times": np.arange(6.0), "relative": np.linspace(1, 2, 6), "reference": [1.0, np.nan, 1, 1, 1, 2]},
        "warnings": [{"text": f"blur in {name}", "mend": f"shorter exposure, {name}"}, f"left out {name}"],
    }  # fmt: skip


def pictures(name="image 3"):
    rgb = np.random.default_rng(2).integers(0, 256, (48, 64, 3)).astype(np.uint8)
    one = Picture(name, rgb, rgb // 2, rgb, 12.0, 20.0)
    return Pictures((one, one), (one,))


class Parser(html.parser.HTMLParser):
    """Collects tags, attributes and text, and checks that tags are closed in order."""

    VOID = ("meta", "img", "input", "br", "circle", "line", "path")

    def __init__(self):
        super().__init__()
        self.open, self.tags, self.attributes, self.text = [], [], [], []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += attrs
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += attrs

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] not in ("script", "style"):
            self.text.append(data)


def parsed(page):
    parser = Parser()
    parser.feed(page)
    assert not parser.open
    return parser


def test_the_page_is_well_formed_and_asks_nothing_of_the_network(tmp_path):
    report.write(tmp_path, facts(), pictures())
    page = (tmp_path / "report.html").read_text()
    found = parsed(page)
    for name, value in found.attributes:
        if name in ("src", "href"):
            assert value.startswith("data:image/jpeg;base64,"), value[:80]
    assert not re.search(r"url\(|@import|https?://", page)
    assert "default-src 'none'" in page
    text = " ".join(found.text)
    for words_shown in ("courtyard", "+1.00", "blur in courtyard", "kept courtyard", "4.00 ± 0.20", "1 234"):
        assert words_shown.replace(" ", "") in text.replace(" ", "").replace("\N{THIN SPACE}", ""), (
            words_shown
        )


def test_names_from_users_stay_text():
    found = parsed(report.page(facts(EVIL), pictures(EVIL)))
    harmless = parsed(report.page(facts(), pictures()))
    assert found.tags == harmless.tags
    assert not any(name.startswith("on") for name, _ in found.attributes)
    assert sum(EVIL in piece for piece in found.text) >= 5


@pytest.mark.parametrize("missing", ["none", *facts()])
def test_any_part_may_be_missing(missing):
    some = facts()
    some.pop(missing, None)
    parsed(report.page(some, None if missing == "evaluation" else pictures()))


def test_no_facts_give_an_empty_page():
    parsed(report.page({}))


def test_json_is_strict_and_complete(tmp_path):
    report.write(tmp_path, facts())
    content = json.loads((tmp_path / "report.json").read_text(), parse_constant=pytest.fail)
    assert content["evaluation"]["rough"]["per_image"]["psnr_leave_one_out"][5] is None
    assert content["trajectory"]["scans"]["times"][:3] == [0, 1, 2]
    assert content["exposure"]["reference"][1] is None


def test_sliders_work_by_keyboard():
    found = parsed(report.page(facts(), pictures()))
    ranges = [value for name, value in found.attributes if name == "type" and value == "range"]
    assert len(ranges) == 2
    assert sum(name == "aria-label" and "divider" in value for name, value in found.attributes) == 2


def test_a_worse_result_is_called_worse():
    worse = facts()
    worse["evaluation"]["rough"], worse["evaluation"]["refined"] = scores(1.0), scores(0.0)
    assert "1.00\N{NO-BREAK SPACE}dB lower than</strong> before" in formats.verdict(worse)
    assert "scan poses were kept" in formats.verdict(worse)
    assert 'class="gain bad"' in report.page(worse)


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (0, 10, [0, 2, 4, 6, 8, 10]),
        (0.13, 0.52, [0.2, 0.3, 0.4, 0.5]),
        (-1, 1, [-1, -0.5, 0, 0.5, 1]),
        (5, 5, [5]),
    ],
)
def test_ticks_are_round_numbers(low, high, expected):
    assert charts.ticks(low, high) == pytest.approx(expected)


@pytest.mark.parametrize(("low", "high"), [(0, 3), (2.1, 2.2), (-9, 9), (5.0, 6.9)])
def test_logarithmic_ticks_lie_inside(low, high):
    places = charts.log_ticks(low, high)
    assert 1 < len(places) < 10
    assert all(low - 1e-9 <= np.log10(place) <= high + 1e-9 for place in places)


def test_charts_survive_flat_missing_and_single_values():
    flat = charts.Line("flat", np.arange(3.0), np.full(3, 2.0), "--after")
    assert "<svg" in charts.chart("a", [flat], "x", "y")
    hole = charts.Line("hole", np.arange(4.0), np.array([1, np.nan, 2, 3]), "--after")
    drawn = charts.chart("a", [hole], "x", "y", log=True)
    assert "nan" not in drawn
    assert drawn.count("M") >= 2
    assert charts.chart("a", [charts.Line("one", np.zeros(1), np.zeros(1), "--after")], "x", "y") == ""
    still = charts.Line("still", np.zeros(5), np.zeros(5), "--after")
    assert "nan" not in charts.track("a", "", [still])


@pytest.mark.parametrize(
    ("meters", "expected"),
    [(0.00031, "0.31 mm"), (0.0123, "12 mm"), (0.25, "250 mm"), (51.2, "51 m"), (None, "–")],
)
def test_lengths_have_the_unit_that_suits_them(meters, expected):
    assert formats.length(meters).replace("\N{NO-BREAK SPACE}", " ") == expected


def test_each_part_has_its_own_verdict():
    """Exposures that were refused are named, beside cameras that are used; and the other way round."""
    some = facts()
    some["lidar"] |= {"accepted": True, "reason": "sharper"}
    some["visual"] |= {
        "exposures_accepted": False,
        "exposures_reason": "darker by chance",
        "exposures_judged": [{}],
    }
    page = report.page(some)
    assert "exposures were kept" in page
    assert "Exposures: darker by chance" in page
    assert (
        '<span class="pill good">cameras: used</span> <span class="pill bad">exposures: input kept</span>'
        in page
    )
    said = []
    some["verdict"] = {"level": "check", "summary": "Expect 12 mm.", "reasons": []}
    result_table.show(some, Path("out"), said.append)
    assert "check: Expect 12 mm.\n" in said
    assert "scans: sharper\n" in said
    assert "exposures: darker by chance\n" in said


def with_verdict(**more):
    """Facts with a verdict, expected errors and the account of two pyramid levels."""
    expected = {
        "position_m": 0.0123,
        "position_p95_m": 0.02,
        "rotation_deg": 0.1,
        "per_frame_m": [0.01] * 49 + [None],
    }
    some = facts()
    some["visual"]["levels"] = [
        {"level": 1, "local_pairs": 10, "global_pairs": 2, "rms": 4.5, "iterations": [{}], "converged": False},
        {"level": 0, "local_pairs": 20, "global_pairs": 2, "rms": 5.5, "iterations": [{}, {}], "converged": True},
    ]  # fmt: skip
    some["visual"]["state"] = "visual"
    some["evaluation"]["states"] = {
        name: {"psnr_leave_one_out": value}
        for name, value in (("rough", 22.4), ("carried", 24.909), ("exposed", 20.0), ("visual", 26.281))
    }
    some |= {
        "verdict": {"level": "check", "summary": "Expect errors of about 12 mm in the map, perhaps more.",
                    "reasons": [{"text": f"reason {k}", "mend": f"mend {k}"} for k in range(5)]},
        "expected_error": {"scans": expected, "cameras": None, "map": {"position_m": 0.0123, "position_p95_m": 0.02},
                           "at_least": True, "note": ""},
        "planes": {"thickness_before_m": 0.03, "thickness_after_m": 0.012, "count_before": 5, "count_after": 9},
    }  # fmt: skip
    return some | more


def test_the_page_begins_with_the_verdict_then_photo_before_and_after():
    shown = pictures()
    page = report.page(with_verdict(), replace(shown, best=shown.views[0]))
    text = " ".join(parsed(page).text)
    order = ["Check", "about 12 mm in the map, perhaps more", "reason 0", "mend 0", "Photo", "Map before", "Map after",
             "Map error, expected", "Notes"]  # fmt: skip
    places = [text.index(shown) for shown in order]
    assert places == sorted(places)
    assert "2 more reasons" in text
    assert "perhaps more: see the reasons" in text
    assert "95 % of" not in text
    good = with_verdict(verdict={"level": "good", "summary": "Expect 12 mm.", "reasons": []})
    good["expected_error"]["at_least"] = False
    assert "95 % of points below" in report.page(good)


def test_figures_of_stages_are_explained_and_costs_that_cannot_be_compared_are_not_shown():
    text = " ".join(parsed(report.page(with_verdict())).text)
    assert "What each stage added" in text
    for value in ("22.40", "24.91", "26.28", "2.51", "1.37"):
        assert value in text, value
    assert "Photometric cost" not in text
    assert "LiDAR cost" not in text
    assert "1, not converged" in text
    assert "Degenerate directions" not in text


def test_degenerate_directions_are_counted():
    some = facts()
    some["lidar"] |= {"degenerate_scans": [0, 1, 0, 3], "degenerate_directions": [{}]}
    some["visual"] |= {"degenerate_directions": {"count": 67, "per_image": [0] * 30 + [3] * 20}}
    text = " ".join(parsed(report.page(some)).text)
    assert "Scans that planes determine in every direction 2 of 4" in text
    assert "do not determine (kept near the scans) 20 of 50" in text
    assert "67" not in text


@pytest.fixture(scope="module")
def browser():
    yield from browser_or_skip()


@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (390, "dark")])
def test_the_page_is_accessible_and_read_on_a_phone(browser, tmp_path, width, scheme):
    shown = pictures()
    report.write(tmp_path, with_verdict(), replace(shown, best=shown.views[0]))
    context = browser.new_context(viewport={"width": width, "height": 844}, color_scheme=scheme)
    page = context.new_page()
    page.goto(f"file://{tmp_path / 'report.html'}")
    check_accessible(page)
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    letters = page.evaluate(
        "[...document.querySelectorAll('svg')].map(svg => parseFloat(getComputedStyle(svg.querySelector('text'))"
        ".fontSize) * svg.getBoundingClientRect().width / svg.viewBox.baseVal.width)"
    )
    assert len(letters) >= 5
    assert min(letters) >= 12
    context.close()
