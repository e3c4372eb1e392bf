"""Pages in a real browser without a network: one request, no message on the console."""

from __future__ import annotations

import numpy as np
import pytest
from browser import NARROW, SIZES, SMALL, open_browser, require_browser, visit
from calibrated import (
    EXPERIMENT_2,
    UNJUDGED,
    calibrated,
    plan_of,
    rename_setups,
    report_of,
    scene_of,
    session_of,
)
from PIL import Image

from orthocal import LiveScene, draw_scene
from orthocal.output.report.parameter_plots import plot_correlations
from orthocal.viewer.browser import take_picture

pytestmark = pytest.mark.acceptance

EXPECTED = ("zx −1.140 → −0.130 mm", "x_max − x_min", "Before: measured − nominal", "leg z")


@pytest.fixture(scope="module")
def browser():
    with open_browser() as found:
        yield found


@pytest.fixture(scope="module")
def opened(browser, tmp_path_factory):
    """Function that opens a page and keeps it open and drawn; tests leave it as it was."""
    pages = {}

    def open_page(name, page, *, suffix="", drawn=True):
        if name not in pages:
            path = tmp_path_factory.mktemp("page") / "page.html"
            path.write_text(page(), encoding="utf-8")
            visited = visit(browser, path.as_uri() + suffix, size=SIZES[1])
            pages[name] = (visited, visited.__enter__())
            if drawn:
                pages[name][1].wait_until_drawn()
        return pages[name][1]

    yield open_page
    for visited, _ in pages.values():
        visited.__exit__(None, None, None)


@pytest.fixture
def drawn(opened):
    """The page of the calibration."""
    return opened("calibration", scene_of(EXPERIMENT_2).to_html)


@pytest.fixture
def report(opened):
    """The report of the calibration."""
    return opened("report", lambda: report_of(EXPERIMENT_2), drawn=False)


def count_colours(picture):
    """Number of colours without transparency."""
    red, green, blue = np.moveaxis(picture[..., :3].astype(np.int64), -1, 0)
    return np.unique(red << 16 | green << 8 | blue).size


def is_drawn(picture):
    """Whether a picture has many colours, and large parts that are not grey."""
    spread = picture[..., :3].max(axis=-1) - picture[..., :3].min(axis=-1)
    return count_colours(picture) > 500 and (spread > 60).mean() > 0.005


def boxes(page):
    """Rectangles and texts of visible labels and panels."""
    return page.evaluate(
        """() => [...document.querySelectorAll('.label, #panel, #bar, .dg.main')]
             .filter((e) => e.offsetWidth > 0 && e.offsetHeight > 0)
             .map((e) => { const r = e.getBoundingClientRect();
                           return [r.left, r.top, r.right, r.bottom, e.textContent]; })"""
    )


def seek(found, time):
    """Go to a time of the animation with meshcat's controls, and wait until it is drawn."""
    found.page.evaluate(
        """(time) => {
             const animator = viewer.animator;
             animator.reset();
             animator.play();
             animator.pause();
             animator.time_scrubber.setValue(time);
           }""",
        time,
    )
    found.wait_until_drawn()


def test_a_plan_with_any_names_of_setups_is_drawn(browser, tmp_path):
    """The viewer keeps nodes in plain JavaScript objects, which have some keys already."""
    plan = plan_of("raw-cycles")
    odd = dict(zip(("yx", "zx", "xy"), ("constructor", "__proto__", "<object>"), strict=True))
    assert set(odd) < set(plan.setups)
    path = draw_scene(rename_setups(plan, odd)).save(tmp_path / "scene.html")
    with visit(browser, path.as_uri(), size=SMALL) as found:
        found.wait_until_drawn()
        assert found.messages == []
        assert is_drawn(found.picture())
        nodes = found.page.evaluate("Object.keys(viewer.scene_tree.find(['Gauges']).children)")
    assert all(any(name in node for node in nodes) for name in odd.values()), nodes


def test_scene_draws_without_requests(drawn):
    assert drawn.messages == []
    assert drawn.requests == [drawn.page.url]
    assert is_drawn(drawn.canvas())
    text = drawn.page.inner_text("body")
    for expected in EXPECTED:
        assert expected in text
    assert "Leg x is furthest from parallel: −1.140 mm" in text
    assert "deviation × 12" in text


def assert_machine_is_in_view(page, size):
    """The complete machine is large, and beside or below the panel."""
    left, right, top, bottom = page.evaluate(
        """() => {
             const data = JSON.parse(document.getElementById('scene-data').textContent);
             const at = data.camera.points.map(([x, y, z]) =>
               new MeshCat.THREE.Vector3(x, z, -y).project(viewer.camera));
             const x = at.map((p) => ((p.x + 1) / 2) * window.innerWidth);
             const y = at.map((p) => ((1 - p.y) / 2) * window.innerHeight);
             return [Math.min(...x), Math.max(...x), Math.min(...y), Math.max(...y)];
           }"""
    )
    panel, bar = page.evaluate(
        "['panel', 'bar'].map((id) => document.getElementById(id).getBoundingClientRect().toJSON())"
    )
    if size == NARROW:
        assert 0 < left < right < size[0]
        assert panel["bottom"] < top < bottom < bar["top"]
    else:
        assert panel["right"] < left < right < size[0]
        assert 0 < top < bottom < size[1]
    assert (right - left) * (bottom - top) > 0.2 * size[0] * size[1]


def scene_page(name):
    """Page of the calibration of an example, or of a session without its calibration."""
    return (scene_of(name) if name == EXPERIMENT_2 else draw_scene(session_of(name))).to_html()


@pytest.mark.parametrize("name", [EXPERIMENT_2, "sweep"])
def test_machine_labels_and_panels_cover_nothing_at_any_size(opened, name):
    key = "calibration" if name == EXPERIMENT_2 else name
    found = opened(key, lambda: scene_page(name))
    for size in SIZES:
        found.resize(size)
        assert found.messages == []
        assert_machine_is_in_view(found.page, size)
        rectangles = boxes(found.page)
        assert sum("mm" in r[4] for r in rectangles) >= 6
        for i, (left, top, right, bottom, text) in enumerate(rectangles):
            for l2, t2, r2, b2, other in rectangles[i + 1 :]:
                apart = right <= l2 or r2 <= left or bottom <= t2 or b2 <= top
                assert apart, f"{text!r} and {other!r} overlap"
            assert min(left, top) >= 0
            assert right <= size[0] + 1
            assert bottom <= size[1] + 1
        # six of the 18 dials of the sweep have a label, the worst of each leg and direction
        labels = [r for r in rectangles if " mm" in r[4] and len(r[4]) < 80]
        places = found.page.evaluate(
            """() => JSON.parse(document.getElementById('scene-data').textContent).labels
                 .filter((label) => label.node.startsWith('Gauges/'))
                 .map(({ at: [[x, y, z]] }) => new MeshCat.THREE.Vector3(x, z, -y)
                   .project(viewer.camera))
                 .map((p) => [((p.x + 1) / 2) * window.innerWidth,
                              ((1 - p.y) / 2) * window.innerHeight])"""
        )
        assert len(places) == (18 if name == "sweep" else 6)
        assert len(labels) == 6
        for left, top, right, bottom, text in labels:
            covered = [p for p in places if left <= p[0] <= right and top <= p[1] <= bottom]
            assert not covered, f"{text!r} covers {covered}"


def test_legend_opens_and_closes_on_a_narrow_page(opened):
    found = opened("calibration", lambda: scene_page(EXPERIMENT_2))
    summary, legend = "#panel summary", "#legend"
    found.resize(NARROW)
    assert_machine_is_in_view(found.page, NARROW)
    assert not found.page.is_visible(legend)
    assert found.page.is_visible("#headline")
    for visible in (True, False):
        found.page.click(summary)
        assert found.page.is_visible(legend) == visible
    for size in SIZES:
        found.resize(size)
        assert found.page.is_visible(legend)
        assert not found.page.is_visible(summary)


def test_text_of_the_panel_fits_into_the_picture(opened):
    page = scene_of(EXPERIMENT_2, show="all").to_html
    found = opened("picture", page, suffix="#picture")
    assert found.messages == []
    assert count_colours(found.canvas()) > 300  # with ellipsoids at the tool
    text, room = found.page.evaluate(
        "(({ scrollHeight, clientHeight }) => [scrollHeight, clientHeight])"
        "(document.getElementById('panel'))"
    )
    assert text <= room


def test_measurement_plays(drawn):
    """The controls and the button move machine and labels."""
    drawn.resize(SIZES[1])
    steps = drawn.page.evaluate(
        "JSON.parse(document.getElementById('scene-data').textContent).steps"
    )
    pictures, captions = [], []
    for name in ("overview", "x_max", "y_min"):
        step = next(s for s in steps if s["name"] == name)
        seek(drawn, (step["start"] + step["end"]) / 2)
        pictures.append(drawn.canvas())
        captions.append(drawn.page.inner_text("#bar span"))
        labels = [r[4] for r in boxes(drawn.page) if " mm" in r[4]]
        if name == "x_max":
            assert any(text.startswith("zx −1.140") for text in labels)
            assert not any(text.startswith("zy") for text in labels)
    for one, two in ((0, 1), (1, 2), (0, 2)):
        changed = np.abs(pictures[one].astype(int) - pictures[two].astype(int)).max(axis=-1)
        assert (changed > 40).mean() > 0.005
    assert captions[1].startswith("x_max, leg x: ")
    assert captions[2].startswith("y_min, leg y: subtracted from the readings at y_max")
    drawn.page.evaluate("viewer.animator.reset()")
    drawn.page.click("#bar button")
    drawn.wait_for("viewer.animator.time > 2.5")
    moving = drawn.canvas()
    assert (np.abs(moving.astype(int) - pictures[0].astype(int)).max(axis=-1) > 40).any()
    assert drawn.page.inner_text("#bar button") == "❚❚ Pause"
    assert drawn.messages == []
    drawn.page.evaluate("viewer.animator.pause()")
    seek(drawn, 0)


def test_boxes_of_the_legend_show_and_hide(drawn):
    machine = "#legend label:has-text('Calibrated machine')"
    before = drawn.canvas()
    drawn.page.click(machine)
    drawn.wait_for("!viewer.scene_tree.find(['Machine, calibrated']).object.visible")
    assert (drawn.canvas() != before).any()
    assert any("zx" in r[4] and "→" in r[4] for r in boxes(drawn.page)[2:])
    drawn.page.click("#legend label:has-text('Gauges')")
    drawn.wait_for("!document.getElementById('labels').innerText.includes('→')")
    # the legend shows what meshcat's controls have hidden
    line = "viewer.set_property(['Leg lines'], 'visible', {}); viewer.set_dirty()"
    drawn.page.evaluate(line.format("false"))
    drawn.wait_for(
        """![...document.querySelectorAll('#legend label')]
             .find((e) => e.textContent.startsWith('Leg,')).querySelector('input').checked"""
    )
    drawn.page.evaluate(line.format("true"))
    for label in (machine, "#legend label:has-text('Gauges')"):
        drawn.page.click(label)
    drawn.wait_until_drawn()


def test_a_robot_with_sticks_for_links_is_drawn(browser, tmp_path, fivebar):
    path = draw_scene(fivebar).save(tmp_path / "fivebar.html")
    with visit(browser, path.as_uri(), size=SMALL) as found:
        found.wait_until_drawn()
        assert found.messages == []
        assert found.requests == [path.as_uri()]
        assert count_colours(found.canvas()) > 300


def test_live_page_draws_what_the_server_sends(browser, orthoglide):
    scene = draw_scene(orthoglide)
    with LiveScene(scene) as live, visit(browser, live.url, size=SMALL, online=True) as found:
        found.wait_for(f"viewer.num_messages_received >= {len(scene.commands)}")
        found.wait_until_drawn()
        found.page.wait_for_timeout(500)
        assert is_drawn(found.canvas())
        assert found.messages == []
        assert {u.split("/")[2] for u in found.requests} == {f"127.0.0.1:{live.port}"}
        scene.set_property("Machine", "visible", False)
        found.wait_for("!viewer.scene_tree.find(['Machine']).object.visible")


# ---- the report


def test_report_opens_without_requests_and_prints(report, tmp_path):
    """It is drawn with its scene; the printed report has several pages."""
    assert report.page.title().startswith("Calibration of orthoglide")
    text = report.page.inner_text("body")
    for expected in ("x_slide", "-0.527", "Findings", "SHA-256"):
        assert expected in text
    report.page.locator("iframe").scroll_into_view_if_needed()
    report.page.frame_locator("iframe").locator("#headline").wait_for(timeout=60_000)
    handle = report.page.query_selector("iframe").content_frame()
    report.wait_until_drawn(frame=handle)
    assert is_drawn(report.picture())
    assert report.messages == []
    outside = [u for u in report.requests if not u.startswith(("about:", "data:"))]
    assert outside == [report.page.url]
    width = "document.querySelector('iframe').clientWidth"
    drawn = report.page.evaluate(width)
    handle.evaluate(
        "addEventListener('beforeprint', () => (top.printed = frameElement.style.width))"
    )
    data = report.page.pdf(path=str(tmp_path / "report.pdf"), format="A4", print_background=True)
    assert data.startswith(b"%PDF")
    assert data.count(b"/Type /Page\n") + data.count(b"/Type /Page ") >= 3
    assert report.page.evaluate("printed") == f"{drawn}px"  # the scene is not cut on paper
    assert report.page.evaluate(width) == drawn

    # ---- pictures


def test_report_is_as_wide_as_its_window(report):
    """No figure is wider than the window at either size."""
    for size in SIZES:
        report.page.set_viewport_size({"width": size[0], "height": size[1]})
        width = report.page.evaluate("document.documentElement.scrollWidth")
        assert width <= size[0]
        for figure in report.page.query_selector_all("figure svg"):
            box = figure.bounding_box()
            assert box["x"] >= 0
            assert box["x"] + box["width"] <= size[0] + 1


def test_no_text_of_a_plot_is_cut_off(browser, tmp_path):
    """Browsers may draw text wider than matplotlib does, here the names of 40 parameters."""
    path = tmp_path / "plot.html"
    path.write_text(plot_correlations(calibrated("workshop", "full", **UNJUDGED)), encoding="utf-8")
    with visit(browser, path.as_uri()) as found:
        texts = found.page.evaluate(
            """() => {
                 const svg = document.querySelector('svg').getBoundingClientRect();
                 return [...document.querySelectorAll('svg text')].map((text) => {
                   const box = text.getBoundingClientRect();
                   return [box.left - svg.left, box.top - svg.top,
                           svg.right - box.right, svg.bottom - box.bottom, text.textContent];
                 });
               }"""
        )
    assert len(texts) > 80
    for *gaps, text in texts:
        assert min(gaps) >= 0.0, text


def test_picture_has_the_requested_size(tmp_path):
    require_browser()
    width, height = 480, 360
    text = scene_of(EXPERIMENT_2).to_html()
    path = take_picture(text, tmp_path / "a.png", width=width, height=height)
    with Image.open(path) as image:
        assert image.size == (width, height)
        assert is_drawn(np.asarray(image.convert("RGB")))
