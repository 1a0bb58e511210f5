// The movable cut through the model: a slab across one axis of the common frame.

const AXES = ["x", "y", "z"];
let ORDER = null; // points of all scans in random order, so that no scan hides others

function cutRange() {
  const { box } = arranged("after");
  const [low, high] = box[state.axis];
  const total = POINTS.reduce((sum, p, i) => sum + (isMember(i, "after") ? p.n : 0), 0);
  // Thick enough for some 1600 points, thin enough to be a cut.
  const width = Math.min(Math.max(1600 / (total + 1), 0.004), 0.03) * (high - low);
  return { low, high, width, at: low + state.cut * (high - low) };
}

// The other two axes: to the right, and upwards the one that points up in the 3D view.
function slabAxes() {
  const up = DATA.camera[1].map(Math.abs);
  return [0, 1, 2].filter((a) => a !== state.axis).sort((a, b) => up[a] - up[b]);
}

function shuffled() {
  const order = [];
  POINTS.forEach((p, i) => { for (let k = 0; k < p.n; k++) order.push(i, k); });
  let seed = 1;
  for (let m = order.length / 2 - 1; m > 0; m--) {
    seed = (Math.imul(seed, 1664525) + 1013904223) >>> 0;
    const r = seed % (m + 1);
    for (const s of [0, 1]) {
      [order[2 * m + s], order[2 * r + s]] = [order[2 * r + s], order[2 * m + s]];
    }
  }
  return Int32Array.from(order);
}

function visibleAfter(i) {
  return isMember(i, "after") && (state.only ? state.only.includes(i) : state.shown[i]);
}

// Where half of the points lie on either side.
function middleCut(axis) {
  const { parts, box } = arranged("after");
  const [low, high] = box[axis];
  const values = parts.flatMap((p) => (p ? Array.from(p[axis].filter((_, k) => k % 7 === 0)) : []));
  values.sort((x, y) => x - y);
  const share = (values[values.length >> 1] - low) / Math.max(high - low, 1e-30);
  return Math.min(Math.max(share, 0), 1);
}

// How long an outline a cut through the middle shows, in squares of a grid.
function outlineLength(axis) {
  const { parts, box } = arranged("after");
  [state.axis, state.cut] = [axis, middleCut(axis)];
  const { at, width } = cutRange();
  const cell = Math.max(...box.map(([low, high]) => high - low), 1e-12) / 60;
  const [u, v] = [0, 1, 2].filter((a) => a !== axis);
  const squares = new Set();
  for (const p of parts) {
    for (let k = 0; p && k < p[0].length; k++) {
      if (Math.abs(p[axis][k] - at) > width / 2) continue;
      squares.add(`${Math.floor(p[u][k] / cell)},${Math.floor(p[v][k] / cell)}`);
    }
  }
  return squares.size;
}

function slabTraces() {
  const { parts } = arranged("after");
  const { at, width } = cutRange();
  const [u, v] = slabAxes();
  const shown = DATA.scans.map((_, i) => visibleAfter(i));
  const [x, y, color] = [[], [], []];
  for (let m = 0; m < ORDER.length; m += 2) {
    const [i, k] = [ORDER[m], ORDER[m + 1]];
    if (!shown[i] || Math.abs(parts[i][state.axis][k] - at) > width / 2) continue;
    x.push(parts[i][u][k]);
    y.push(parts[i][v][k]);
    color.push(rgb(state.color === "scan" ? DATA.scans[i].color : heat(POINTS[i].distance[k])));
  }
  return [{ type: "scattergl", mode: "markers", x, y, hoverinfo: "skip",
    marker: { size: 4, color, line: { width: 0 } } }];
}

function slabLayout() {
  const { box, key } = arranged("after");
  const [u, v] = slabAxes();
  const axis = (a) => {
    const grow = 0.04 * (box[a][1] - box[a][0]) + 1e-12;
    return { range: [box[a][0] - grow, box[a][1] + grow], showgrid: false, zeroline: false,
      showticklabels: false, title: { text: AXES[a], standoff: 2 } };
  };
  return {
    margin: { l: 24, r: 6, t: 6, b: 24 }, dragmode: "pan", uirevision: `${state.axis} ${key}`,
    paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
    font: { color: theme("--soft"), size: 11 }, showlegend: false,
    xaxis: axis(u), yaxis: { ...axis(v), scaleanchor: "x" },
  };
}

// Where the cut lies, drawn into the 3D view.
function cutOutline() {
  const { box } = arranged("after");
  const { at } = cutRange();
  const [u, v] = slabAxes();
  const corners = [[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]].map(([p, q]) => {
    const c = [0, 0, 0];
    c[state.axis] = at;
    c[u] = box[u][p];
    c[v] = box[v][q];
    return c;
  });
  const [x, y, z] = [0, 1, 2].map((a) => corners.map((c) => c[a]));
  return { type: "scatter3d", mode: "lines", x, y, z, hoverinfo: "skip", showlegend: false,
    line: { color: theme("--accent"), width: 3 }, visible: state.when === "after" };
}

let cutting = false;

function drawSlab() {
  if (cutting) return;
  cutting = true;
  requestAnimationFrame(() => {
    cutting = false;
    const { low, high, at, width } = cutRange();
    const { origin } = arranged("after");
    const place = (at + origin[state.axis]).toFixed(Math.max(decimals([[low], [high]]) - 2, 0));
    $("cut-at").textContent =
      `${AXES[state.axis]} = ${place}${UNIT && ` ${UNIT}`}, ${asFine(width, 2)} thick`;
    Plotly.react("slab", slabTraces(), slabLayout(), CONFIG);
  });
}

// The axis across which a cut shows most, of those that are not seen edge-on at first,
// and where to begin.
function chooseCut() {
  const faces = AXES.map((_, a) => Math.abs(DATA.camera[2][a]) > 0.3);
  const lengths = AXES.map((_, a) => (faces[a] ? outlineLength(a) : -1));
  state.axis = lengths.indexOf(Math.max(...lengths));
  state.cut = middleCut(state.axis);
}

function startSection() {
  $("section-card").hidden = false;
  ORDER = shuffled();
  $("cut").value = 1000 * state.cut;
  choice("axis", AXES.map((name, a) => [a, name]), "axis");
  // The outline in the 3D view follows when the slider rests: it redraws all points.
  let rest = 0;
  $("cut").addEventListener("input", () => {
    state.cut = Number($("cut").value) / 1000;
    drawSlab();
    clearTimeout(rest);
    rest = setTimeout(drawScene, 120);
  });
  listeners.push((part) => {
    if ("axis" in part || "model" in part || "only" in part || "own" in part) {
      state.cut = middleCut(Number(state.axis));
      $("cut").value = 1000 * state.cut;
    }
    drawSlab();
  });
  drawSlab();
}
