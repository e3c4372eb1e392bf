"""Pages in a real browser without a network: one request, no message on the console."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from browser import SIZES, SMALL, open_browser, require_browser, visit
from folders import session_folder
from PIL import Image

from orthocal import LiveScene, calibrate, draw_scene, load_robot, load_session, write_report
from orthocal.measurement.files.session_file import load_plan
from orthocal.output.report.parameter_plots import plot_correlations
from orthocal.viewer.browser import take_picture

EXPECTED = ("zx −1.140 → −0.130 mm", "x_max − x_min", "Before: measured − nominal", "leg z")


def by_size(size):
    return f"{size[0]}x{size[1]}"


def by_name_and_size(case):
    return f"{case[0]}-{by_size(case[1])}"


@pytest.fixture(scope="module")
def browser():
    with open_browser() as found:
        yield found


@pytest.fixture(scope="module")
def calibration(experiment_2):
    return calibrate(experiment_2)


@pytest.fixture(scope="module")
def page(calibration, tmp_path_factory):
    return draw_scene(calibration).save(tmp_path_factory.mktemp("page") / "scene.html")


@pytest.fixture(scope="module", params=SIZES, ids=by_size)
def drawn(browser, page, request):
    """The page of the calibration, open and drawn; tests do not change it."""
    with visit(browser, page.as_uri(), size=request.param) as found:
        found.wait_until_drawn()
        yield found, request.param


@pytest.fixture(scope="module")
def session_drawn(browser, root, tmp_path_factory, request):
    """The page of a session, open and drawn, and its size."""
    name, size = request.param
    scene = draw_scene(load_session(session_folder(root, name)))
    path = scene.save(tmp_path_factory.mktemp("session") / "page.html")
    with visit(browser, path.as_uri(), size=size) as found:
        found.wait_until_drawn()
        yield found, size


@pytest.fixture(scope="module")
def report(calibration, tmp_path_factory):
    return write_report(calibration, tmp_path_factory.mktemp("report") / "report.html")


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


def test_setups_with_any_names_are_drawn(browser, raw_cycles, tmp_path):
    """The viewer keeps nodes in plain JavaScript objects, which have some keys already."""
    odd = dict(zip(raw_cycles.setups, ("constructor", "__proto__", "<object>"), strict=False))
    name_of = {name: odd.get(name, name) for name in raw_cycles.setups}
    assert len(odd) == 3
    session = replace(
        raw_cycles,
        setups={name_of[n]: replace(s, name=name_of[n]) for n, s in raw_cycles.setups.items()},
        readings=tuple(replace(r, setup=name_of[r.setup]) for r in raw_cycles.readings),
    )
    path = draw_scene(session).save(tmp_path / "scene.html")
    with visit(browser, path.as_uri(), size=SMALL) as found:
        found.wait_until_drawn()
        assert found.messages == []
        assert is_drawn(found.picture())
        nodes = found.page.evaluate("Object.keys(viewer.scene_tree.find(['Gauges']).children)")
    assert all(any(name in node for node in nodes) for name in odd.values()), nodes


def test_scene_draws_without_requests(drawn, page):
    found, _ = drawn
    assert found.messages == []
    assert found.requests == [page.as_uri()]
    assert is_drawn(found.canvas())
    text = found.page.inner_text("body")
    for expected in EXPECTED:
        assert expected in text
    assert "Leg x is furthest from parallel: −1.140 mm" in text
    assert "deviation × 12" in text


def test_whole_machine_is_in_view_beside_the_panels(drawn):
    found, size = drawn
    left, right, top, bottom = found.page.evaluate(
        """() => {
             const data = JSON.parse(document.getElementById('scene-data').textContent);
             const at = data.camera.points.map(([x, y, z]) =>
               new MeshCat.THREE.Vector3(x, z, -y).project(viewer.camera));
             const x = at.map((p) => ((p.x + 1) / 2) * window.innerWidth);
             const y = at.map((p) => ((1 - p.y) / 2) * window.innerHeight);
             return [Math.min(...x), Math.max(...x), Math.min(...y), Math.max(...y)];
           }"""
    )
    panel = found.page.evaluate("document.getElementById('panel').getBoundingClientRect().right")
    assert left > panel
    assert right < size[0]
    assert top > 0
    assert bottom < size[1]
    assert (right - left) * (bottom - top) > 0.2 * size[0] * size[1]


NAMES = ("table1/experiment-2", "lines", "sweep")
LABELLED = [(name, size) for name in NAMES for size in SIZES]


@pytest.mark.parametrize("session_drawn", LABELLED, ids=by_name_and_size, indirect=True)
def test_no_label_covers_another_or_a_panel(session_drawn):
    found, size = session_drawn
    rectangles = boxes(found.page)
    assert sum("mm" in r[4] for r in rectangles) >= 6
    for i, (left, top, right, bottom, text) in enumerate(rectangles):
        for l2, t2, r2, b2, other in rectangles[i + 1 :]:
            apart = right <= l2 or r2 <= left or bottom <= t2 or b2 <= top
            assert apart, f"{text!r} and {other!r} overlap"
        assert left >= 0
        assert top >= 0
        assert right <= size[0] + 1
        assert bottom <= size[1] + 1


SWEPT = [("sweep", size) for size in SIZES]


@pytest.mark.parametrize("session_drawn", SWEPT, ids=by_name_and_size, indirect=True)
def test_labels_cover_no_dial(session_drawn):
    """Six of 18 dials have a label, the worst of each leg and direction."""
    found, _ = session_drawn
    dials = found.page.evaluate(
        """() => JSON.parse(document.getElementById('scene-data').textContent).labels
             .filter((label) => label.node.startsWith('Gauges/'))
             .map(({ at: [[x, y, z]] }) => new MeshCat.THREE.Vector3(x, z, -y)
               .project(viewer.camera))
             .map((p) => [((p.x + 1) / 2) * window.innerWidth,
                          ((1 - p.y) / 2) * window.innerHeight])"""
    )
    labels = [r for r in boxes(found.page) if " mm" in r[4] and len(r[4]) < 80]
    assert len(dials) == 18
    assert len(labels) == 6
    for left, top, right, bottom, text in labels:
        covered = [d for d in dials if left <= d[0] <= right and top <= d[1] <= bottom]
        assert not covered, f"{text!r} covers {covered}"


@pytest.mark.parametrize("size", SIZES, ids=by_size)
def test_text_of_the_panel_fits_into_the_picture(browser, calibration, tmp_path, size):
    page = draw_scene(calibration, show="all").save(tmp_path / "page.html")
    with visit(browser, f"{page.as_uri()}#picture", size=size) as found:
        found.wait_until_drawn()
        text, room = found.page.evaluate(
            "(({ scrollHeight, clientHeight }) => [scrollHeight, clientHeight])"
            "(document.getElementById('panel'))"
        )
    assert text <= room


def test_measurement_plays(browser, page):
    """The controls and the button move machine and labels."""
    with visit(browser, page.as_uri(), size=SIZES[1]) as found:
        found.wait_until_drawn()
        steps = found.page.evaluate(
            "JSON.parse(document.getElementById('scene-data').textContent).steps"
        )
        pictures, captions = [], []
        for name in ("overview", "x_max", "y_min"):
            step = next(s for s in steps if s["name"] == name)
            seek(found, (step["start"] + step["end"]) / 2)
            pictures.append(found.canvas())
            captions.append(found.page.inner_text("#bar span"))
            labels = [r[4] for r in boxes(found.page) if " mm" in r[4]]
            if name == "x_max":
                assert any(text.startswith("zx −1.140") for text in labels)
                assert not any(text.startswith("zy") for text in labels)
        for one, two in ((0, 1), (1, 2), (0, 2)):
            changed = np.abs(pictures[one].astype(int) - pictures[two].astype(int)).max(axis=-1)
            assert (changed > 40).mean() > 0.005
        assert captions[1].startswith("x_max, leg x: ")
        assert captions[2].startswith("y_min, leg y: subtracted from the readings at y_max")
        found.page.evaluate("viewer.animator.reset()")
        found.page.click("#bar button")
        found.wait_for("viewer.animator.time > 2.5")
        moving = found.canvas()
        assert (np.abs(moving.astype(int) - pictures[0].astype(int)).max(axis=-1) > 40).any()
        assert found.page.inner_text("#bar button") == "❚❚ Pause"
        assert found.messages == []


def test_boxes_of_the_legend_show_and_hide(browser, page):
    with visit(browser, page.as_uri(), size=SIZES[1]) as found:
        found.wait_until_drawn()
        before = found.canvas()
        found.page.click("#legend label:has-text('Calibrated machine')")
        found.wait_for("!viewer.scene_tree.find(['Machine, calibrated']).object.visible")
        assert (found.canvas() != before).any()
        assert any("zx" in r[4] and "→" in r[4] for r in boxes(found.page)[2:])
        found.page.click("#legend label:has-text('Gauges')")
        found.wait_for("!document.getElementById('labels').innerText.includes('→')")
        # the legend shows what meshcat's controls have hidden
        found.page.evaluate(
            "viewer.set_property(['Leg lines'], 'visible', false); viewer.set_dirty()"
        )
        found.wait_for(
            """![...document.querySelectorAll('#legend label')]
                 .find((e) => e.textContent.startsWith('Leg,')).querySelector('input').checked"""
        )


def test_other_scenes_draw_too(browser, root, tmp_path, raw_cycles):
    calibrated = calibrate(raw_cycles)
    scenes = {
        "robot": draw_scene(load_robot("orthoglide")),
        "fivebar": draw_scene(load_robot(root / "tests/robots/fivebar")),
        "plan": draw_scene(load_plan(root / "tests/sessions/lines/plan.yaml")),
        "session": draw_scene(raw_cycles),
        "tool": draw_scene(calibrated, show="all"),
        "true": draw_scene(calibrated, posture="x_max", exaggeration=1.0),
    }
    for name, scene in scenes.items():
        path = scene.save(tmp_path / f"{name}.html")
        with visit(browser, path.as_uri(), size=SMALL) as found:
            found.wait_until_drawn()
            assert found.messages == [], name
            assert found.requests == [path.as_uri()], name
            assert count_colours(found.canvas()) > 300, name


def test_live_page_draws_what_the_server_sends(browser, calibration):
    scene = draw_scene(calibration)
    with LiveScene(scene) as live, visit(browser, live.url, size=SMALL, online=True) as found:
        found.wait_for(f"viewer.num_messages_received >= {len(scene.commands)}")
        found.wait_until_drawn()
        found.page.wait_for_timeout(500)
        assert is_drawn(found.canvas())
        assert found.messages == []
        assert {u.split("/")[2] for u in found.requests} == {f"127.0.0.1:{live.port}"}
        scene.set_property("Machine, calibrated", "visible", False)
        found.wait_for("!viewer.scene_tree.find(['Machine, calibrated']).object.visible")


# ---- the report


def test_report_opens_without_requests(browser, report):
    with visit(browser, report.as_uri(), size=(1000, 900)) as found:
        assert found.page.title().startswith("Calibration of orthoglide")
        text = found.page.inner_text("body")
        for expected in ("x_slide", "-0.527", "Findings", "SHA-256"):
            assert expected in text
        found.page.locator("iframe").scroll_into_view_if_needed()
        frame = found.page.frame_locator("iframe")
        frame.locator("#headline").wait_for(timeout=60_000)
        handle = found.page.query_selector("iframe").content_frame()
        found.wait_until_drawn(frame=handle)
        assert is_drawn(found.picture())
        assert found.messages == []
        outside = [u for u in found.requests if not u.startswith(("about:", "data:"))]
        assert outside == [report.as_uri()]


def test_report_is_as_wide_as_its_window(browser, report):
    """No figure is wider than the window at either size."""
    for size in SIZES:
        with visit(browser, report.as_uri(), size=size) as found:
            width = found.page.evaluate("document.documentElement.scrollWidth")
            assert width <= size[0]
            for figure in found.page.query_selector_all("figure svg"):
                box = figure.bounding_box()
                assert box["x"] >= 0
                assert box["x"] + box["width"] <= size[0] + 1


def test_no_text_of_a_plot_is_cut_off(browser, root, tmp_path):
    """Browsers may draw text wider than matplotlib does, here the names of 40 parameters."""
    calibration = calibrate(load_session(root / "examples/workshop"), "full")
    path = tmp_path / "plot.html"
    path.write_text(plot_correlations(calibration), encoding="utf-8")
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


def test_report_prints(browser, report, tmp_path):
    """The printed report has several pages."""
    with visit(browser, report.as_uri()) as found:
        found.page.locator("iframe").scroll_into_view_if_needed()
        handle = found.page.query_selector("iframe").content_frame()
        found.wait_until_drawn(frame=handle)
        data = found.page.pdf(path=str(tmp_path / "report.pdf"), format="A4", print_background=True)
    assert data.startswith(b"%PDF")
    assert data.count(b"/Type /Page\n") + data.count(b"/Type /Page ") >= 3


# ---- pictures


def test_picture_has_the_requested_size(page, tmp_path):
    require_browser()
    width, height = SIZES[1]
    text = page.read_text(encoding="utf-8")
    path = take_picture(text, tmp_path / "a.png", width=width, height=height)
    with Image.open(path) as image:
        assert image.size == (width, height)
        assert is_drawn(np.asarray(image.convert("RGB")))
