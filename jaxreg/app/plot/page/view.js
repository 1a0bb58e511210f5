// The main view of scans: 3D, or 2D for flat data, before and after.

let POINTS = null;

function readPoints() {
  const p = DATA.points;
  const steps = decode(p.xyz, Int16Array);
  const light = decode(p.light, Uint8Array);
  const distance = decode(p.distance, Uint8Array);
  let start = 0;
  return p.count.map((n, i) => {
    const local = new Float64Array(n * DATA.dim);
    const at = Array(DATA.dim).fill(0);
    for (let k = 0; k < local.length; k++) {
      const axis = k % DATA.dim;
      at[axis] += steps[start * DATA.dim + k];
      local[k] = p.offset[i][axis] + p.scale[i] * at[axis];
    }
    const part = {
      n,
      local,
      light: light.slice(start, start + n),
      distance: distance.slice(start, start + n),
    };
    start += n;
    return part;
  });
}

function times(A, B) {
  return A.map((row) => B[0].map((_, c) => row.reduce((s, a, k) => s + a * B[k][c], 0)));
}

// What is drawn in one frame: a component, or a pair that is shown by its own motion.
function isMember(i, when) {
  if (when === "before") return true;
  if (state.own) return state.only.includes(i);
  return DATA.scans[i].component === state.model;
}

function poseOf(i, when) {
  if (when === "before") return null;
  if (state.own) {
    const [first, second] = state.only;
    const T = DATA.scans[first].T;
    if (i === first) return T;
    return times(T, DATA.pairs.find((p) => p.i === first && p.j === second).T);
  }
  return i === 1 && DATA.modes.length ? DATA.modes[state.mode].T : DATA.scans[i].T;
}

// Coordinates of scan i as one array per axis, about `origin`, for drawing in float32.
function coordinates(i, when, origin) {
  const { n, local } = POINTS[i];
  const d = DATA.dim;
  const T = poseOf(i, when);
  const out = Array.from({ length: d }, () => new Float32Array(n));
  for (let k = 0; k < n; k++) {
    for (let a = 0; a < d; a++) {
      let x = 0;
      if (T === null) x = local[k * d + a];
      else {
        x = T[a][d];
        for (let b = 0; b < d; b++) x += T[a][b] * local[k * d + b];
      }
      out[a][k] = x - origin[a];
    }
  }
  return out;
}

// The box of the points, but not of a few strays far away.
function robustBox(parts) {
  return Array.from({ length: DATA.dim }, (_, a) => {
    const total = parts.reduce((sum, p) => sum + p[a].length, 0);
    const step = Math.max(1, Math.floor(total / 20000));
    const values = [];
    for (const p of parts) for (let k = 0; k < p[a].length; k += step) values.push(p[a][k]);
    values.sort((x, y) => x - y);
    const at = (q) => values[Math.round(q * (values.length - 1))];
    const [low, high] = [at(0.003), at(0.997)];
    const room = 0.35 * (high - low) + 1e-30;
    return [Math.max(at(0), low - room), Math.min(at(1), high + room)];
  });
}

const views = {};

// Coordinates and box of one state of the poses; computed once, then kept.
function arranged(when) {
  const alone = state.own && when !== "before";
  const key = when === "before" ? when : alone ? `pair ${state.only}` : `${state.model} ${state.mode}`;
  if (views[key]) return views[key];
  if (alone) for (const old in views) if (old.startsWith("pair")) delete views[old];
  const zero = Array(DATA.dim).fill(0);
  const used = DATA.scans.map((_, i) => isMember(i, when));
  const first = POINTS.map((_, i) => i).filter((i) => used[i]);
  const T = poseOf(first[0], when);
  const middle = DATA.points.offset[first[0]];
  const origin = zero.map((_, a) =>
    T === null ? middle[a] : T[a][DATA.dim] + middle.reduce((s, m, b) => s + T[a][b] * m, 0));
  const parts = POINTS.map((_, i) => (used[i] ? coordinates(i, when, origin) : null));
  const box = robustBox(parts.filter((p) => p !== null));
  views[key] = { parts, box, origin, key };
  return views[key];
}

function isShown(i) {
  if (!isMember(i, state.when)) return false;
  return state.only ? state.only.includes(i) : state.shown[i];
}

// A colour in light from 0, dark, to 1, brighter than the colour itself.
function lit(color, t) {
  if (t > 0.75) return mix(color, [255, 255, 255], 1.2 * (t - 0.75));
  return color.map((x) => x * (0.2 + (0.8 * t) / 0.75));
}

function shades(color) {
  return [0, 0.75, 1].map((t) => [t, rgb(lit(color, t))]);
}

// Sixteen steps of distance, the last one "farther", times sixteen of light.
const HEAT_SCALE = Array.from({ length: 256 }, (_, code) => {
  const color = heat(code >> 4 === 15 ? 255 : (254 * (code >> 4)) / 14);
  return [code / 255, rgb(lit(color, (code & 15) / 15))];
});

function heatCodes({ distance, light }) {
  return distance.map((d, k) => {
    const step = d === 255 ? 15 : Math.round((14 * d) / 254);
    return 16 * step + Math.round(light[k] / 17);
  });
}

function markerSize() {
  const box = $("scene").getBoundingClientRect();
  const counts = POINTS.map((p) => p.n).sort((a, b) => a - b);
  const size = 1.2 * Math.sqrt((0.13 * box.width * box.height) / (counts[counts.length >> 1] + 1));
  return Math.min(Math.max(size, 1.8), FLAT ? 9 : 4.5);
}

function sceneTraces() {
  const { parts } = arranged(state.when);
  const size = markerSize();
  const traces = POINTS.map((p, i) => {
    const part = parts[i] || Array(DATA.dim).fill([]);
    const marker = { size, line: { width: 0 }, cmin: 0, cmax: 255 };
    if (state.color === "distance") {
      Object.assign(marker, { color: heatCodes(p), colorscale: HEAT_SCALE });
    } else if (FLAT) {
      // Later ones smaller, so that points which coincide are both seen.
      marker.color = rgb(DATA.scans[i].color);
      marker.size = size * (1.3 - (0.7 * i) / Math.max(POINTS.length - 1, 1));
    } else {
      Object.assign(marker, { color: p.light, colorscale: shades(DATA.scans[i].color) });
    }
    return {
      type: FLAT ? "scattergl" : "scatter3d",
      mode: "markers",
      x: part[0], y: part[1], ...(FLAT ? {} : { z: part[2] }),
      marker, hoverinfo: "skip", showlegend: false,
      visible: isShown(i),
    };
  });
  if (!FLAT) traces.push(cutOutline());
  if (DATA.scans.some((s) => s.axes)) traces.push(errorOutlines());
  return [...traces, ...markTraces(arranged(state.when))];
}

// How far the points reach from the middle of their box, seen along one direction.
function reach({ parts, box }, direction, longest) {
  let far = 0;
  for (const p of parts) {
    for (let k = 0; p && k < p[0].length; k += 7) {
      let s = 0;
      for (let a = 0; a < 3; a++) {
        const [low, high] = box[a];
        s += direction[a] * (Math.min(Math.max(p[a][k], low), high) - (low + high) / 2);
      }
      far = Math.max(far, Math.abs(s));
    }
  }
  return far / longest;
}

// The camera of plotly: lengths in the longest side of the box, 45 degrees high.
function cameraOn(view) {
  const [right, up, toward] = DATA.camera;
  const longest = Math.max(...view.box.map(([low, high]) => high - low), 1e-12);
  const { width, height } = $("scene").getBoundingClientRect();
  const far = (direction) =>
    Math.max(reach(view, direction, longest), markReach(view, direction, longest));
  const half = Math.max(far(up), (far(right) * height) / width);
  const away = (1.1 * half) / Math.tan(Math.PI / 8) + 0.4 * far(toward);
  const at = (v, s) => ({ x: v[0] * s, y: v[1] * s, z: v[2] * s });
  return { eye: at(toward, away), up: at(up, 1), center: { x: 0, y: 0, z: 0 } };
}

// The layout of the main view; `seen` is what the camera starts on.
function sceneLayout(view = arranged(state.when), seen = null) {
  const { box, key = state.when } = view;
  const middle = box.map(([low, high]) => (low + high) / 2);
  const base = {
    margin: { l: 0, r: 0, t: 0, b: 0 },
    paper_bgcolor: "rgba(0,0,0,0)",
    plot_bgcolor: "rgba(0,0,0,0)",
    uirevision: "keep",
  };
  if (FLAT) {
    const grow = 0.05 * Math.max(...box.map(([l, h]) => h - l));
    const half = halfSides(view, box.map(([l, h]) => (h - l) / 2 + grow));
    const axis = (a) => ({ visible: false, range: [middle[a] - half[a], middle[a] + half[a]] });
    return {
      ...base, dragmode: "pan", uirevision: key, annotations: markLabels(view),
      xaxis: axis(0), yaxis: { ...axis(1), scaleanchor: "x" },
    };
  }
  const extent = box.map(([low, high]) => Math.max(high - low, 1e-12));
  const longest = Math.max(...extent);
  const half = halfSides(view, extent.map((e) => 0.52 * e));
  // In longest sides of the model, so that far marks leave the camera where it is.
  const ratio = half.map((h) => Math.max(h / (0.52 * longest), 0.01));
  const axis = (a) => ({ visible: false, autorange: false,
    range: [middle[a] - half[a], middle[a] + half[a]] });
  return {
    ...base,
    scene: {
      xaxis: axis(0), yaxis: axis(1), zaxis: axis(2),
      aspectmode: "manual", aspectratio: { x: ratio[0], y: ratio[1], z: ratio[2] },
      annotations: markLabels(view),
      camera: cameraOn(seen || arranged("after")), dragmode: "orbit", uirevision: "keep",
      bgcolor: "rgba(0,0,0,0)",
    },
  };
}

let drawing = false;

function drawScene() {
  if (drawing) return;
  drawing = true;
  requestAnimationFrame(() => {
    drawing = false;
    Plotly.react("scene", sceneTraces(), sceneLayout(), CONFIG);
  });
}

function resetView() {
  if (FLAT) {
    const { xaxis, yaxis } = sceneLayout();
    Plotly.relayout("scene", { "xaxis.range": xaxis.range, "yaxis.range": yaxis.range });
  } else Plotly.relayout("scene", { "scene.camera": cameraOn(arranged("after")) });
}

function showScale() {
  const box = $("scale");
  box.hidden = state.color !== "distance";
  if (box.childNodes.length) return;
  const stops = HEAT.map((c) => rgb(c)).join(",");
  box.append(
    "to the nearest point of the other scans: 0",
    el("i", { style: `background:linear-gradient(90deg,${stops})` }),
    asFine(DATA.points.far, 3),
    el("em"), "farther",
  );
}

// The list of scans: a click switches one, a double click shows it alone.
function scanList() {
  $("list-title").textContent = `Scans (${DATA.scans.length})`;
  const set = (f) => change({ shown: DATA.scans.map(f), only: null });
  $("list-tools").append(
    el("button", { type: "button", class: "plain", id: "all", onclick: () => set(() => true) }, "All"),
    el("button", { type: "button", class: "plain", id: "none", onclick: () => set(() => false) }, "None"),
  );
  const boxes = DATA.scans.map((scan, i) => {
    const box = el("input", { type: "checkbox" });
    box.addEventListener("change", () => {
      const shown = DATA.scans.map((_, k) => (state.only ? state.only.includes(k) : state.shown[k]));
      shown[i] = box.checked;
      change({ shown, only: null });
    });
    const k = scan.component;
    const points = scan.points.toLocaleString("en");
    const note = k < 0 ? "not placed" : k > 0 ? `${points}, component ${k}` : points;
    $("list").append(el("label", { class: "row", title: scan.name }, box,
      el("span", { class: "dot", style: `background:${rgb(scan.color)}` }),
      el("span", { class: "name" }, scan.name), el("small", {}, note)));
    return box;
  });
  const update = () => boxes.forEach((b, i) => {
    b.checked = state.only ? state.only.includes(i) : state.shown[i];
  });
  listeners.push(update);
  update();
}

function modeList() {
  if (DATA.modes.length < 2) return;
  const box = $("modes");
  box.hidden = false;
  box.append(el("h2", {}, "Poses the search ended in"),
    el("p", { class: "note" }, "Share of the posterior; a click shows the pose."));
  DATA.modes.forEach((mode, q) => {
    const row = el("button", { type: "button", class: "row", "data-mode": q },
      el("span", {}, q + 1),
      el("span", { class: "meter" }, el("i", { style: `width:${(100 * mode.weight).toFixed(1)}%` })),
      el("small", {}, `${(100 * mode.weight).toFixed(mode.weight < 0.1 ? 1 : 0)} %`));
    row.title = `${(100 * mode.fitness).toFixed(1)} % of the source lie on the target`;
    row.addEventListener("click", () => change({ mode: q, when: "after" }));
    const update = () => row.setAttribute("aria-pressed", String(state.mode === q));
    listeners.push(update);
    update();
    box.append(row);
  });
}

function showOnly() {
  const box = $("only");
  box.hidden = !state.only;
  if (!state.only) return;
  const [i, j] = state.only.map((k) => DATA.scans[k].name);
  const { joined } = pairOf(state.only);
  const by = state.own ? "by the motion of the pair " : "by the final poses ";
  const other = state.own ? "Final poses" : "Motion of the pair";
  box.replaceChildren(`${i} and ${j} alone, ${by}`, ...(joined ? [
    el("button", { type: "button", class: "plain", id: "own", onclick: () => change({ own: !state.own }) }, other)] : []),
    el("button", { type: "button", class: "plain", id: "every", onclick: () => change({ only: null }) }, "Show all"));
}

function startScans() {
  POINTS = readPoints();
  choice("when", [["before", "Before"], ["after", "After"]], "when");
  if (NUM_MODELS > 1) {
    const models = Array.from({ length: NUM_MODELS }, (_, k) => [k, `Component ${k}`]);
    choice("model", models, "model", { only: null, when: "after" });
  }
  choice("color", [["scan", "By scan"], ["distance", "By distance"]], "color");
  const total = POINTS.reduce((sum, p) => sum + p.n, 0);
  const all = DATA.scans.reduce((sum, s) => sum + s.points - s.dropped, 0);
  const thinned = total < all ? ` ${total.toLocaleString("en")} of ${all.toLocaleString("en")} points are drawn.` : "";
  const mixed = FLAT ? "" : " Where colours mix, scans coincide.";
  const grown = errorScale(state.model);
  const errors = grown ? ` ${FLAT ? "Ellipses" : "Ellipsoids"}: where the middle of each scan may be (95 %), `
    + `${grown.toLocaleString("en")} times as large.` : "";
  $("hint").textContent = howToMove() + mixed + errors + markHint(arranged("after")) + thinned;
  $("home").addEventListener("click", resetView);
  scanList();
  markList();
  modeList();
  listeners.push(drawScene, showScale, showOnly);
  showScale();
  if (!FLAT) chooseCut();
  return Plotly.newPlot("scene", sceneTraces(), sceneLayout(), CONFIG);
}
