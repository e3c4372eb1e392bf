"use strict";
// Plays the commands of a scene to meshcat's viewer; adds legend, labels and captions.
(() => {
  const data = JSON.parse(document.getElementById("scene-data").textContent);
  const THREE = MeshCat.THREE;
  const viewer = new MeshCat.Viewer(document.getElementById("meshcat-pane"));
  window.viewer = viewer;

  // The world has z up, three.js has y up.
  const toView = (v) => new THREE.Vector3(v[0], v[2], -v[1]);
  const make = (tag, parent, text) => {
    const element = document.createElement(tag);
    if (text !== undefined) element.textContent = text;
    parent.appendChild(element);
    return element;
  };
  const makeSvg = (tag, parent, attributes) => {
    const element = document.createElementNS("http://www.w3.org/2000/svg", tag);
    for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
    parent.appendChild(element);
    return element;
  };
  const split = (path) => path.split("/").filter((name) => name.length > 0);

  // ---- the scene itself
  const play = (bytes) => viewer.handle_command_bytearray(bytes);
  for (const command of data.commands) {
    play(Uint8Array.from(atob(command), (c) => c.charCodeAt(0)));
  }
  if (data.live) viewer.connect(`ws://${location.host}/commands`);

  // ---- panel: title, headline, legend, facts
  const panel = document.getElementById("panel");
  panel.querySelector("h1").textContent = data.title;
  panel.querySelector("#headline").textContent = data.headline;
  // a narrow page has the panel above the machine, and its legend opens on a click
  if (location.hash === "#picture") document.body.classList.add("picture");
  const legend = panel.querySelector("details"), narrowQuery = window.matchMedia("(max-width: 600px)");
  const isNarrow = () => narrowQuery.matches && location.hash !== "#picture";
  const fold = () => (legend.open = !isNarrow());
  narrowQuery.addEventListener("change", fold);
  fold();
  data.facts.forEach((fact) => make("div", document.getElementById("facts"), fact));
  const marks = {
    solid: (svg, c) => makeSvg("rect", svg, { x: 4, y: 2, width: 18, height: 8, rx: 2, fill: c }),
    ghost: (svg, c) => makeSvg("rect", svg, { x: 4, y: 2, width: 18, height: 8, rx: 2, fill: c, "fill-opacity": 0.35, stroke: c, "stroke-dasharray": "3 2" }),
    arrow: (svg, c) => makeSvg("path", svg, { d: "M2 4.5 H15 V1 L24 6 L15 11 V7.5 H2 Z", fill: c }),
    line: (svg, c) => makeSvg("line", svg, { x1: 2, y1: 6, x2: 24, y2: 6, stroke: c, "stroke-width": 2 }),
    ball: (svg, c) => makeSvg("circle", svg, { cx: 13, cy: 6, r: 5.5, fill: c, "fill-opacity": 0.6 }),
  };
  const show = (path, visible) => {
    viewer.set_property(split(path), "visible", visible);
    viewer.set_dirty();
  };
  const boxes = data.legend.map((entry) => {
    const label = make("label", make("li", document.getElementById("legend")));
    const box = make("input", label);
    box.type = "checkbox";
    box.checked = entry.shown;
    marks[entry.mark](makeSvg("svg", label, { width: 26, height: 12 }), entry.colour);
    make("span", label, entry.text.replaceAll("× ", "×\u00a0"));
    box.addEventListener("change", () => entry.nodes.forEach((n) => show(n, box.checked)));
    return { box, nodes: entry.nodes.map(split) };
  });
  const find = (path) => {
    let node = viewer.scene_tree;
    for (const name of path) {
      node = node && node.children[name];
    }
    return node && node.object;
  };
  const isShown = (path) => {
    let node = viewer.scene_tree;
    for (const name of path) {
      node = node.children[name];
      if (!node) return false;
      if (!node.object.visible) return false;
    }
    return true;
  };

  // ---- camera: the whole machine in view, beside the panel, in a window of any size
  const camera = () => viewer.camera;
  let shift = [0, 0];
  const fit = (again) => {
    const width = window.innerWidth, height = window.innerHeight;
    const controls = document.querySelector(".dg.main");
    const narrow = isNarrow();
    const leftSide = narrow ? 0 : Math.min(panel.offsetWidth + 20, width / 2);
    const top = narrow ? panel.querySelector("summary").getBoundingClientRect().bottom : 0;
    const bottom = narrow ? document.getElementById("bar").offsetHeight + 20 : 28;
    const rightSide = controls && controls.offsetHeight > height / 4 ? controls.offsetWidth : 0;
    const view = camera(), target = toView(data.camera.target);
    const points = data.camera.points.map((p) => toView(p).sub(target));
    const size = Math.max(...points.map((p) => p.length()));
    view.fov = 32;
    view.near = size / 50;
    view.far = size * 60;
    if (again) {
      const back = toView(data.camera.direction).normalize();
      const right = new THREE.Vector3(0, 1, 0).cross(back).normalize(), up = back.clone().cross(right);
      const slope = Math.tan((view.fov * Math.PI) / 360);
      const tall = narrow ? 0.94 * slope * Math.max(1 - (top + bottom) / height, 0.3) : 0.86 * slope;
      const wide = (0.94 * slope * (width - leftSide - rightSide)) / height;
      // iterate: a smaller distance shifts the middle, and centring leaves room for a smaller distance
      const span = (i) => Math.max(...seen.map((p) => p[i])) - Math.min(...seen.map((p) => p[i]));
      let distance = 4 * size, seen;
      for (let round = 0; round < 30; round++) {
        seen = points.map((p) => [p.dot(right) / (distance - p.dot(back)), p.dot(up) / (distance - p.dot(back))]);
        distance *= Math.sqrt(Math.max(span(0) / wide, span(1) / tall) / 2);
      }
      const middle = (i) => (Math.max(...seen.map((p) => p[i])) + Math.min(...seen.map((p) => p[i]))) / 2 / slope / 2;
      shift = [middle(0), middle(1)];
      viewer.controls.target.copy(target);
      view.position.copy(back.multiplyScalar(distance).add(target));
    }
    view.aspect = width / height;
    const x = (rightSide - leftSide) / 2 + shift[0] * height, y = -shift[1] * height + (bottom - top) / 2;
    view.setViewOffset(width, height, x, y, width, height);
    viewer.controls.update();
    viewer.set_dirty();
  };
  let turned = false; // once the user has turned the view, resizing does not change it
  viewer.controls.addEventListener("start", () => (turned = true));
  window.addEventListener("resize", () => fit(!turned));

  // ---- labels: beside their points; none covers another or a panel
  const layer = document.getElementById("labels");
  const leaders = document.getElementById("leaders");
  const labels = data.labels.map((label) => {
    const element = make("div", layer);
    element.className = label.rank < 0 ? "label plain" : "label";
    return { ...label, element, line: makeSvg("line", leaders, {}), points: label.at.map(toView), path: split(label.node), last: null };
  });
  // names first, because they must be at their points; then the largest readings
  labels.sort((a, b) => (a.rank < 0 ? 1 : 0) === (b.rank < 0 ? 1 : 0) ? b.rank - a.rank : a.rank - b.rank);
  const places = [];
  for (const reach of [30, 48, 70, 96, 128, 166, 210]) {
    for (let i = 0; i < 16; i++) {
      const angle = (i * Math.PI) / 8;
      places.push({ x: Math.cos(angle), y: Math.sin(angle), reach });
    }
  }
  const near = [{ x: 0, y: 0, reach: 0 }, ...places.filter((p) => p.reach < 40).map((p) => ({ ...p, reach: 4 }))];
  const overlap = (a, b) => a.left < b.right && b.left < a.right && a.top < b.bottom && b.top < a.bottom;
  const step = () => {
    if (data.steps.length === 0) return 0;
    const time = viewer.animator.time;
    return data.steps.findIndex((s) => time >= s.start - 1e-6 && time <= s.end + 1e-6);
  };
  const atStep = (values, now) => values[Math.min(Math.max(now, 0), values.length - 1)];
  const arrange = () => {
    const width = window.innerWidth, height = window.innerHeight, now = step();
    const taken = ["#panel", "#bar", ".dg.main"]
      .map((name) => document.querySelector(name))
      .filter((element) => element && element.offsetWidth > 0)
      .map((element) => element.getBoundingClientRect());
    const middle = toView(data.camera.target).project(camera());
    const shown = [], spared = [];
    for (const label of labels) {
      const text = label.texts.length === 1 ? label.texts[0] : now < 0 ? "" : label.texts[now];
      const at = atStep(label.points, now).clone().project(camera());
      const inside = Math.abs(at.x) < 1 && Math.abs(at.y) < 1 && at.z < 1;
      label.element.style.display = label.line.style.display = "none";
      if (!inside || !isShown(label.path)) continue;
      const x = ((at.x + 1) / 2) * width, y = ((1 - at.y) / 2) * height;
      // no label covers the point of another label; other points only if there is no room
      const kept = text ? taken : spared;
      if (label.rank >= 0) kept.push({ left: x - 12, right: x + 12, top: y - 12, bottom: y + 12 });
      if (label.uncovered.length > 0) {
        const around = atStep(label.uncovered, now).map((point) => toView(point).project(camera()));
        const xs = around.map((p) => ((p.x + 1) / 2) * width), ys = around.map((p) => ((1 - p.y) / 2) * height);
        kept.push({ left: Math.min(...xs) - 8, right: Math.max(...xs) + 8, top: Math.min(...ys) - 8, bottom: Math.max(...ys) + 8 });
      }
      if (!text) continue;
      if (label.element.textContent !== text) label.element.textContent = text;
      label.element.style.display = "block";
      shown.push({ label, x, y, w: label.element.offsetWidth, h: label.element.offsetHeight });
    }
    const mx = ((middle.x + 1) / 2) * width, my = ((1 - middle.y) / 2) * height;
    for (const { label, x, y, w, h } of shown) {
      const away = Math.hypot(x - mx, y - my) || 1;
      const cost = (p) => p.reach - 45 * ((p.x * (x - mx)) / away + (p.y * (y - my)) / away) - (p === label.last ? 25 : 0);
      const options = label.rank < 0 ? near : [...places].sort((p, q) => cost(p) - cost(q));
      const tryAll = (forbidden) => {
        for (const place of options) {
          const left = x + place.x * (place.reach + w / 2) - w / 2, top = y + place.y * (place.reach + h / 2) - h / 2;
          const rect = { left: left - 2, right: left + w + 2, top: top - 2, bottom: top + h + 2 };
          if (rect.left < 2 || rect.top < 2 || rect.right > width - 2 || rect.bottom > height - 2) continue;
          if (forbidden.some((other) => overlap(rect, other))) continue;
          label.last = place;
          return { rect, left, top };
        }
        return null;
      };
      const found = tryAll([...taken, ...spared]) || tryAll(taken);
      if (!found) {
        label.element.style.display = "none";
        continue;
      }
      taken.push(found.rect);
      label.element.style.left = `${found.left}px`;
      label.element.style.top = `${found.top}px`;
      if (label.rank >= 0) {
        const cx = Math.min(Math.max(x, found.left), found.left + w), cy = Math.min(Math.max(y, found.top), found.top + h);
        for (const [name, value] of [["x1", x], ["y1", y], ["x2", cx], ["y2", cy]]) label.line.setAttribute(name, value);
        label.line.style.display = "";
      }
    }
  };

  // ---- bar: caption of the posture, and a button for meshcat's animator
  const bar = document.getElementById("bar");
  const button = bar.querySelector("button"), caption = bar.querySelector("span");
  if (data.steps.length > 0) {
    bar.style.display = "flex";
    caption.textContent = data.steps[0].caption; // the view leaves room for it
  }
  button.style.display = data.steps.length > 1 ? "" : "none";
  button.addEventListener("click", () => {
    const animator = viewer.animator;
    if (animator.playing) animator.pause();
    else {
      if (animator.time >= animator.duration - 1e-6) animator.reset();
      animator.play();
    }
    viewer.set_dirty();
  });
  const refresh = () => {
    const now = step();
    if (data.steps.length > 0) {
      const time = viewer.animator.time;
      const next = data.steps.find((s) => s.end >= time - 1e-6) || data.steps[data.steps.length - 1];
      const text = now >= 0 ? data.steps[now].caption : `moving to ${next.name} …`;
      if (caption.textContent !== text) caption.textContent = text;
      const word = viewer.animator.playing ? "❚❚ Pause" : "▶ Play";
      if (button.textContent !== word) button.textContent = word;
    }
    for (const { box, nodes } of boxes) {
      const objects = nodes.map(find).filter(Boolean);
      if (objects.length) box.checked = objects.some((object) => object.visible);
    }
    arrange();
  };
  const render = viewer.render.bind(viewer);
  viewer.render = () => {
    render();
    refresh();
    document.documentElement.dataset.rendered = String(Number(document.documentElement.dataset.rendered || 0) + 1);
  };

  // ---- print: an image of the canvas
  window.addEventListener("beforeprint", () => {
    const stage = document.getElementById("stage");
    const image = document.getElementById("print-image") || make("img", stage);
    image.id = "print-image";
    image.src = viewer.capture_image();
    // keep the size of the window on paper, also in the frame of a page
    for (const element of [stage, image]) {
      element.style.width = `${window.innerWidth}px`;
      element.style.height = `${window.innerHeight}px`;
    }
    if (window.frameElement) window.frameElement.style.width = `${window.innerWidth}px`;
  });
  window.addEventListener("afterprint", () => {
    document.getElementById("print-image").remove();
    document.getElementById("stage").style.cssText = "";
    if (window.frameElement) window.frameElement.style.width = "100%";
  });

  viewer.set_3d_pane_size();
  fit(true);
})();
